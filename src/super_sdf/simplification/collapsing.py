"""Passes of collapsing edges with pyfqmr: what turned out wrong is kept, the rest collapsed again.

pyfqmr is fast quadric mesh simplification (Forstmann): an edge is collapsed if the sum of squared
distances of the new vertex to the planes of the triangles it replaces is under a threshold, which
rises in every round. It neither bounds the distance of triangles nor keeps every mesh a manifold.
So where a collapsed mesh is too far from the unsimplified one, or no longer a manifold, the
triangles around the place are kept, and the rest is collapsed again. Passes over the result follow,
in which the triangles to keep are larger already.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
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

COLLAPSING_ROUNDS = 8  # in which the threshold rises to its end; from more, meshes get no smaller
RISE = 5.0  # exponent of the threshold in a round
ONE_AT_A_TIME = Lock()  # pyfqmr has one mesh, in global variables
# Edges are collapsed while the new vertex is within this many errors of the planes around it (root
# of the sum of squares). At 1, 1.4, 2, 2.8 and 4, a part keeps 17, 17, 13, 15 and 20 % of its
# triangles at 32^3, another one 9, 9, 8, 9 and 12 %.
PLANE_DISTANCE = 2.0
FIRST_DISTANCE = 0.5  # in the first pass, after which the others have a tenth of the triangles
UNMEASURED = 3  # passes before one that is measured: they are seldom too far
MOST_PASSES = 20
ENOUGH = 0.9  # a pass that leaves more of the triangles is the last one
LEAST_ERROR = 1e-2  # of a triangle's side: the first of the errors that double
DOUBLINGS = 20
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

    ``too_far`` takes a mesh and returns points, (n, 3), at which it is not accepted.
    """

    def __init__(self, mesh: Mesh, collapse: Collapse, too_far: Callable[[Mesh], Points]) -> None:
        self.collapse, self.too_far = collapse, too_far
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
            wrong = np.concatenate([self._faults(result), self.too_far(result)])
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
            base, near = self.meshes[number], self.places[self.since <= number]
            chosen = np.zeros(len(base.vertices), bool)
            chosen[base.faces[self.solids[number].nearest_face(near)]] = True
            self.kept.append(chosen[base.faces].any(1))
            self.meshes.append(self.collapse(base, self.kept[number], number))
            self.solids.append(Solid(self.meshes[-1]))

    def _keep(self, wrong: Points) -> int:
        """Keep the triangles around points in the last pass, and in those before if they are kept.

        Return the first pass that changes, -1 if a point is wrong although all are kept there.
        """
        first = len(self.kept)
        while len(wrong) and first:
            first -= 1
            stuck = self.kept[first][self.solids[first].nearest_face(wrong)]
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
    result = mesh
    for halving in range(HALVINGS):
        distance = PLANE_DISTANCE * error / 2**halving

        def collapse(base: Mesh, kept: BoolArray, number: int, most: float = distance) -> Mesh:
            return collapse_within(base, kept, most if number else FIRST_DISTANCE / 2 * most)

        passes = Passes(mesh, collapse, partial(original.beyond, distance=error))
        for count in range(UNMEASURED + 1, MOST_PASSES):
            coarser = passes.accepted(count, rounds)
            if coarser is None or len(coarser.faces) >= len(result.faces):
                break
            before, result = passes.meshes[-2], coarser
            if len(result.faces) > ENOUGH * len(before.faces):
                break
        if result is not mesh:
            return result, ()
    return mesh, ("the mesh was not simplified: none of its triangles can be spared within the "
                  "error",)  # fmt: skip


def down_to(
    mesh: Mesh, original: Original, triangles: int, rounds: Rounds
) -> tuple[Mesh, tuple[str, ...]]:
    """Return a mesh of at most ``triangles`` triangles, or the smallest found and a warning.

    Errors double until there are no more. So flat parts come first, where a collapsed edge costs
    nothing.
    """
    result, error = mesh, LEAST_ERROR * mean_side(mesh)
    for doubling in range(DOUBLINGS):
        if len(result.faces) <= triangles:
            return result, ()
        coarser, _ = within(result, original, error * 2**doubling, rounds)
        if len(coarser.faces) < triangles:
            exact = _collapsed_to(result, triangles, rounds)
            found = [some for some in (exact, coarser) if some and len(some.faces) <= triangles]
            return min(found, key=lambda some: max(original.deviation(some)[::2])), ()
        result = coarser
    return result, (f"{triangles:,} triangles cannot be reached while the mesh stays a manifold of "
                    f"the same topology: it has {len(result.faces):,}",)  # fmt: skip


def _collapsed_to(mesh: Mesh, triangles: int, rounds: Rounds) -> Mesh | None:
    """Return a mesh of a number of triangles, at any distance; None if it is no manifold."""

    def collapse(base: Mesh, kept: BoolArray, number: int) -> Mesh:
        return collapse_to(base, kept, triangles)

    return Passes(mesh, collapse, lambda result: ANYWHERE).accepted(1, rounds)


def euler_numbers(mesh: Mesh) -> NDArray[np.int64]:
    """Return twice the Euler characteristic of each component, sorted, of a mesh without open edges.

    That of the whole mesh alone does not change when a ball and a hole are lost. Open edges count.
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
    rising = {"alpha": COLLAPSING_ROUNDS**-RISE, "K": 1, "aggressiveness": RISE}  # to the distance
    limits = {"target_count": 0, "max_iterations": COLLAPSING_ROUNDS}
    return _collapse(mesh, kept, distance, {**rising, **limits})


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
    """Return those of ``count`` vertices that faces (m, 3) use, and the faces with their numbers."""
    used = np.bincount(faces.ravel(), minlength=count) > 0
    return np.flatnonzero(used), (np.cumsum(used, dtype=np.int32) - 1)[faces]
