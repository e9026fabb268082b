"""How near meshes are to true ones: Chamfer distance, F1, normals and sharp edges, as in papers.

Needs the extra ``eval``.

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

from .arrays import IntArray, dot, length
from .errors import MeshError, OptionError, OptionTypeError, check_modules, seen
from .surface.mesh import Mesh, check_mesh
from .truth import Distances, Points, Solid, read_mesh

Indices = NDArray[np.int64]
Given: TypeAlias = Any  # a Mesh, another object with vertices and faces, or a path

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
RESULT = 1  # the stream of random numbers for a result
DOT = Mesh(np.zeros((1, 3)), np.zeros((1, 3), np.int32))


def evaluate(
    meshes: Given | Sequence[Given],
    references: Given | Sequence[Given],
    *,
    spacing: ArrayLike | None = None,
) -> dict[str, Distances]:
    """Measure meshes against their references, in the same world coordinates.

    Lengths are in diagonals of the reference's bounding box. P and Q are 1e5 points each, drawn
    uniformly by area from reference and mesh. So even a mesh compared with itself has an F1 of only
    1 - exp(-2.83 / A), A the area in these units: 0.79 for a box of 1.2 x 1 x 0.6.

    Parameters
    ----------
    meshes, references : Mesh, mesh of trimesh, or path, or a sequence of these
        As many meshes as references. A mesh without triangles counts as a point at the middle of
        the reference's box, as failures do in papers.
    spacing : number or one for each mesh, optional
        World distance between the samples of the coarse grid, for "efv".

    Returns
    -------
    dict of (n,) float64
        One value per mesh, NaN if undefined, such as edges of a smooth reference. Papers quote the
        mean over meshes.

        - "cd": Chamfer distance, mean_P d^2 + mean_Q d^2, by the nearest point of the other set
        - "f1": harmonic mean of the shares of points of P and of Q with d < 0.003
        - "nc": normal consistency, mean absolute cosine to the normal of the nearest point
        - "p2s": mean distance from points to triangles, both ways; "max": the largest
        - "ecd", "ef1": CD, and F1 at 0.005, of points near sharp edges, of over 30 degrees
        - "efv": F1 of points on sharp edges, within a tenth of the spacing

    Raises
    ------
    SuperSdfError
        If the numbers of meshes and references differ; if the arrays of a mesh are invalid; if a
        reference has no area; if a file cannot be read, or the extra ``eval`` is not installed.
    """
    check_modules("evaluating", "eval")
    some, true = (np.array(each, object, ndmin=1) for each in (meshes, references))
    if len(some) != len(true):
        counts = f"there are {len(some)} meshes and {len(true)} references"
        raise OptionError(f"{counts}: give as many of Mesh(vertices, faces) or paths")
    steps = np.ravel(np.nan if spacing is None else spacing).astype(np.float64)
    if len(steps) not in (1, len(some)):
        raise OptionError(f"spacing is {seen(spacing)}: give a number, or one for each mesh")
    rows = list[list[float | None]]()
    for mesh, reference, step in zip(some, true, np.broadcast_to(steps, len(some)).tolist()):
        truth = _read(reference)
        frame = frame_of(truth)
        placed = None if np.isnan(step) else step * frame[0][0, 0]
        shown = Sampled(truth.transformed(*frame))
        pair = Comparison(shown, _read(mesh).transformed(*frame), placed)
        rows.append([figure(pair) for figure in FIGURES.values()])
    return dict(zip(FIGURES, np.array(rows, np.float64).reshape(-1, len(FIGURES)).T))


def _read(mesh: Given) -> Mesh:
    """Return a mesh, checked, of a file or of any object with ``vertices`` and ``faces``."""
    read: Any = read_mesh(mesh) if isinstance(mesh, (str, Path)) else mesh
    if not (hasattr(read, "vertices") and hasattr(read, "faces")):
        raise OptionTypeError(f"mesh is {seen(mesh)}: give Mesh(vertices, faces) or a path")
    made = Mesh(np.asarray(read.vertices), np.asarray(read.faces))
    check_mesh(made)
    return made


def frame_of(reference: Mesh) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what to transform meshes by: the matrix, which scales to a diagonal of 1, and shift.

    MeshError for a reference without area.
    """
    if not reference.area() > 0:
        raise MeshError("a reference has no area: give a surface")
    low, high = (end(reference.vertices, 0).astype(np.float64) for end in (np.min, np.max))
    scale = 1 / np.linalg.norm(high - low)
    return scale * np.eye(3), -scale * (low + high) / 2


class Sampled:
    """A mesh in the frame of its reference, and what is drawn from it with a seed.

    A mesh without triangles counts as a triangle without area, a dot, at the origin.
    """

    def __init__(self, mesh: Mesh, seed: Sequence[int] = (0,), count: int = SAMPLE_COUNT) -> None:
        self.solid, self.seed, self.count = Solid(mesh if len(mesh.faces) else DOT), seed, count
        self.mesh = self.solid.mesh

    @cached_property
    def _library(self) -> Any:
        """The mesh as one of trimesh."""
        import trimesh

        return trimesh.Trimesh(self.mesh.vertices, self.mesh.faces, process=False)

    @cached_property
    def drawn(self) -> tuple[Points, Points]:
        """Points (n, 3), uniform by area, and the normals there; of a dot one, and 0."""
        from trimesh.sample import sample_surface

        count = self.count if self._library.area else 1
        points, faces = sample_surface(self._library, count, seed=self.seed)
        order = np.argsort(faces)  # so that neighbours mostly follow one another: fast to search
        return points[order], self._library.face_normals[faces[order]]

    @cached_property
    def tree(self) -> Any:
        """A search tree of the points drawn."""
        return cKDTree(self.drawn[0])

    @cached_property
    def edges(self) -> IntArray:
        """The edges (e, 2) of exactly two faces whose normals differ by over 30 degrees."""
        normals = self._library.face_normals[self._library.face_adjacency]  # (n, 2, 3)
        is_sharp = dot(normals[:, 0], normals[:, 1]) < SHARP_COSINE
        # A face without area has no normal, so its edges have no angle.
        is_sharp &= normals.any(2).all(1)
        return np.asarray(self._library.face_adjacency_edges[is_sharp])

    @cached_property
    def drawn_from_edges(self) -> Points:
        """Points (n, 3) on the sharp edges, uniform by length."""
        low, high = self.mesh.vertices[self.edges].swapaxes(0, 1)
        lengths, random = length(high - low), np.random.default_rng(self.seed)
        edge = np.sort(random.choice(len(lengths), self.count, p=lengths / lengths.sum()))
        return low[edge] + random.random((self.count, 1)) * (high - low)[edge]

    def to_edges(self, points: Points) -> Distances:
        """Return the exact distance of points (k, 3) to the nearest sharp edge, (k,)."""
        import igl

        return np.sqrt(igl.point_mesh_squared_distance(points, self.mesh.vertices, self.edges)[0])

    @cached_property
    def near_edges(self) -> Points:
        """The points drawn, (k, 3), that lie near a sharp edge; the origin if there are none.

        As in NMC, NDC and PoNQ, these are the points with another one nearby whose normal differs
        by more than the angle of sharp edges, whatever its sign: the two sides of a thin sheet are
        no edge.
        """
        points, normals = self.drawn
        near = self.tree.query(points, EDGE_NEIGHBOURS, distance_upper_bound=EDGE_RADIUS)[1]
        or_none = np.append(normals, [[np.nan] * 3], axis=0)  # missing neighbours have the index n
        found = points[(np.abs(dot(normals[:, None], or_none[near])) < SHARP_COSINE).any(1)]
        return found if len(found) else DOT.vertices


@dataclass(frozen=True, eq=False)
class Comparison:
    """A result beside its reference, and what figures need of both, each computed when asked for.

    Of two arrays the first is measured from the reference to the result.
    """

    reference: Sampled
    mesh: Mesh
    spacing: float | None = None  # of the coarse grid, if there is one

    @cached_property
    def result(self) -> Sampled:
        """The mesh, and what is drawn from it."""
        return Sampled(self.mesh, (*self.reference.seed, RESULT))

    @cached_property
    def near(self) -> tuple[tuple[Distances, Distances], tuple[Indices, Indices]]:
        """The distances of P to the nearest of Q and of Q to P, and the indices of these points."""
        p, q = self.reference, self.result
        (there, in_q), (back, in_p) = q.tree.query(p.drawn[0]), p.tree.query(q.drawn[0])
        return (there, back), (in_q, in_p)

    @cached_property
    def cosines(self) -> tuple[Distances, Distances]:
        """n.n' of each point and the nearest of the other set."""
        p, q, (in_q, in_p) = self.reference.drawn[1], self.result.drawn[1], self.near[1]
        return dot(p, q[in_q]), dot(q, p[in_p])

    @cached_property
    def there(self) -> Distances:
        """Distances of P to the nearest triangles of the result."""
        return self.result.solid.distance(self.reference.drawn[0])

    @cached_property
    def back(self) -> tuple[Distances, Indices]:
        """Distances of Q to the nearest triangles of the reference, and these."""
        return self.reference.solid.nearest(self.result.drawn[0])[:2]

    @cached_property
    def edges_apart(self) -> tuple[Distances, Distances] | None:
        """Distances of points on the reference's edges to edge points of Q, and back to edges."""
        if not len(self.reference.edges):
            return None
        points = self.result.near_edges
        there = cKDTree(points).query(self.reference.drawn_from_edges)[0]
        return there, self.reference.to_edges(points)


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
    return (there + back) / 2 if c.result.drawn[1].any() else NO_NORMAL_NC


def edge_f1_in_voxels(c: Comparison) -> float | None:
    """Return EFv, 0 for a result without sharp edges.

    The edge points of EF1 lie up to 0.004 beside an edge: at 64^3 a perfect result would score 0.5.
    """
    if c.spacing is None or not len(c.reference.edges):
        return None
    if not len(c.result.edges):
        return 0.0
    there = c.result.to_edges(c.reference.drawn_from_edges)
    back = c.reference.to_edges(c.result.drawn_from_edges)
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
