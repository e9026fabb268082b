"""The quality metrics of NMC, NDC, VoroMesh and PoNQ.

All lengths are in units of the reference's box diagonal. P are points sampled on the reference, Q
points sampled on the result.

References
----------
Chen and Zhang, Neural Marching Cubes (2021): F1 at 0.003.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from super_sdf.surface.mesh import Mesh
from super_sdf.truth.solid import Distances, Points, Solid

SAMPLE_COUNT = 100_000
F1_DISTANCE = 0.003
SLIVER_ANGLE = 5.0  # degrees

Numbers = dict[str, float | None]
Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points (n, 3) sampled on a surface, and the unit normals (n, 3) of their faces."""

    points: Points
    normals: Points

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.points)

    def ordered(self) -> SurfacePoints:
        order = order_in_space(self.points)
        return SurfacePoints(self.points[order], self.normals[order])


# Stands for a result without a surface; it has no normal.
DOT = SurfacePoints(np.zeros((1, 3)), np.zeros((1, 3)))
# NC of a point without a normal: the mean of |n.n'| over all directions n.
NO_NORMAL_NC = 0.5


def face_vectors(mesh: Mesh) -> Points:
    """Return the normal of each face times twice its area, (m, 3), outward if counter-clockwise."""
    a, b, c = mesh.vertices[mesh.faces.T]
    return np.cross(b - a, c - a)


def sample_surface(mesh: Mesh, seed: tuple[int, int], count: int = SAMPLE_COUNT) -> SurfacePoints:
    """Return points sampled uniformly by area; of a mesh without area, one dot at the origin."""
    vectors = face_vectors(mesh)
    lengths = np.linalg.norm(vectors, axis=1)
    if not lengths.sum() > 0:
        return DOT
    random = np.random.default_rng(seed)
    face = draw_index(lengths, random.random(count))
    root, v = np.sqrt(random.random(count)), random.random(count)
    weights = np.stack([1 - root, root * (1 - v), root * v], axis=1)  # uniform in the triangle
    points = np.einsum("nk,nkd->nd", weights, mesh.vertices[mesh.faces[face]])
    return SurfacePoints(points, vectors[face] / lengths[face, None])


def order_in_space(points: Points) -> Indices:
    """Return an order, (n,), of points (n, 3) in which neighbours in space follow one another.

    A search for each of them then finds what it reads in the cache, and takes a third of the time.
    """
    return cKDTree(points).indices


def draw_index(weights: Distances, uniform: Distances) -> Indices:
    """Return indices (n,) drawn in proportion to weights (m,), from numbers in [0, 1), (n,)."""
    cumulative = np.cumsum(weights)
    index = np.searchsorted(cumulative, uniform * cumulative[-1], side="right")
    return np.minimum(index, np.flatnonzero(weights)[-1])  # rounding may reach past the last one


def compare_samples(reference: SurfacePoints, result: SurfacePoints) -> Numbers:
    """Return CD (sum of mean squares), F1, recall and precision at 0.003, NC and signed NC."""
    there, there_at = result.tree.query(reference.points)
    back, back_at = reference.tree.query(result.points)
    there_nc = normal_agreement(reference.normals, result.normals[there_at])
    back_nc = normal_agreement(result.normals, reference.normals[back_at])
    recall, precision = (float(np.mean(far < F1_DISTANCE)) for far in (there, back))
    return {
        "cd": float(np.mean(there**2) + np.mean(back**2)),
        "f1": harmonic_mean(recall, precision),
        "recall": recall,
        "precision": precision,
        "nc": (there_nc[0] + back_nc[0]) / 2,
        "signed_nc": (there_nc[1] + back_nc[1]) / 2,
    }


def normal_agreement(normals: Points, others: Points) -> tuple[float, float]:
    """Return the means of |n.n'| and of n.n' over pairs of normals, (n, 3) each."""
    dot = np.einsum("nd,nd->n", normals, others)
    known = normals.any(1) & others.any(1)
    return float(np.where(known, np.abs(dot), NO_NORMAL_NC).mean()), float(dot.mean())


def harmonic_mean(recall: float, precision: float) -> float:
    total = recall + precision
    return float(2 * recall * precision / total) if total > 0 else 0.0


def compare_distances(there: Distances, back: Distances) -> Numbers:
    """Return the mean, 99th percentile and maximum of point-to-triangle distances, both ways.

    ``there`` are those from P to the result's triangles, ``back`` those from Q to the reference's:
    see ``nearest_or_dot``. Figures without a direction are the mean of both, or the larger maximum.
    """
    mean, p99 = (there.mean(), back.mean()), (np.quantile(there, 0.99), np.quantile(back, 0.99))
    most = there.max(), back.max()
    whole = {"p2s": float(sum(mean)) / 2, "p99": float(sum(p99)) / 2, "max": float(max(most))}
    for name, pair in (("p2s", mean), ("p99", p99), ("max", most)):
        whole |= {f"{name}_there": float(pair[0]), f"{name}_back": float(pair[1])}
    return whole


def nearest_or_dot(solid: Solid, points: Points) -> tuple[Distances, Indices]:
    """Return the distances of points to a mesh, (n,), and their nearest triangles, (n,).

    If it has no faces, the distances are those to the origin, and the triangles -1.
    """
    if not len(solid.mesh.faces):
        return np.linalg.norm(points, axis=1), np.full(len(points), -1)
    distances, faces, _ = solid.nearest(points)
    if not np.isfinite(distances).all():
        raise ValueError("a point-to-triangle distance is not finite")
    return distances, faces


def distance_or_dot(solid: Solid, points: Points) -> Distances:
    return nearest_or_dot(solid, points)[0]


def distance(truth: Mesh, mesh: Mesh, count: int, within: Points | None = None) -> float:
    """Return the mean distance between two surfaces, both ways, at points drawn from each.

    NaN without a mesh. ``within``, (3,), leaves out caps: points beside the border of the box from
    the origin to there.
    """
    if not len(mesh.faces):
        return float("nan")
    total = 0.0
    for seed, (one, other) in enumerate(((truth, mesh), (mesh, truth)), 1):
        points = sample_surface(one, (1, seed), count).points
        if within is not None:
            points = points[((points > 0.1) & (points < within - 0.1)).all(1)]
        total += float(Solid(other).distance(points).mean()) / 2 if len(points) else np.inf
    return total


def compare_triangles(mesh: Mesh) -> Numbers:
    """Return the smallest angle in degrees, and the share of triangles with one under 5 degrees.

    Both are None for a mesh without faces. A triangle without area has an angle of 0.
    """
    if not len(mesh.faces):
        return {"min_angle": None, "slivers": None}
    corners = mesh.vertices.astype(np.float64)[mesh.faces]  # (m, 3, 3)
    ahead, back = (np.roll(corners, step, axis=1) - corners for step in (-1, 1))
    sine = np.linalg.norm(np.cross(ahead, back), axis=2)
    cosine = np.einsum("mkd,mkd->mk", ahead, back)
    angles = np.degrees(np.arctan2(sine, cosine)).min(axis=1)
    return {"min_angle": float(angles.min()), "slivers": float(np.mean(angles < SLIVER_ANGLE))}
