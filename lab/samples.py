"""Points drawn from surfaces and from their sharp edges, and the distances of points to them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from super_sdf.arrays import IntArray
from super_sdf.surface.mesh import Mesh
from super_sdf.truth import Distances, Points, Solid

Indices = NDArray[np.int64]

SAMPLE_COUNT = 100_000
SHARP_COSINE = np.cos(np.radians(30))
# A point is an edge point if the normal of another point within this radius differs by more.
EDGE_RADIUS = 0.004
# Nearest points that are examined: all within the radius if the area is over 0.1. On a tiny result,
# with all 1e5 points within the radius, it bounds the work.
EDGE_NEIGHBOURS = 64


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points (n, 3) sampled on a surface, and the unit normals (n, 3) of their faces."""

    points: Points
    normals: Points

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.points)


DOT = SurfacePoints(np.zeros((1, 3)), np.zeros((1, 3)))  # stands for a result without a surface


def face_vectors(mesh: Mesh) -> Points:
    """Return the normal of each face times twice its area, (m, 3), outward if counter-clockwise."""
    a, b, c = mesh.vertices[mesh.faces.T]
    return np.cross(b - a, c - a)


def sample_surface(mesh: Mesh, seed: tuple[int, int], count: int = SAMPLE_COUNT) -> SurfacePoints:
    """Return points sampled uniformly by area, in the order of ``order_in_space``.

    Of a mesh without area it is one dot at the origin.
    """
    vectors = face_vectors(mesh)
    lengths = np.linalg.norm(vectors, axis=1)
    if not lengths.sum() > 0:
        return DOT
    random = np.random.default_rng(seed)
    face = draw_index(lengths, random.random(count))
    root, v = np.sqrt(random.random(count)), random.random(count)
    weights = np.stack([1 - root, root * (1 - v), root * v], axis=1)  # uniform in the triangle
    points = np.einsum("nk,nkd->nd", weights, mesh.vertices[mesh.faces[face]])
    order = order_in_space(points)
    return SurfacePoints(points[order], (vectors[face] / lengths[face, None])[order])


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


@dataclass(frozen=True, eq=False)
class EdgeCurves:
    """The sharp edges of a mesh, and points drawn from them."""

    vertices: Points  # (n, 3), of the mesh
    edges: IntArray  # (e, 2), the ends of each sharp edge
    drawn: Points  # (m, 3), uniform by length, in the order of ``order_in_space``

    @classmethod
    def of(cls, mesh: Mesh, seed: tuple[int, int]) -> EdgeCurves:
        edges, random = sharp_edges(mesh), np.random.default_rng(seed)
        ends = mesh.vertices[edges]  # (e, 2, 3)
        if not len(edges):
            return cls(mesh.vertices, edges, np.zeros((0, 3)))
        lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        low, high = ends[draw_index(lengths, random.random(SAMPLE_COUNT))].swapaxes(0, 1)
        drawn = low + random.random((SAMPLE_COUNT, 1)) * (high - low)
        return cls(mesh.vertices, edges, drawn[order_in_space(drawn)])

    def __bool__(self) -> bool:
        return len(self.edges) > 0

    def distance(self, points: Points) -> Distances:
        """Return the exact distance of points (k, 3) to the nearest edge, (k,)."""
        return np.sqrt(igl.point_mesh_squared_distance(points, self.vertices, self.edges)[0])


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
    points, normals, is_edge = drawn.points, drawn.normals, []
    for some in np.array_split(np.arange(len(points)), len(points) // 10_000 + 1):
        nearby = drawn.tree.query(points[some], EDGE_NEIGHBOURS, distance_upper_bound=EDGE_RADIUS)
        # Missing neighbours have the index n; the point itself replaces them, which is no edge.
        other = np.where(nearby[1] == len(points), some[:, None], nearby[1])
        cosine = np.abs(np.einsum("pd,pkd->pk", normals[some], normals[other]))
        is_edge.append((cosine < SHARP_COSINE).any(1))
    return points[np.concatenate(is_edge)]
