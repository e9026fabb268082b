"""Passes of collapsing edges with pyfqmr: where the result is wrong, they are made anew.

pyfqmr is fast quadric mesh simplification (Forstmann): an edge is collapsed if the sum of squared
distances of the new vertex to the planes of the triangles it replaces is under a threshold, which
rises in every round. It neither bounds the distance of triangles nor keeps every mesh a manifold.
So the mesh of the last pass is measured. Where it is too far from the unsimplified mesh, or not a
manifold, the triangles around the place are kept in the first pass that got it wrong, and this pass
and those after it are made anew. Distances are exact, from points to triangles: vertices, a pattern
of points on the simplified mesh, and the middles of triangles where a corner may not be farthest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyfqmr import Simplify

from ..surface.mesh import Mesh, row_keys
from ..truth.solid import Distances, Points, Solid

ONE_AT_A_TIME = Lock()  # pyfqmr has one mesh, in global variables
# Edges are collapsed while the new vertex is within this many errors of the planes around it (root
# of the sum of squares), in each pass. What an early pass gets wrong costs most time, so they rise;
# with an end of 1.4 or 2.8, more triangles are left.
PLANE_DISTANCES = 1.0, 1.4, 1.7, 2.0, 2.0
ROUNDS = 30, 3.0  # of the threshold, and its rise; from more rounds, meshes get no smaller
FEW_ROUNDS, LARGE = (8, 5.0), 1 << 12  # nearly as well, from this many triangles on
MOST_REPEATS, HALVINGS = 16, 3  # of passes, before smaller distances are tried
POINTS_AT_ONCE, SIDES = 1 << 18, 2 / 3  # sides of the unsimplified mesh between points
# A number of triangles is sought by the error that leaves as many.
MOST_ERRORS = 12  # that are tried
FIRST_ERROR = 0.006  # in sides of a triangle, over the share of the triangles that is wanted
STRIDE, CLOSE = 4.0, 1.02  # largest ratio of an error to the next, and smallest of two in the end
FARTHEST, NEAR_END = 0.05, 1.2  # over the diagonal: larger errors leave no fewer; near it, to stop
MARGIN = 1.06  # fewer triangles by about this factor if simplified again within the same error

Collapse = Callable[[Mesh, NDArray[np.bool_]], Mesh]
"""Collapses edges of a mesh, but those of the triangles in a mask, (m,)."""


class Original:
    """A mesh before it was simplified, to measure simplified ones against.

    What was measured of one simplified mesh holds for the triangles that the next one still has: to
    them, the distance of a vertex is no larger, and theirs is the same.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh, self.solid, self.step = mesh, Solid(mesh), SIDES * mean_side(mesh)
        self.distance = np.zeros(len(mesh.vertices))
        self.near = np.zeros(len(mesh.vertices), np.uint64)  # key of a triangle; 0: not measured
        self.back: dict[int, tuple[float, float]] = {}  # by key: largest distance, and its integral

    def compare(
        self, other: Solid, error: float = np.inf
    ) -> tuple[Points, tuple[float, float, float, float]]:
        """Return points of this mesh, (n, 3), where the other is farther away than an error.

        They are its vertices, or if these are near enough, the middles of its triangles, or else
        what is nearest to points of the other. The numbers, those of ``Deviation``, are right if
        there are none.
        """
        vertices, nowhere = self.solid.mesh.vertices, (np.inf,) * 4
        keys = row_keys(other.mesh.vertices[other.mesh.faces].reshape(-1, 9))
        stale = ~np.isin(self.near, keys)
        self.distance[stale], face, _ = other.nearest(vertices[stale])
        self.near[stale] = keys[face]
        if (far := self.distance > error).any():
            self.near[far] = 0
            return vertices[far], nowhere
        # Triangles are convex: one whose corners are near the same triangle of the other mesh is
        # nowhere farther from it than its corners.
        near = self.near[self.mesh.faces]
        middles = vertices[self.mesh.faces[(near[:, :1] != near[:, 1:]).any(1)]].mean(1)
        off = other.distance(middles)
        if (far := off > error).any():
            return middles[far], nowhere
        known = np.array([self.back.get(key, (np.nan, 0.0)) for key in keys.tolist()])
        new = np.flatnonzero(~(known[:, 0] <= error))
        known[new], wrong = 0.0, [np.zeros((0, 3))]
        for points, weights, face in points_within(other.mesh, new, self.step):
            found, _, feet = self.solid.nearest(points)
            wrong.append(feet[found > error])
            np.maximum.at(known[:, 0], face, found)
            known[:, 1] += np.bincount(face, found * weights, len(known))
        self.back.update(zip(keys[new].tolist(), map(tuple, known[new].tolist())))
        around, area = self.distance[self.mesh.faces].mean(1), areas(self.solid.mesh)
        largest = max(float(self.distance.max()), float(off.max(initial=0)))
        mean_back = float(known[:, 1].sum() / areas(other.mesh).sum())
        means = float(around @ area / area.sum()), mean_back
        return np.concatenate(wrong), (largest, means[0], float(known[:, 0].max()), means[1])


def areas(mesh: Mesh) -> Distances:
    """Return the areas of triangles, (m,)."""
    a, b, c = mesh.vertices[mesh.faces.T]
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def mean_side(mesh: Mesh) -> float:
    """Return the mean length of the first sides of all triangles."""
    start, end = mesh.vertices.astype(np.float64)[mesh.faces[:, :2].T]
    return float(np.linalg.norm(end - start, axis=1).mean())


def points_within(
    mesh: Mesh, some: NDArray[np.intp], step: float
) -> Iterator[tuple[Points, Distances, NDArray[np.intp]]]:
    """Yield points on some triangles, (n, 3), their areas and triangles, (n,), in chunks.

    They are the corners, without an area, and the middles of a pattern of cells on each triangle:
    as many along its longest side, and across, as are needed to be no wider than a step.
    """
    corners, row = mesh.vertices[mesh.faces[some]], np.arange(len(some))
    yield corners.reshape(-1, 3), np.zeros(3 * len(some)), np.repeat(some, 3)
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1), axis=2)
    apex, low, high = (corners[row, (sides.argmax(1) + turn) % 3] for turn in range(3))
    area, side = areas(Mesh(mesh.vertices, mesh.faces[some])), sides.max(1, initial=0)
    across = np.divide(2 * area, side, out=np.zeros(len(side)), where=side > 0)
    along, rows = (np.maximum(np.ceil(x / step), 1).astype(np.int64) for x in (side, across))
    ends = np.cumsum(along * rows)
    for first in range(0, int(ends[-1]) if len(ends) else 0, POINTS_AT_ONCE):
        number = np.arange(first, min(first + POINTS_AT_ONCE, ends[-1]))
        face = np.searchsorted(ends, number, side="right")
        line, column = np.divmod(number - ends[face] + along[face] * rows[face], along[face])
        v, u = (line + 0.5) / rows[face], (column + 0.5) / along[face]
        base = low[face] + u[:, None] * (high[face] - low[face])
        # cells are narrower, and so stand for less, towards the apex
        weight = area[face] * 2 * (1 - v) / (along[face] * rows[face])
        yield base + v[:, None] * (apex[face] - base), weight, some[face]


def collapsed(
    mesh: Mesh,
    passes: Sequence[Collapse],
    count_round: Callable[[], None],
    original: Original | None = None,
    error: float = np.inf,
) -> Mesh | None:
    """Return what the last pass makes once nothing is wrong with it, None if that fails.

    Right is a mesh within the error of the original, if there is one, with no place that is less
    of a manifold than in ``mesh``, with all its components and their holes.
    """
    meshes, solids, is_closed = [mesh], [Solid(mesh)], mesh.is_closed()
    kept: list[NDArray[np.bool_]] = []  # triangles of each mesh but the last
    places, since = np.zeros((0, 3)), np.zeros(0, np.intp)  # to keep, and from which pass on
    first = 0  # pass that is to be made anew
    for _ in range(MOST_REPEATS):
        count_round()
        del meshes[first + 1 :], solids[first + 1 :], kept[first:]
        for number, collapse in enumerate(passes[first:], first):
            base = meshes[number]
            chosen: NDArray[np.bool_] = np.zeros(len(base.vertices), bool)
            chosen[base.faces[solids[number].nearest_face(places[since <= number])]] = True
            kept.append(np.any(chosen[base.faces], axis=1))
            meshes.append(collapse(base, kept[number]))
            solids.append(Solid(meshes[-1]))
            if not len(meshes[-1].faces):
                return None
        result, wrong = meshes[-1], np.zeros((0, 3))
        irregular = irregular_places(result)
        if len(irregular) or not is_closed:
            before = irregular_places(mesh)
            made = irregular[~np.isin(row_keys(irregular), row_keys(before))]
            lost = before[~np.isin(row_keys(before), row_keys(irregular))]
            lost = lost[(lost[:, :3] != lost[:, 3:]).any(1)]  # open edges that are none any more
            wrong = np.concatenate([made, lost]).reshape(-1, 3)
        if original:
            wrong = np.concatenate([wrong, original.compare(solids[-1], error)[0]])
        if not len(wrong):
            if same_topology(result, mesh):
                return result
            # keep the components of which nothing is left, in all passes
            component = mesh.components()[1][mesh.faces[:, 0]]
            roots = np.unique(result.components()[1][result.faces[:, 0]])
            found = component[solids[0].nearest_face(solids[-1].mesh.vertices[roots])]
            missing = mesh.vertices[np.unique(mesh.faces[~np.isin(component, found)])]
            if not len(missing):
                return None
            first, places = 0, np.concatenate([places, missing])
            since = np.append(since, np.zeros(len(missing), np.intp))
            continue
        first = len(passes)
        while len(wrong) and first:  # back to the first pass that got it wrong
            first -= 1
            distance, face, _ = solids[first].nearest(wrong)
            earlier = kept[first][face] | ((distance > error) & (first > 0))
            places = np.concatenate([places, wrong[~earlier]])
            since = np.append(since, np.full(np.count_nonzero(~earlier), first))
            wrong = wrong[earlier]
        if len(wrong):  # although it is kept in all
            return None
    return None


def within(
    mesh: Mesh, original: Original, error: float, count_round: Callable[[], None]
) -> tuple[Mesh, tuple[str, ...]]:
    """Return a mesh within a distance of the original one, and a warning if it is not simpler."""
    for halving in range(HALVINGS):
        distances = error / 2**halving * np.array(PLANE_DISTANCES)
        passes = [partial(collapse_edges, distance=distance) for distance in distances]
        result = collapsed(mesh, passes, count_round, original, error)
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
    reached, least, is_near = None, mesh, False
    for _ in range(MOST_ERRORS):
        result = within(mesh, original, error, count_round)[0]
        once = len(result.faces)
        if triangles < once < MARGIN * wanted:
            result = within(result, original, error, count_round)[0]
        left = len(result.faces)
        all_alike = not low and once == fewer  # as on planes
        found = triangles < MARGIN * left and left <= triangles < once
        if left <= triangles:  # ``is_near`` if it leaves hardly fewer
            reached, high, fewer, is_near = result, error, once, triangles < MARGIN * left
        elif once == everything > more and not fewer:  # the error is too large
            farthest = min(farthest, error)
        else:
            low, more, least = error, once, min(least, result, key=lambda one: len(one.faces))
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
    passes = [partial(collapse_edges, triangles=triangles)] * len(PLANE_DISTANCES)
    exact = collapsed(least, passes, count_round)  # whatever the distance
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
    numbers = []
    for mesh in (one, other):
        _, component = mesh.components()
        triangles = np.bincount(component[mesh.faces[:, 0]], minlength=len(component))
        vertices = np.bincount(component[np.unique(mesh.faces)], minlength=len(component))
        numbers.append(np.sort((2 * vertices - triangles)[triangles > 0]))
    return np.array_equal(numbers[0], numbers[1])


def collapse_edges(
    mesh: Mesh, kept: NDArray[np.bool_], *, distance: float = 0.0, triangles: int = 0
) -> Mesh:
    """Collapse the edges whose new vertex is within a distance of the planes around it.

    That is the root of the sum of squared distances, in world units. Or, without a distance, those
    until no more than a number of triangles is left, unless the shape does not allow it. The
    triangles that are ``kept``, (m,), stay as they are, with their vertices; open edges stay, too.
    The others are a mesh of its own, whose open edges pyfqmr keeps: there it is joined to the kept
    triangles again.
    """
    target = max(triangles - int(np.count_nonzero(kept)), 0)
    options: dict[str, Any] = {"target_count": target, "update_rate": 1}
    if distance:
        rounds, rise = FEW_ROUNDS if len(mesh.faces) > LARGE else ROUNDS
        options = {"target_count": 0, "max_iterations": rounds}
        options |= {"alpha": rounds**-rise, "K": 1, "aggressiveness": rise}  # to the distance
    unit = distance or mean_side(mesh)  # the length that pyfqmr's thresholds have
    middle = mesh.vertices.mean(0, dtype=np.float64)
    scaled = (mesh.vertices - middle) / unit
    is_used = np.bincount(mesh.faces[~kept].ravel(), minlength=len(scaled)) > 0
    faces, moved = (np.cumsum(is_used, dtype=np.int32) - 1)[mesh.faces[~kept]], scaled[is_used]
    if len(faces):
        with ONE_AT_A_TIME:
            library = Simplify()
            library.setMesh(moved, faces)
            library.simplify_mesh(preserve_border=True, verbose=False, **options)
            moved, faces, _ = library.getMesh()
    held = np.unique(mesh.faces[kept])
    _, found, at = np.intersect1d(row_keys(moved), row_keys(scaled[held]), return_indices=True)
    vertices = (moved * unit + middle).astype(mesh.vertices.dtype)
    vertices[found] = mesh.vertices[held[at]]
    extra, number = np.delete(held, at), np.full(len(scaled), -1, np.int32)
    number[held[at]], number[extra] = found, len(moved) + np.arange(len(extra))
    faces = np.concatenate([faces.astype(np.int32), number[mesh.faces[kept]]])
    return Mesh(np.concatenate([vertices, mesh.vertices[extra]]), faces)


def irregular_places(mesh: Mesh) -> NDArray[np.float64]:
    """Return where a mesh is no closed manifold, (n, 6): the two ends of an edge, or a point twice.

    These are the edges, in the direction of their triangle, without exactly one triangle that
    passes them in the other direction, and the vertices at which several fans of triangles meet, or
    that are at the position of another one, or at which two triangles have the same three corners.
    """
    positions, faces = mesh.vertices.astype(np.float64), mesh.faces
    opposite = mesh.pair_edges()[0]
    unpaired, points = opposite < 0, [np.flatnonzero(mesh.count_fans(opposite) > 1)]
    for rows in (positions, np.sort(faces, axis=1).astype(np.float64)):
        _, inverse, uses = np.unique(row_keys(rows), return_inverse=True, return_counts=True)
        points.append(np.flatnonzero(uses[inverse] > 1))
    points[2] = faces[points[2]].ravel().astype(np.intp)
    sides = (faces.ravel()[unpaired], np.roll(faces, -1, 1).ravel()[unpaired])
    return np.concatenate([positions[np.concatenate([end, *points])] for end in sides], axis=1)
