"""Passes of collapsing edges with pyfqmr: where the result is wrong, they are made anew.

pyfqmr is fast quadric mesh simplification (Forstmann): an edge is collapsed if the sum of squared
distances of the new vertex to the planes of the triangles it replaces is under a threshold, which
rises in every round. It neither bounds the distance of triangles nor keeps every mesh a manifold.
So each pass simplifies what the one before made, and what the last one made is looked at. Where it
is too far from the unsimplified mesh, or not a manifold, the triangles around the place are kept in
the first pass that got it wrong, and this pass and those after it are made anew.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyfqmr import Simplify

from ..arrays import BoolArray, IntArray
from ..surface.mesh import Mesh, row_keys
from ..progress import ShareCallback
from ..truth.solid import Points, Solid
from .measuring import Original, mean_side

ONE_AT_A_TIME = Lock()  # pyfqmr has one mesh, in global variables
# Edges are collapsed while the new vertex is within this many errors of the planes around it (root
# of the sum of squares), in each pass. What an early pass gets wrong costs most time, so they rise;
# with an end of 1.4 or 2.8, more triangles are left.
PLANE_DISTANCES = 1.0, 1.4, 1.7, 2.0, 2.0
ROUNDS, RISE = 30, 3.0  # of the threshold to its end; from more rounds, meshes get no smaller
LARGE = 1 << 12  # triangles from which on rounds take time: fewer serve nearly as well
FEW_ROUNDS, STEEP_RISE = 8, 5.0
MOST_REPEATS = 16  # of passes, before smaller distances are tried
HALVINGS = 3
LEFT = 0.85  # share of the work that is left after passes: a guess
ANYWHERE: Points = np.zeros((0, 3))

Collapse = Callable[[Mesh, BoolArray], Mesh]
"""Collapses edges of a mesh, but those of the triangles in a mask, (m,)."""


class Rounds:
    """Counts rounds of collapsing and measuring, whose number is not known before."""

    def __init__(self, progress: ShareCallback | None = None) -> None:
        self.progress, self.left = progress, 1.0

    def count(self) -> None:
        """Report that a round begins."""
        if self.progress:
            self.progress(1 - self.left)
        self.left *= LEFT


class Passes:
    """Passes of collapsing edges, each of the mesh that the one before made.

    With an original mesh, the last one ends within an error of it.
    """

    def __init__(
        self,
        mesh: Mesh,
        passes: Sequence[Collapse],
        original: Original | None = None,
        error: float = np.inf,
    ) -> None:
        self.passes, self.original, self.error = passes, original, error
        self.solids, self.meshes = [Solid(mesh)], [mesh]
        self.kept: list[BoolArray] = []  # triangles of each mesh but the last
        self.places, self.since = ANYWHERE, np.zeros(0, np.intp)  # and the first pass to keep them

    def result(self, rounds: Rounds) -> Mesh | None:
        """Return what the last pass makes once nothing is wrong with it, None if that fails."""
        first = 0
        for _ in range(MOST_REPEATS):
            rounds.count()
            self._collapse_from(first)
            result = self.meshes[-1]
            if not len(result.faces):
                return None
            wrong = self._faults(result)
            if self.original:
                wrong = np.concatenate([wrong, self.original.beyond(result, self.error)])
            if len(wrong):
                first = self._keep(wrong)
            elif same_topology(result, self.meshes[0]):
                return result
            else:
                first = self._keep_lost(result)
            if first < 0:
                return None
        return None

    def _collapse_from(self, first: int) -> None:
        """Make the passes from one on."""
        del self.meshes[first + 1 :], self.solids[first + 1 :], self.kept[first:]
        for number, collapse in enumerate(self.passes[first:], first):
            base, near = self.meshes[number], self.places[self.since <= number]
            if not len(base.faces):
                return
            chosen: BoolArray = np.zeros(len(base.vertices), bool)
            chosen[base.faces[self.solids[number].nearest_face(near)]] = True
            self.kept.append(np.any(chosen[base.faces], axis=1))
            self.meshes.append(collapse(base, self.kept[number]))
            self.solids.append(Solid(self.meshes[-1]))

    def _keep(self, wrong: Points) -> int:
        """Keep the triangles around points in the first pass that got them wrong.

        Return the first pass that changes, -1 if a point is wrong although it is kept in all.
        """
        first = len(self.kept)
        while len(wrong) and first:
            first -= 1
            distance, face, _ = self.solids[first].nearest(wrong)
            before = self.kept[first][face] | ((distance > self.error) & (first > 0))
            self.places = np.concatenate([self.places, wrong[~before]])
            self.since = np.append(self.since, np.full(np.count_nonzero(~before), first))
            wrong = wrong[before]
        return -1 if len(wrong) else first

    def _keep_lost(self, result: Mesh) -> int:
        """Keep the components of which nothing is left, in all passes; -1 if there are none."""
        base = self.meshes[0]
        component = base.components()[1][base.faces[:, 0]]
        first = np.unique(result.components()[1][result.faces[:, 0]])
        found = component[self.solids[0].nearest_face(result.vertices[first])]
        lost = base.vertices[np.unique(base.faces[~np.isin(component, found)])]
        self.places = np.concatenate([self.places, lost])
        self.since = np.append(self.since, np.zeros(len(lost), np.intp))
        return 0 if len(lost) else -1

    def _faults(self, result: Mesh) -> Points:
        """Return points, (n, 3), where a mesh is no manifold and the first one is, or is open."""
        places = irregular_places(result)
        if not len(places) and self._is_closed:
            return ANYWHERE
        made = places[~np.isin(row_keys(places), row_keys(self._before))]
        lost = self._before[~np.isin(row_keys(self._before), row_keys(places))]
        lost = lost[(lost[:, :3] != lost[:, 3:]).any(1)]  # open edges that are none any more
        return np.concatenate([made, lost]).reshape(-1, 3)

    @cached_property
    def _is_closed(self) -> bool:
        return self.meshes[0].is_closed()  # much faster than ``irregular_places``

    @cached_property
    def _before(self) -> NDArray[np.float64]:
        return irregular_places(self.meshes[0])


def within(
    mesh: Mesh, original: Original, error: float, rounds: Rounds
) -> tuple[Mesh, tuple[str, ...]]:
    """Return a mesh within a distance of the original one, and a warning if it is not simpler."""
    for halving in range(HALVINGS):
        distances = error / 2**halving * np.array(PLANE_DISTANCES)
        passes = [partial(collapse_within, distance=distance) for distance in distances]
        result = Passes(mesh, passes, original, error).result(rounds)
        if result and len(result.faces) < len(mesh.faces):
            return result, ()
    return mesh, ("the mesh was not simplified: none of its triangles can be spared within the "
                  "error",)  # fmt: skip


def same_topology(one: Mesh, other: Mesh) -> bool:
    """Return whether both meshes have as many components with the same Euler characteristics.

    That of the whole mesh alone does not change when a ball and a hole are lost. Open edges count.
    """

    def euler_numbers(mesh: Mesh) -> NDArray[np.int64]:
        _, component = mesh.components()
        used = np.bincount(mesh.faces.ravel(), minlength=len(component)) > 0
        triangles = np.bincount(component[mesh.faces[:, 0]])
        vertices = np.bincount(component[used])
        return np.sort((2 * vertices - triangles)[triangles > 0])

    return np.array_equal(euler_numbers(one), euler_numbers(other))


def collapse_within(mesh: Mesh, kept: BoolArray, distance: float) -> Mesh:
    """Collapse the edges whose new vertex is within a distance of the planes around it.

    That is the root of the sum of squared distances, in world units. The triangles that are
    ``kept``, (m,) bool, stay as they are, with their vertices; open edges stay, too.
    """
    few = len(mesh.faces) > LARGE
    rounds, rise = (FEW_ROUNDS, STEEP_RISE) if few else (ROUNDS, RISE)
    rising = {"alpha": rounds**-rise, "K": 1, "aggressiveness": rise}  # to the distance
    return _collapse(mesh, kept, distance, {"target_count": 0, "max_iterations": rounds, **rising})


def collapse_to(mesh: Mesh, kept: BoolArray, triangles: int) -> Mesh:
    """Collapse edges until no more than a number of triangles is left; see ``collapse_within``.

    More are left where the shape, the kept triangles, or open edges do not allow fewer.
    """
    target = max(triangles - int(np.count_nonzero(kept)), 0)
    return _collapse(mesh, kept, mean_side(mesh), {"target_count": target, "update_rate": 1})


def _collapse(mesh: Mesh, kept: BoolArray, unit: float, options: dict[str, Any]) -> Mesh:
    """Return the mesh with the edges between triangles that are not kept collapsed.

    The triangles that are not kept are a mesh of its own, whose open edges pyfqmr keeps: there it
    is joined to the kept triangles again. ``unit`` is the length that pyfqmr's thresholds have.
    """
    middle = mesh.vertices.mean(0, dtype=np.float64)
    scaled = (mesh.vertices - middle) / unit
    used, collapsed = _renumbered(mesh.faces[~kept], len(scaled))
    moved = scaled[used]
    if len(collapsed):
        with ONE_AT_A_TIME:
            library = Simplify()
            library.setMesh(moved, collapsed)
            library.simplify_mesh(preserve_border=True, verbose=False, **options)
            moved, collapsed, _ = library.getMesh()
    held = np.unique(mesh.faces[kept])
    _, found, at = np.intersect1d(row_keys(moved), row_keys(scaled[held]), return_indices=True)
    same = (moved[found] == scaled[held[at]]).all(1)
    there = np.full(len(held), -1, np.intp)  # rows of held vertices among the moved
    there[at[same]] = found[same]
    vertices = (moved * unit + middle).astype(mesh.vertices.dtype)
    vertices[there[there >= 0]] = mesh.vertices[held[there >= 0]]
    extra = held[there < 0]
    number = np.full(len(scaled), -1, np.int32)
    number[held] = there
    number[extra] = len(moved) + np.arange(len(extra))
    faces = np.concatenate([collapsed.astype(np.int32), number[mesh.faces[kept]]])
    return Mesh(np.concatenate([vertices, mesh.vertices[extra]]), faces)


def _renumbered(faces: IntArray, count: int) -> tuple[NDArray[np.intp], IntArray]:
    """Return which of ``count`` vertices faces (m, 3) use, and the faces with these numbered."""
    used = np.bincount(faces.ravel(), minlength=count) > 0
    return np.flatnonzero(used), (np.cumsum(used, dtype=np.int32) - 1)[faces]


def irregular_places(mesh: Mesh) -> NDArray[np.float64]:
    """Return where a mesh is no closed manifold, (n, 6): the two ends of an edge, or a point twice.

    These are the edges, in the direction of their triangle, without exactly one triangle that
    passes them in the other direction, and the vertices at which several fans of triangles meet, or
    that are at the position of another one, or at which two triangles have the same three corners.
    """
    positions, faces = mesh.vertices.astype(np.float64), mesh.faces
    opposite, _, _ = mesh.pair_edges()
    fans = mesh.count_fans(opposite)
    unpaired = np.flatnonzero(opposite < 0)
    start, end = faces.ravel()[unpaired], np.roll(faces, -1, axis=1).ravel()[unpaired]
    pinched = np.flatnonzero(fans > 1)
    doubled = _doubled(np.sort(faces, axis=1).astype(np.float64))
    both = np.concatenate([pinched, _doubled(positions), faces[doubled].astype(np.intp).ravel()])
    ends = np.concatenate([start, both]), np.concatenate([end, both])
    return np.concatenate([positions[ends[0]], positions[ends[1]]], axis=1)


def _doubled(rows: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the rows that are equal to another row."""
    _, inverse, uses = np.unique(row_keys(rows), return_inverse=True, return_counts=True)
    return np.flatnonzero(uses[inverse] > 1)
