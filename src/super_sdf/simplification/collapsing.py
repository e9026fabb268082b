"""Passes of collapsing edges with pyfqmr: what turned out wrong is kept, the rest collapsed again.

pyfqmr is fast quadric mesh simplification (Forstmann): an edge is collapsed if the sum of squared
distances of the new vertex to the planes of the triangles it replaces is under a threshold, which
rises in every round. It neither bounds the distance of triangles nor keeps every mesh a manifold.
So passes are made over the result of each other, and the last one is looked at. Where it is too far
from the unsimplified mesh, or not a manifold, the triangles around the place are kept in the last
pass that had it right, and the passes from there on are made anew.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyfqmr import Simplify

from ..arrays import BoolArray, IntArray
from ..mesh import Mesh
from ..progress import ShareCallback
from ..topology import OpenEdges, irregular_places, row_keys, vertex_components
from ..truth.solid import Points, Solid
from .measuring import Original, mean_side

ROUNDS, RISE = 30, 3.0  # of the threshold to its end; from more rounds, meshes get no smaller
LARGE = 1 << 12  # triangles from which on rounds take time: fewer serve nearly as well
FEW_ROUNDS, STEEP_RISE = 8, 5.0
ONE_AT_A_TIME = Lock()  # pyfqmr has one mesh, in global variables
# Edges are collapsed while the new vertex is within this many errors of the planes around it (root
# of the sum of squares). They rise over the passes, since what is collapsed too far early must be
# found and done anew. The last stands for all passes after: from 1.4 or 2.8, more triangles remain.
PLANE_DISTANCES = 1.0, 1.4, 1.7, 2.0
MOST_PASSES = 20
ENOUGH = 0.9  # a pass that leaves more of the triangles is the last one
LEAST_ERROR = 1e-2  # of a triangle's side: the first of the errors that double
DOUBLINGS = 14
MOST_ROUNDS = 16  # of keeping more triangles, before smaller distances are tried
HALVINGS = 3
LEFT = 0.85  # share of the work that is left after a round: a guess
ANYWHERE: Points = np.zeros((0, 3))

Collapse = Callable[[Mesh, BoolArray, int], Mesh]
"""Collapses edges of a mesh, but those of the triangles in a mask, (m,), in a pass of a number."""


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

    With an original mesh, what they make stays within an error of it.
    """

    def __init__(
        self,
        mesh: Mesh,
        collapse: Collapse,
        original: Original | None = None,
        error: float = np.inf,
    ) -> None:
        self.collapse, self.original, self.error = collapse, original, error
        self.solids, self.meshes = [Solid(mesh)], [mesh]
        self.kept: list[BoolArray] = []  # triangles of each mesh but the last
        self.places, self.since = ANYWHERE, np.zeros(0, np.intp)  # kept from which mesh on

    def accepted(self, passes: int, rounds: Rounds) -> Mesh | None:
        """Return the mesh after some passes, keeping ever more triangles until nothing is wrong.

        None if that fails.
        """
        first = len(self.meshes) - 1
        for _ in range(MOST_ROUNDS):
            rounds.count()
            self._collapse_from(first, passes)
            result = self.meshes[-1]
            if not len(result.faces):
                return None
            wrong = self._faults(result)
            if self.original:
                wrong = np.concatenate([wrong, self.original.beyond(result, self.error)])
            if not len(wrong):
                same = np.array_equal(euler_numbers(result), self._euler_numbers)
                return result if same else None
            first = self._keep(wrong)
            if first < 0:
                return None
        return None

    def _collapse_from(self, first: int, passes: int) -> None:
        """Make the passes anew from one on."""
        del self.meshes[first + 1 :], self.solids[first + 1 :], self.kept[first:]
        for number in range(first, passes):
            if not len(self.meshes[number].faces):
                return
            base, near = self.meshes[number], self.places[self.since <= number]
            chosen: BoolArray = np.zeros(len(base.vertices), bool)
            chosen[base.faces[self.solids[number].nearest_face(near)]] = True
            self.kept.append(np.any(chosen[base.faces], axis=1))
            self.meshes.append(self.collapse(base, self.kept[number], number))
            self.solids.append(Solid(self.meshes[-1]))

    def _keep(self, wrong: Points) -> int:
        """Keep the triangles around points, in the last pass or, if these are wrong, in one before.

        Return the first pass that changes, -1 if a point is wrong although all are kept there.
        """
        first = len(self.kept)
        while len(wrong) and first:
            first -= 1
            distance, face, _ = self.solids[first].nearest(wrong)
            stuck = self.kept[first][face] | (distance > self.error)
            self.places = np.concatenate([self.places, wrong[~stuck]])
            self.since = np.append(self.since, np.full(np.count_nonzero(~stuck), first))
            wrong = wrong[stuck]
        return -1 if len(wrong) else first

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
        edges = OpenEdges()  # much faster than ``irregular_places``
        edges.add(self.meshes[0].faces)
        return not len(edges)

    @cached_property
    def _euler_numbers(self) -> NDArray[np.int64]:
        return euler_numbers(self.meshes[0])

    @cached_property
    def _before(self) -> NDArray[np.float64]:
        return irregular_places(self.meshes[0])


def within(
    mesh: Mesh, original: Original, error: float, rounds: Rounds
) -> tuple[Mesh, tuple[str, ...]]:
    """Return a mesh within a distance of the original one, and a warning if it is not simpler."""
    for halving in range(HALVINGS):
        result = _in_passes(mesh, original, error, 2.0**-halving, rounds)
        if result:
            return result, ()
    return mesh, ("the mesh was not simplified: none of its triangles can be spared within the "
                  "error",)  # fmt: skip


def _in_passes(
    mesh: Mesh, original: Original, error: float, share: float, rounds: Rounds
) -> Mesh | None:
    """Return a simpler mesh, by passes with a share of the usual distances; None if that fails.

    The first result that is measured is that of several passes.
    """
    distances = share * error * np.array(PLANE_DISTANCES)

    def collapse(base: Mesh, kept: BoolArray, number: int) -> Mesh:
        return collapse_within(base, kept, distances[min(number, len(distances) - 1)])

    passes, result = Passes(mesh, collapse, original, error), None
    for count in range(len(distances), MOST_PASSES):
        coarser = passes.accepted(count, rounds)
        if coarser is None or len(coarser.faces) >= len((result or mesh).faces):
            break
        result = coarser
        if len(result.faces) > ENOUGH * len(passes.meshes[-2].faces):
            break
    return result


def down_to(
    mesh: Mesh, original: Original, triangles: int, rounds: Rounds
) -> tuple[Mesh, tuple[str, ...]]:
    """Return a mesh of at most ``triangles`` triangles, or the smallest found and a warning.

    Errors double until there are no more, and what the last one made is compared to what is
    collapsed to the number, whatever the error.
    """
    finer = coarser = mesh
    for error in LEAST_ERROR * mean_side(mesh) * 2.0 ** np.arange(DOUBLINGS):
        if len(coarser.faces) <= triangles:
            break
        finer, (coarser, _) = coarser, within(coarser, original, error, rounds)
    exact = _collapsed_to(finer, triangles, rounds)
    reached = [some for some in (exact, coarser) if len(some.faces) <= triangles]
    if reached:
        return min(reached, key=lambda some: max(original.deviation(some)[::2])), ()
    return exact, (f"{triangles:,} triangles cannot be reached while the mesh stays a manifold of "
                   f"the same topology: it has {len(exact.faces):,}",)  # fmt: skip


def _collapsed_to(mesh: Mesh, triangles: int, rounds: Rounds) -> Mesh:
    """Return a mesh of a number of triangles, at any distance, or the smallest found."""

    def collapse(base: Mesh, kept: BoolArray, number: int) -> Mesh:
        return collapse_to(base, kept, triangles)

    passes = Passes(mesh, collapse)
    for count in range(1, MOST_PASSES):
        coarser = passes.accepted(count, rounds)
        if coarser is None or len(coarser.faces) >= len(mesh.faces):
            break
        mesh = coarser
    return mesh


def euler_numbers(mesh: Mesh) -> NDArray[np.int64]:
    """Return twice the Euler characteristics of the components of a closed mesh, sorted.

    That of the whole mesh alone does not change when a ball and a hole are lost. With open edges,
    it is a number that changes if the topology does.
    """
    component = vertex_components(mesh.faces, len(mesh.vertices))
    used = np.bincount(mesh.faces.ravel(), minlength=len(component)) > 0
    triangles = np.bincount(component[mesh.faces[:, 0]])
    vertices = np.bincount(component[used])
    return np.sort((2 * vertices - triangles)[triangles > 0])


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
