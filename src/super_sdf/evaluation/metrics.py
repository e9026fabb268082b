"""The quality metrics of NMC, NDC, VoroMesh and PoNQ.

All lengths are in units of the reference's box diagonal. P are points sampled on the reference, Q
points sampled on the result.

References
----------
Chen and Zhang, Neural Marching Cubes (2021): F1 at 0.003, edge points, ECD and EF1 at 0.005.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..arrays import IntArray
from ..mesh import Mesh
from ..truth.solid import Distances, Points, Solid

SAMPLE_COUNT = 100_000
F1_DISTANCE = 0.003
EDGE_DISTANCE = 0.005
SHARP_COSINE = np.cos(np.radians(30))
# A point is an edge point if the normal of another point within this radius differs by more.
EDGE_RADIUS = 0.004
# Nearest points that are examined: all within the radius if the area is over 0.1. On a tiny result,
# with all 1e5 points within the radius, it bounds the work.
EDGE_NEIGHBOURS = 64

Numbers = dict[str, float | None]


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points (n, 3) sampled on a surface, and the unit normals (n, 3) of their faces."""

    points: Points
    normals: Points


# Stands for a result without a surface; it has no normal.
DOT = SurfacePoints(np.zeros((1, 3)), np.zeros((1, 3)))
# NC of a point without a normal: the mean of |n.n'| over all directions n.
NO_NORMAL_NC = 0.5


def normalise(mesh: Mesh) -> Mesh:
    """Return a mesh, float64, centred on its bounding box and scaled to a box diagonal of 1."""
    vertices = mesh.vertices.astype(np.float64)
    low, high = vertices.min(0), vertices.max(0)
    return Mesh((vertices - (low + high) / 2) / np.linalg.norm(high - low), mesh.faces)


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


def draw_index(weights: Distances, uniform: Distances) -> NDArray[np.intp]:
    """Return indices (n,) drawn in proportion to weights (m,), from numbers in [0, 1), (n,)."""
    cumulative = np.cumsum(weights)
    index = np.searchsorted(cumulative, uniform * cumulative[-1], side="right")
    return np.minimum(index, np.flatnonzero(weights)[-1])  # rounding may reach past the last one


def compare_samples(reference: SurfacePoints, result: SurfacePoints) -> Numbers:
    """Return CD (sum of mean squares), F1, recall and precision at 0.003, NC and signed NC."""
    there, there_at = cKDTree(result.points).query(reference.points)
    back, back_at = cKDTree(reference.points).query(result.points)
    there_nc = normal_agreement(reference.normals, result.normals[there_at])
    back_nc = normal_agreement(result.normals, reference.normals[back_at])
    recall, precision = np.mean(there < F1_DISTANCE), np.mean(back < F1_DISTANCE)
    return {
        "cd": float(np.mean(there**2) + np.mean(back**2)),
        "f1": harmonic_mean(recall, precision),
        "recall": float(recall),
        "precision": float(precision),
        "nc": (there_nc[0] + back_nc[0]) / 2,
        "signed_nc": (there_nc[1] + back_nc[1]) / 2,
    }


def normal_agreement(normals: Points, others: Points) -> tuple[float, float]:
    """Return the means of |n.n'| and of n.n' over pairs of normals, (n, 3) each."""
    dot = np.einsum("nd,nd->n", normals, others)
    known = normals.any(1) & others.any(1)
    return float(np.where(known, np.abs(dot), NO_NORMAL_NC).mean()), float(dot.mean())


def harmonic_mean(recall: float, precision: float) -> float:
    """Return 2rp/(r + p), 0 if both are 0."""
    total = recall + precision
    return float(2 * recall * precision / total) if total > 0 else 0.0


def compare_surfaces(
    reference: Solid, result: Mesh, drawn: SurfacePoints, result_drawn: SurfacePoints
) -> Numbers:
    """Return exact point-to-triangle distances: mean, 99th percentile and maximum, both ways.

    ``drawn`` is P, ``result_drawn`` Q. "there" is from P to the result's triangles, "back" from Q
    to the reference's. Figures without a direction are the mean of both, or the larger maximum.
    """
    there = distance_or_dot(Solid(result), drawn.points)
    back = distance_or_dot(reference, result_drawn.points)
    mean, p99 = (there.mean(), back.mean()), (np.quantile(there, 0.99), np.quantile(back, 0.99))
    return {
        "p2s": float(sum(mean)) / 2,
        "p2s_there": float(mean[0]),
        "p2s_back": float(mean[1]),
        "p99": float(sum(p99)) / 2,
        "p99_there": float(p99[0]),
        "p99_back": float(p99[1]),
        "max": float(max(there.max(), back.max())),
        "max_there": float(there.max()),
        "max_back": float(back.max()),
    }


def distance_or_dot(solid: Solid, points: Points) -> Distances:
    """Return the distances of points to a mesh, (n,), or to the origin if it has no faces."""
    if not len(solid.mesh.faces):
        radii: Distances = np.linalg.norm(points, axis=1)
        return radii
    distances = solid.distance(points)
    if not np.isfinite(distances).all():
        count = np.sum(~np.isfinite(distances))
        raise ValueError(f"{count} point-to-triangle distances are not finite")
    return distances


def sample_edges(
    vertices: Points, edges: IntArray, seed: tuple[int, int], count: int = SAMPLE_COUNT
) -> Points:
    """Return points (count, 3) sampled uniformly by length on edges (e, 2); none without edges."""
    ends = vertices[edges]  # (e, 2, 3)
    if not len(ends):
        return np.zeros((0, 3))
    random = np.random.default_rng(seed)
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    low, high = ends[draw_index(lengths, random.random(count))].swapaxes(0, 1)
    return low + random.random((count, 1)) * (high - low)


def sharp_edges(mesh: Mesh) -> IntArray:
    """Return the edges (e, 2) of exactly two faces whose normals differ by over 30 degrees."""
    vectors = face_vectors(mesh)
    lengths = np.linalg.norm(vectors, axis=1)
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    _, first, count = np.unique(edges[order], axis=0, return_index=True, return_counts=True)
    pairs = order[first[count == 2][:, None] + [0, 1]]
    one, other = pairs.T // 3
    # A face without area has no normal, so its edges have no angle.
    whole = (lengths[one] > 0) & (lengths[other] > 0)
    dot = np.einsum("nd,nd->n", vectors[one], vectors[other])
    return edges[pairs[whole & (dot < SHARP_COSINE * lengths[one] * lengths[other]), 0]]


def edge_points(drawn: SurfacePoints) -> Points:
    """Return the points (k, 3) that lie near a sharp edge.

    As in NMC, NDC and PoNQ, these are the points with another one nearby whose normal differs by
    more than the angle of `sharp_edges`, whatever its sign: the two sides of a thin sheet are no
    edge.
    """
    points, normals = drawn.points, drawn.normals
    # Missing neighbours have the index n; the point itself replaces them, which is no edge.
    nearby = cKDTree(points).query(points, EDGE_NEIGHBOURS, distance_upper_bound=EDGE_RADIUS)[1]
    nearby = np.where(nearby == len(points), np.arange(len(points))[:, None], nearby)
    turned = np.zeros(len(points), bool)
    for column in nearby.T:
        turned |= np.abs(np.einsum("nd,nd->n", normals, normals[column])) < SHARP_COSINE
    return points[turned]


def compare_edges(vertices: Points, edges: IntArray, drawn: Points, result: Points) -> Numbers:
    """Return ECD (sum of mean squares) and EF1 at 0.005, both None without edges.

    Parameters
    ----------
    vertices, edges : (n, 3) float, (e, 2) int
        Sharp edges of the reference. The distance to them is exact: a search among points is slow
        where many are equally far, as those of a circle are from its axis.
    drawn : (m, 3) float
        Points sampled on these edges.
    result : (k, 3) float
        Edge points of the result; if there are none, a dot at the origin.
    """
    if not len(edges):
        return {"ecd": None, "ef1": None}
    result = result if len(result) else DOT.points
    there = cKDTree(result).query(drawn)[0]
    back = np.sqrt(igl.point_mesh_squared_distance(result, vertices, edges)[0])
    recall, precision = np.mean(there < EDGE_DISTANCE), np.mean(back < EDGE_DISTANCE)
    return {
        "ecd": float(np.mean(there**2) + np.mean(back**2)),
        "ef1": harmonic_mean(recall, precision),
    }
