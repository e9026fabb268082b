"""A mesh cut into slabs, in which its distances and its intersections are found.

Search trees of small meshes are quicker and take less memory, and slabs can be worked on in several
processes: libigl holds Python's lock, so threads would wait for each other.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass

import igl.predicates
import numpy as np
from numpy.typing import NDArray

from ..errors import SuperSdfError
from ..batch.pool import Death, Pool, Work
from ..surface.mesh import Mesh
from ..truth.mesh_files import without_unused
from ..truth.solid import Distances, Points, Solid

FACES_IN_SLAB = 1 << 19


@dataclass(frozen=True, eq=False)
class MeshSlab:
    """The triangles of a mesh that reach into a slab or are near it, and points in the slab."""

    mesh: Mesh
    axis: int
    first: float  # its range on the axis
    last: float
    points: Points  # (k, 3)
    rows: NDArray[np.intp]  # (k,): their numbers among those of all slabs
    counts: bool  # whether intersections are counted


@dataclass(frozen=True, eq=False)
class Found:
    """What was found in a slab, or in all of them."""

    intersections: int | None  # pairs of triangles; None if they were not counted
    distances: Distances  # (k,), of the points to the nearest triangle
    feet: Points  # (k, 3), the nearest points of the mesh
    cosines: Distances  # (k,), between the ways from there and the normals of the triangles


def search(
    mesh: Mesh, points: Points, reach: float, *, intersections: bool, processes: int = 1
) -> Found:
    """Return the nearest points of a mesh, and the number of its self-intersections.

    Slabs look up to the distance ``reach``; points farther away are looked up in the whole mesh.
    """
    can_count = hasattr(igl.predicates, "find_self_intersections")  # in this version of libigl
    slabs = MeshSlabs(mesh, points, reach, counts=intersections and can_count)
    total, n = 0, len(points)
    distances, feet, cosines = np.empty(n), np.empty((n, 3)), np.empty(n)
    for rows, part in _search_all(slabs, min(processes, len(slabs))):
        distances[rows], feet[rows], cosines[rows] = part.distances, part.feet, part.cosines
        total += part.intersections or 0
    far = np.flatnonzero(distances > reach)
    if len(far):
        distances[far], feet[far], cosines[far] = _nearest(mesh, points[far])
    return Found(total if slabs.counts else None, distances, feet, cosines)


def _nearest(mesh: Mesh, points: Points) -> tuple[Distances, Points, Distances]:
    """Return distances, feet and cosines: see ``Found``; the cosine at no triangle's side is 0."""
    distances, faces, feet = Solid(mesh).nearest(points)
    a, b, c = mesh.vertices[mesh.faces[faces].T].astype(np.float64)
    normals, ways = np.cross(b - a, c - a), points - feet
    sizes = np.linalg.norm(normals, axis=1) * distances
    dots = np.einsum("ij,ij->i", ways, normals)
    return distances, feet, np.divide(dots, sizes, out=np.zeros(len(points)), where=sizes > 0)


def self_intersections(mesh: Mesh) -> int | None:
    """Return the number of pairs of a mesh's triangles that intersect; None if libigl has no test.

    Vertices at the same position must be one vertex.
    """
    return search(mesh, np.empty((0, 3)), 0.0, intersections=True).intersections


class MeshSlabs:
    """A queue of slabs along the longest axis, in which about equally many triangles begin.

    Each is made when it is taken. It has the triangles within ``reach`` of it, so distances up to
    that are those to the whole mesh.
    """

    def __init__(self, mesh: Mesh, points: Points, reach: float, *, counts: bool) -> None:
        self.mesh, self.points, self.reach, self.counts = mesh, points, reach, counts
        self.axis = int(np.ptp(mesh.vertices, axis=0).argmax())
        along = mesh.vertices[:, self.axis][mesh.faces]
        self.low, self.high = along.min(1), along.max(1)
        shares = np.linspace(0, 1, len(mesh.faces) // FACES_IN_SLAB + 2)[1:-1]
        inner = np.unique(np.quantile(self.low, shares, method="lower"))
        self.ranges = deque(itertools.pairwise([-np.inf, *inner.tolist(), np.inf]))

    def __len__(self) -> int:
        return len(self.ranges)

    def popleft(self) -> MeshSlab:
        """Return the next slab."""
        first, last = self.ranges.popleft()
        near = (self.low < last + self.reach) & (self.high >= first - self.reach)
        along = self.points[:, self.axis]
        rows = np.flatnonzero((along >= first) & (along < last))
        mesh = without_unused(self.mesh.vertices, self.mesh.faces[near])
        mesh = Mesh(mesh.vertices.astype(np.float64), mesh.faces)
        return MeshSlab(mesh, self.axis, first, last, self.points[rows], rows, self.counts)


def _search_all(slabs: MeshSlabs, processes: int) -> Iterator[tuple[NDArray[np.intp], Found]]:
    """Yield the rows of each slab's points and what was found; in any order from processes."""
    if processes < 2:
        while len(slabs):
            slab = slabs.popleft()
            yield slab.rows, _search_slab(slab)
        return
    with closing(Pool(slabs, _prepare).results(processes)) as results:
        for slab, found in results:
            if isinstance(found, Death):
                raise SuperSdfError(f"a process that checked a part of the mesh {found.cause}")
            yield slab.rows, found


def _prepare() -> Work:
    """Return what works at a slab: each worker process calls this once."""
    return _search_slab


def _search_slab(slab: MeshSlab) -> Found:
    count = _count_intersections(slab) if slab.counts else None
    return Found(count, *_nearest(slab.mesh, slab.points))


def _count_intersections(slab: MeshSlab) -> int:
    """Return the number of pairs that intersect, whose common range begins in a slab."""
    vertices, faces = slab.mesh.vertices, slab.mesh.faces
    along = vertices[:, slab.axis][faces]
    low, high = along.min(1), along.max(1)
    whole = (faces != np.roll(faces, 1, axis=1)).all(1)  # with three vertices, and so an area
    rows = np.flatnonzero(whole & (low < slab.last) & (high >= slab.first))
    pairs = igl.predicates.find_self_intersections(vertices, faces[rows].astype(np.int64))[1]
    begin = low[rows][pairs].max(1, initial=-np.inf)
    return int(np.count_nonzero((begin >= slab.first) & (begin < slab.last)))
