"""How near meshes are to true ones: Chamfer distance, F1, normals and sharp edges, as in papers.

Lengths are in units of the diagonal of the reference's bounding box. P are 1e5 points drawn from
the reference, uniformly by area, Q those from the mesh. Needs the extra ``eval``.

>>> from super_sdf import evaluate
>>> evaluate([mesh], ["true.ply"])["f1"].mean()                          # doctest: +SKIP

References
----------
Chen and Zhang, Neural Marching Cubes (2021): F1 at 0.003; edge points, ECD and EF1 at 0.005.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from .arrays import IntArray, face_normals
from .errors import MeshError, OptionError, check_modules, seen
from .surface.mesh import Mesh, check_mesh
from .truth import Distances, Points, Solid, read_mesh

Indices = NDArray[np.int64]
Given: TypeAlias = Mesh | str | Path

F1_DISTANCE, EDGE_DISTANCE = 0.003, 0.005
VOXEL_SHARE = 0.1  # of a voxel: the distance of EFv
NO_NORMAL_NC = 0.5  # of the dot, which has no normal: the mean of |n.n'| over all directions
SAMPLE_COUNT = 100_000
SHARP_COSINE = np.cos(np.radians(30))
# A point is an edge point if the normal of another point within this radius differs by more.
EDGE_RADIUS = 0.004
# Nearest points that are examined: all within the radius if the area is over 0.1. On a tiny result,
# with all 1e5 points within the radius, it bounds the work.
EDGE_NEIGHBOURS = 64
REFERENCE_POINTS, REFERENCE_EDGES, RESULT_POINTS, RESULT_EDGES = 0, 1, 2, 4  # streams of numbers


def evaluate(
    meshes: Given | Sequence[Given],
    references: Given | Sequence[Given],
    *,
    spacing: ArrayLike | None = None,
) -> dict[str, Distances]:
    """Measure meshes beside their references, in the same world coordinates.

    Parameters
    ----------
    meshes, references : Mesh or path, or a sequence of these
        As many of either. A mesh without triangles counts as a point at the middle of the
        reference's box, as a method that fails does in papers.
    spacing : number or one for each mesh, optional
        World distance between the samples of the coarse grid, for "efv".

    Returns
    -------
    dict of (n,) float64
        A figure of each mesh, NaN where there is none, as for edges of a reference without any.
        Papers quote the mean over meshes.

        - "cd": Chamfer distance, mean_P d^2 + mean_Q d^2, by the nearest point of the other set
        - "f1": harmonic mean of the shares of points of P and of Q with d < 0.003
        - "nc": normal consistency, mean absolute cosine to the normal of the nearest point
        - "p2s": mean distance from points to triangles, both ways; "max": the largest
        - "ecd", "ef1": CD, and F1 at 0.005, of points near sharp edges, of over 30 degrees
        - "efv": F1 of points on sharp edges, within a tenth of the spacing

    Raises
    ------
    SuperSdfError
        If there are not as many of either, or the arrays of a mesh are no mesh; if a reference has
        no area; if a file cannot be read, or the extra ``eval`` is not installed.
    """
    check_modules("evaluating", "eval")
    some, true = ([each] if isinstance(each, Given) else each for each in (meshes, references))
    if len(some) != len(true):
        raise OptionError(f"there are {len(some)} meshes and {len(true)} references: give as many")
    steps = np.ravel(np.nan if spacing is None else spacing).astype(np.float64)
    if len(steps) not in (1, len(some)):
        raise OptionError(f"spacing is {seen(spacing)}: give a number, or one for each mesh")
    rows = list[list[float | None]]()
    for mesh, reference, step in zip(some, true, np.broadcast_to(steps, len(some)).tolist()):
        truth = _read(reference)
        frame = frame_of(truth)
        placed = None if np.isnan(step) else step / frame[1]
        pair = Comparison(Reference(in_frame(truth, *frame)), in_frame(_read(mesh), *frame), placed)
        rows.append([figure(pair) for figure in FIGURES.values()])
    return dict(zip(FIGURES, np.array(rows, np.float64).reshape(-1, len(FIGURES)).T))


def _read(mesh: Given) -> Mesh:
    """Return a mesh, read from a file or checked."""
    read = read_mesh(mesh) if isinstance(mesh, (str, Path)) else mesh
    check_mesh(read)
    return read


def frame_of(reference: Mesh) -> tuple[NDArray[np.float64], float]:
    """Return the middle of the bounding box and its diagonal; MeshError for one without area."""
    if not reference.area() > 0:
        raise MeshError("a reference has no area: give a surface")
    vertices = reference.vertices.astype(np.float64)
    low, high = vertices.min(0), vertices.max(0)
    return (low + high) / 2, float(np.linalg.norm(high - low))


def in_frame(mesh: Mesh, middle: NDArray[np.float64], size: float) -> Mesh:
    """Return a mesh, float64, in units of a size from a middle."""
    return Mesh((mesh.vertices.astype(np.float64) - middle) / size, mesh.faces)


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points (n, 3) sampled on a surface, and the unit normals (n, 3) of their faces."""

    points: Points
    normals: Points

    @cached_property
    def tree(self) -> Any:
        """Return a search tree of the points."""
        return cKDTree(self.points)


DOT = SurfacePoints(np.zeros((1, 3)), np.zeros((1, 3)))  # stands for a result without a surface


def sample_surface(mesh: Mesh, seed: tuple[int, int], count: int = SAMPLE_COUNT) -> SurfacePoints:
    """Return points sampled uniformly by area, in the order of ``order_in_space``.

    Of a mesh without area it is one dot at the origin.
    """
    vectors = face_normals(mesh.vertices, mesh.faces)
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


@dataclass(frozen=True, eq=False)
class EdgeCurves:
    """The sharp edges of a mesh, and points drawn from them."""

    vertices: Points  # (n, 3), of the mesh
    edges: IntArray  # (e, 2), the ends of each sharp edge
    drawn: Points  # (m, 3), uniform by length, in the order of ``order_in_space``

    @classmethod
    def of(cls, mesh: Mesh, seed: tuple[int, int]) -> EdgeCurves:
        """Return those of a mesh."""
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
        import igl

        return np.sqrt(igl.point_mesh_squared_distance(points, self.vertices, self.edges)[0])


def sharp_edges(mesh: Mesh) -> IntArray:
    """Return the edges (e, 2) of exactly two faces whose normals differ by over 30 degrees."""
    vectors = face_normals(mesh.vertices, mesh.faces)
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


class Reference:
    """A true mesh in its frame, float64, and what is drawn from it for all results."""

    def __init__(self, mesh: Mesh) -> None:
        self.solid = Solid(mesh)
        self.mesh = self.solid.mesh
        self.drawn = sample_surface(self.mesh, self.seed(REFERENCE_POINTS))
        self.sharp = EdgeCurves.of(self.mesh, self.seed(REFERENCE_EDGES))

    def seed(self, stream: int) -> tuple[int, int]:
        """Return the seed of a stream of random numbers."""
        return 0, stream


@dataclass(frozen=True, eq=False)
class Comparison:
    """A result beside its reference, and what figures need of both, each computed when asked for.

    Of two arrays the first is measured from the reference to the result. A mesh without faces
    counts as a dot at the origin.
    """

    reference: Reference
    mesh: Mesh
    spacing: float | None = None  # of the coarse grid, if there is one

    @cached_property
    def drawn(self) -> SurfacePoints:
        """Points drawn from the mesh."""
        return sample_surface(self.mesh, self.reference.seed(RESULT_POINTS))

    @cached_property
    def solid(self) -> Solid:
        """The mesh, with search trees."""
        return Solid(self.mesh)

    @cached_property
    def near(self) -> tuple[tuple[Distances, Distances], tuple[Indices, Indices]]:
        """The distances of P to the nearest of Q and of Q to P, and the indices of these points."""
        p, q = self.reference.drawn, self.drawn
        (there, in_q), (back, in_p) = q.tree.query(p.points), p.tree.query(q.points)
        return (there, back), (in_q, in_p)

    @cached_property
    def cosines(self) -> tuple[Distances, Distances]:
        """n.n' of each point and the nearest of the other set."""
        p, q, (in_q, in_p) = self.reference.drawn.normals, self.drawn.normals, self.near[1]
        return np.einsum("nd,nd->n", p, q[in_q]), np.einsum("nd,nd->n", q, p[in_p])

    @cached_property
    def there(self) -> Distances:
        """Distances of P to the nearest triangles of the result."""
        return nearest_or_dot(self.solid, self.reference.drawn.points)[0]

    @cached_property
    def back(self) -> tuple[Distances, Indices]:
        """Distances of Q to the nearest triangles of the reference, and these."""
        return nearest_or_dot(self.reference.solid, self.drawn.points)

    @cached_property
    def edges_apart(self) -> tuple[Distances, Distances] | None:
        """Distances of points on the reference's edges to edge points of Q, and back to edges."""
        if not self.reference.sharp:
            return None
        points = edge_points(self.drawn)
        points = points if len(points) else DOT.points
        there = cKDTree(points).query(self.reference.sharp.drawn)[0]
        return there, self.reference.sharp.distance(points)


def chamfer(there: Distances, back: Distances) -> float:
    """Return the sum of the mean squared distances both ways."""
    return float(np.mean(there**2) + np.mean(back**2))


def f1(there: Distances, back: Distances, reach: float) -> float:
    """Return the harmonic mean of the shares of distances under a reach, 0 if both are 0."""
    recall, precision = float(np.mean(there < reach)), float(np.mean(back < reach))
    return 2 * recall * precision / ((recall + precision) or 1.0)


def normal_consistency(c: Comparison) -> float:
    """Return the mean absolute cosine of the angles between normals, both ways."""
    there, back = (float(np.abs(cosines).mean()) for cosines in c.cosines)
    return (there + back) / 2 if c.drawn.normals.any() else NO_NORMAL_NC


def edge_f1_in_voxels(c: Comparison) -> float | None:
    """Return EFv, 0 for a result without sharp edges.

    The edge points of EF1 lie up to 0.004 beside an edge: at 64^3 a perfect result would score 0.5.
    """
    sharp = c.reference.sharp
    if c.spacing is None or not sharp:
        return None
    curves = EdgeCurves.of(c.solid.mesh, c.reference.seed(RESULT_EDGES))
    if not curves:
        return 0.0
    there, back = curves.distance(sharp.drawn), sharp.distance(curves.drawn)
    return f1(there, back, VOXEL_SHARE * c.spacing)


Measure = Callable[[Comparison], "float | None"]
FIGURES: dict[str, Measure] = {
    "cd": lambda c: chamfer(*c.near[0]),
    "f1": lambda c: f1(*c.near[0], F1_DISTANCE),
    "nc": normal_consistency,
    "p2s": lambda c: float(c.there.mean() + c.back[0].mean()) / 2,
    "max": lambda c: float(max(c.there.max(), c.back[0].max())),
    "ecd": lambda c: chamfer(*c.edges_apart) if c.edges_apart else None,
    "ef1": lambda c: f1(*c.edges_apart, EDGE_DISTANCE) if c.edges_apart else None,
    "efv": edge_f1_in_voxels,
}
"""The figures of a result, as ``evaluate`` has them."""
