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

from ..surface.mesh import Mesh, row_keys
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
# A number of triangles is sought by the error that leaves as many.
MOST_ERRORS = 12  # that are tried
FIRST_ERROR = 0.006  # in sides of a triangle, over the share of the triangles that is wanted
STRIDE, CLOSE = 4.0, 1.02  # largest ratio of an error to the next, and smallest of two in the end
FARTHEST = 0.05  # over the diagonal of the box: larger errors leave no fewer
NEAR_END = 1.2  # ratio of the largest error that is of use to one that need not rise any more
# Simplified once more within the same error, meshes have fewer triangles, by about this factor.
MARGIN = 1.06
ANYWHERE: Points = np.zeros((0, 3))

Collapse = Callable[[Mesh, NDArray[np.bool_]], Mesh]
"""Collapses edges of a mesh, but those of the triangles in a mask, (m,)."""


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
        self.kept: list[NDArray[np.bool_]] = []  # triangles of each mesh but the last
        self.places, self.since = ANYWHERE, np.zeros(0, np.intp)  # and the first pass to keep them

    def result(self, count_round: Callable[[], None]) -> Mesh | None:
        """Return what the last pass makes once nothing is wrong with it, None if that fails."""
        first = 0
        for _ in range(MOST_REPEATS):
            count_round()
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
            chosen: NDArray[np.bool_] = np.zeros(len(base.vertices), bool)
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
            self._keep_from(first, wrong[~before])
            wrong = wrong[before]
        return -1 if len(wrong) else first

    def _keep_lost(self, result: Mesh) -> int:
        """Keep the components of which nothing is left, in all passes; -1 if there are none."""
        base = self.meshes[0]
        component = base.components()[1][base.faces[:, 0]]
        first = np.unique(result.components()[1][result.faces[:, 0]])
        found = component[self.solids[0].nearest_face(result.vertices[first])]
        lost = base.vertices[np.unique(base.faces[~np.isin(component, found)])]
        self._keep_from(0, lost)
        return 0 if len(lost) else -1

    def _keep_from(self, first: int, places: Points) -> None:
        self.places = np.concatenate([self.places, places])
        self.since = np.append(self.since, np.full(len(places), first))

    def _faults(self, result: Mesh) -> Points:
        """Return points, (n, 3), where a mesh is no manifold and the first one is, or is open."""
        places = irregular_places(result)
        if not len(places) and self.meshes[0].is_closed():
            return ANYWHERE
        before = self._irregular
        made = places[~np.isin(row_keys(places), row_keys(before))]
        lost = before[~np.isin(row_keys(before), row_keys(places))]
        lost = lost[(lost[:, :3] != lost[:, 3:]).any(1)]  # open edges that are none any more
        return np.concatenate([made, lost]).reshape(-1, 3)

    @cached_property
    def _irregular(self) -> NDArray[np.float64]:
        return irregular_places(self.meshes[0])


def within(
    mesh: Mesh, original: Original, error: float, count_round: Callable[[], None]
) -> tuple[Mesh, tuple[str, ...]]:
    """Return a mesh within a distance of the original one, and a warning if it is not simpler."""
    for halving in range(HALVINGS):
        distances = error / 2**halving * np.array(PLANE_DISTANCES)
        passes = [partial(collapse_within, distance=distance) for distance in distances]
        result = Passes(mesh, passes, original, error).result(count_round)
        if result and len(result.faces) < len(mesh.faces):
            return result, ()
    return mesh, (
        "the mesh was not simplified: none of its triangles can be spared within the error",
    )


def down_to(
    mesh: Mesh, original: Original, triangles: int, count_round: Callable[[], None]
) -> tuple[Mesh, tuple[str, ...]]:
    """Return a mesh of at most ``triangles`` triangles, or the smallest found and a warning.

    The error is sought that leaves somewhat more. Each error that is tried is a whole
    simplification, so that the mesh is as good as that of the error.
    """
    everything, wanted = len(mesh.faces), MARGIN * triangles
    if everything <= triangles:
        return mesh, ()
    farthest = FARTHEST * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    error = min(FIRST_ERROR * mean_side(mesh) * everything / triangles, farthest)
    # an error and the triangles that it leaves at first: too many, and few enough
    (low, more), (high, fewer) = (0.0, everything), (np.inf, 0)
    reached, least, least_error, is_near = None, mesh, 0.0, False
    for _ in range(MOST_ERRORS):
        result, _ = within(mesh, original, error, count_round)
        once = len(result.faces)
        if triangles < once < MARGIN * wanted:
            result, _ = within(result, original, error, count_round)
        left = len(result.faces)
        if left <= triangles:
            reached = result
        elif left < len(least.faces):
            least, least_error = result, error
        all_alike = not low and once == fewer  # as on planes
        if once == everything > more and not fewer:  # the error is too large
            farthest = min(farthest, error)
        elif left > triangles:
            low, more = error, once
        else:  # ``is_near`` if it leaves hardly fewer
            high, fewer, is_near = error, once, triangles < MARGIN * left
        found = is_near and left <= triangles < once
        if found or all_alike or (not fewer and farthest < NEAR_END * low):
            break
        if high < CLOSE * low:
            if is_near:
                break
            low = 0.0  # smaller errors may leave few enough, too
        # what is left falls about as a power of the error
        if high == np.inf:
            rise = float(np.clip(more / wanted, 1.1, STRIDE))
            error = low * min(rise, max(1.1, float(np.sqrt(farthest / low))))
        elif not low:
            error = high * float(np.clip(fewer / wanted, 1 / STRIDE, 0.9))
        else:
            share = np.log(more / wanted) / np.log(more / fewer)
            error = float(low * (high / low) ** np.clip(share, 0.15, 0.85))
    if reached:
        return reached, ()
    if least_error:
        least, _ = within(least, original, least_error, count_round)
    passes = [partial(collapse_to, triangles=triangles)] * len(PLANE_DISTANCES)
    exact = Passes(least, passes).result(count_round)  # whatever the distance
    if exact and len(exact.faces) <= triangles:
        return exact, ()
    return least, (
        f"{triangles:,} triangles cannot be reached while the mesh stays a manifold of the same "
        f"topology: it has {len(least.faces):,}",
    )


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


def collapse_within(mesh: Mesh, kept: NDArray[np.bool_], distance: float) -> Mesh:
    """Collapse the edges whose new vertex is within a distance of the planes around it.

    That is the root of the sum of squared distances, in world units. The triangles that are
    ``kept``, (m,) bool, stay as they are, with their vertices; open edges stay, too.
    """
    few = len(mesh.faces) > LARGE
    rounds, rise = (FEW_ROUNDS, STEEP_RISE) if few else (ROUNDS, RISE)
    rising = {"alpha": rounds**-rise, "K": 1, "aggressiveness": rise}  # to the distance
    return _collapse(mesh, kept, distance, {"target_count": 0, "max_iterations": rounds, **rising})


def collapse_to(mesh: Mesh, kept: NDArray[np.bool_], triangles: int) -> Mesh:
    """Collapse edges until no more than a number of triangles is left; see ``collapse_within``.

    More are left where the shape, the kept triangles, or open edges do not allow fewer.
    """
    target = max(triangles - int(np.count_nonzero(kept)), 0)
    return _collapse(mesh, kept, mean_side(mesh), {"target_count": target, "update_rate": 1})


def _collapse(mesh: Mesh, kept: NDArray[np.bool_], unit: float, options: dict[str, Any]) -> Mesh:
    """Return the mesh with the edges between triangles that are not kept collapsed.

    The triangles that are not kept are a mesh of its own, whose open edges pyfqmr keeps: there it
    is joined to the kept triangles again. ``unit`` is the length that pyfqmr's thresholds have.
    """
    middle = mesh.vertices.mean(0, dtype=np.float64)
    scaled = (mesh.vertices - middle) / unit
    is_used = np.bincount(mesh.faces[~kept].ravel(), minlength=len(scaled)) > 0
    collapsed = (np.cumsum(is_used, dtype=np.int32) - 1)[mesh.faces[~kept]]
    moved = scaled[is_used]
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
