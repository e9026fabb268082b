"""What a result makes of the reference's sharp edges, and of the normals near them.

All lengths are in units of the reference's box diagonal, but where "voxels" is said: those are of
the coarse grid, with spacing h.

References
----------
Chen and Zhang, Neural Marching Cubes (2021): edge points, ECD and EF1 at 0.005.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from scipy.spatial import cKDTree

from super_sdf.arrays import IntArray
from super_sdf.surface.mesh import Mesh
from super_sdf.truth.solid import Distances, Points, Solid

from .metrics import (
    DOT,
    SAMPLE_COUNT,
    Indices,
    Numbers,
    SurfacePoints,
    distance_or_dot,
    draw_index,
    face_vectors,
    harmonic_mean,
    order_in_space,
)

EDGE_DISTANCE = 0.005
SHARP_COSINE = np.cos(np.radians(30))
# A point is an edge point if the normal of another point within this radius differs by more.
EDGE_RADIUS = 0.004
# Nearest points that are examined: all within the radius if the area is over 0.1. On a tiny result,
# with all 1e5 points within the radius, it bounds the work.
EDGE_NEIGHBOURS = 64
VOXEL_SHARE = 0.1  # of h: the distance of EFv
NO_NORMAL_ANGLE = 90.0  # degrees, of a result without a surface: the mean over all directions


@dataclass(frozen=True, eq=False)
class EdgeCurves:
    """The sharp edges of a mesh, and points drawn from them."""

    vertices: Points  # (n, 3), of the mesh
    edges: IntArray  # (e, 2), the ends of each sharp edge
    drawn: Points  # (m, 3), uniform by length, in the order of ``order_in_space``

    @classmethod
    def of(cls, mesh: Mesh, seed: tuple[int, int]) -> EdgeCurves:
        edges = sharp_edges(mesh)
        drawn = sample_edges(mesh.vertices, edges, seed)
        return cls(mesh.vertices, edges, drawn[order_in_space(drawn)])

    def distance(self, points: Points) -> Distances:
        """Return the exact distance of points (k, 3) to the nearest edge, (k,)."""
        return np.sqrt(igl.point_mesh_squared_distance(points, self.vertices, self.edges)[0])


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
    points, normals, is_edge = drawn.points, drawn.normals, []
    for some in np.array_split(np.arange(len(points)), len(points) // 10_000 + 1):
        nearby = drawn.tree.query(points[some], EDGE_NEIGHBOURS, distance_upper_bound=EDGE_RADIUS)
        # Missing neighbours have the index n; the point itself replaces them, which is no edge.
        other = np.where(nearby[1] == len(points), some[:, None], nearby[1])
        cosine = np.abs(np.einsum("pd,pkd->pk", normals[some], normals[other]))
        is_edge.append((cosine < SHARP_COSINE).any(1))
    return points[np.concatenate(is_edge)]


def compare_edges(reference: EdgeCurves, result: Points) -> Numbers:
    """Return ECD (sum of mean squares) and EF1 at 0.005, both None without edges.

    ``result`` are the edge points (k, 3) of the result; if there are none, a dot at the origin.
    """
    if not len(reference.edges):
        return {"ecd": None, "ef1": None}
    result = result if len(result) else DOT.points
    there, back = cKDTree(result).query(reference.drawn)[0], reference.distance(result)
    ecd = float(np.mean(there**2) + np.mean(back**2))
    return {"ecd": ecd, "ef1": edge_f1(there, back, EDGE_DISTANCE)}


def edge_f1(there: Distances, back: Distances, reach: float) -> float:
    return harmonic_mean(float(np.mean(there < reach)), float(np.mean(back < reach)))


def compare_in_voxels(
    reference: EdgeCurves, result: Solid, seed: tuple[int, int], spacing: float
) -> Numbers:
    """Return EFv and the mean distance of the reference's edges to the result, None without edges.

    EFv is the F1 of points on the sharp edges of both meshes, at a tenth of a voxel; 0 for a result
    without sharp edges. (The edge points of EF1 lie up to 0.004 beside an edge: at 64^3 a perfect
    result would score 0.5.) The distance is that of points on the reference's edges to the result's
    nearest triangle, in voxels: how much of the edges is cut off or stands proud.
    """
    if not len(reference.edges):
        return {"efv": None, "edge_distance": None}
    curves, efv = EdgeCurves.of(result.mesh, seed), 0.0
    if len(curves.edges):
        there, back = curves.distance(reference.drawn), reference.distance(curves.drawn)
        efv = edge_f1(there, back, VOXEL_SHARE * spacing)
    distances = distance_or_dot(result, reference.drawn)
    return {"efv": efv, "edge_distance": float(distances.mean() / spacing)}


def compare_angles(
    reference: Mesh, nearest: Indices, edges: EdgeCurves, drawn: SurfacePoints, spacing: float
) -> Numbers:
    """Return the mean angles between the result's normals and the reference's, in degrees.

    The normal of each point drawn from the result is compared with that of the ``nearest`` triangle
    (n,) of the reference: "near" for points within a coarse voxel of an edge of the reference,
    "beyond" for the others. None where there are no such points.
    """
    if not drawn.normals.any():
        near_angle = NO_NORMAL_ANGLE if len(edges.edges) else None
        return {"angle_near": near_angle, "angle_beyond": NO_NORMAL_ANGLE}
    vectors = face_vectors(reference)[nearest]
    dot = np.einsum("nd,nd->n", vectors, drawn.normals)
    with np.errstate(invalid="ignore"):  # NaN where a triangle has no area and so no normal
        angles = np.degrees(np.arccos(np.clip(dot / np.linalg.norm(vectors, axis=1), -1, 1)))
    near = np.zeros(len(angles), bool)
    if len(edges.edges):
        near = edges.distance(drawn.points) < spacing
    known = ~np.isnan(angles)
    parts = {"angle_near": angles[near & known], "angle_beyond": angles[~near & known]}
    return {name: float(part.mean()) if len(part) else None for name, part in parts.items()}
