"""No triangles that intersect: what folds the surface is undone.

A fan whose vertex lies in its cell, with crossings on their lattice edges, meets no fan of another
cell. So what intersects has a feature's vertex outside its cell, a moved crossing or a turned side.

1. Suspects are vertices round which the surface does not face one way. Their triangles are tested
   against all others whose boxes they overlap.
2. Of a pair that intersects, the feature's vertex that is least outside its cell is pulled into it:
   a corner, which may be farther out, stays. If there is none, all vertices are put back.
3. Triangles that this changes are tested again. Of those that intersect now, all vertices of
   features are pulled into their cells, and crossings go back onto their lattice edges.
4. Twice more; now features are dropped.

Positions are in fine spacings, from node (0, 0, 0) of the fine lattice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...arrays import NEIGHBOURHOOD, BoolArray, Index, Vectors, dot, length, sums_at, unit
from .patches import Patches, Placed, nth_of_run, triangles_of

# Vertices of triangles that intersect are in cells at most 3 apart: none is more than half a cell
# outside its own, and a triangle has vertices of two cells.
APART = 3
# Whether only the vertex least outside its cell is pulled back, and whether features are dropped.
ROUNDS = ((True, False), (False, False), (False, True), (False, True))
# Cells that the vertices depend on: in each round on such triangles, and on those beside that are
# suspects.
REACH = len(ROUNDS) * (APART + 1) + 2
ONE_WAY = 0.1  # least cosine between normals and their mean where a surface faces one way
LEAST_MOVE = 0.1  # of the way to the nearest node, from which a crossing may fold the surface
INSIDE_CELL = 0.02  # fine spacings from its faces that a vertex is pulled into a cell
FARTHEST = 1 << 20  # more cells than along any axis
TOUCHING = 1e-5  # fine spacings at which triangles intersect ...
STEEP = 1e-2  # ... if a side rises by this over the other triangle ...
FLAT = 1e-9  # ... and by which it has to pass through if not: triangles of a plane do not

Rounding: TypeAlias = Callable[[Vectors], Vectors]


def without_folds(patches: Patches, placed: Placed, lattice: Vectors, rounded: Rounding) -> Placed:
    """Return the vertices with fewer features and moves, so that no triangles intersect.

    ``lattice``, (n, 3), are the crossings where they were on their lattice edges. ``rounded``
    returns points as they are written: far from the origin, those may intersect where others do
    not.
    """
    suspect = find_suspects(patches, placed, lattice)
    keys = keys_of(np.floor(patches.low / APART))
    order = np.argsort(keys)
    keys = keys[order]
    for least, drop in ROUNDS:
        close = np.zeros(len(keys), bool)  # patches in cells from which triangles reach suspects
        cells = np.unique(keys_of(np.floor(patches.low[_having(patches, placed, suspect)] / APART)))
        around = np.unique(cells[:, None] + keys_of(NEIGHBOURHOOD))
        start, stop = np.searchsorted(keys, around), np.searchsorted(keys, around, "right")
        close[order[np.repeat(start, stop - start) + nth_of_run(stop - start)]] = True
        _, triangles = triangles_of(patches, placed, close)
        points, step = rounded(placed.points), np.zeros(len(suspect))
        one, other = overlapping_boxes(points, triangles, suspect)
        pairs = np.concatenate(intersecting(points, triangles[one], triangles[other]), 1)
        if least:  # of each pair only the vertex that is least outside its cell
            low = patches.low[placed.feature]
            beyond = np.maximum(low - placed.peak, placed.peak - low - 1).max(1)
            step[: len(lattice)], step[len(lattice) :] = 1, np.where(beyond > 0, beyond, 1)
        folded = np.zeros(len(suspect), bool)
        folded[pairs[step[pairs] == step[pairs].min(1, initial=1, keepdims=True)]] = True
        if not folded.any():
            break
        crossings = folded[: len(lattice)]
        fans = patches.dilate(_having(patches, placed, folded), 1, len(crossings))
        suspect = np.concatenate([crossings, patches.having(fans)[placed.feature]])
        placed = put_back(patches, placed, lattice, folded)
        if drop:
            left = np.concatenate([np.ones(len(lattice), bool), ~folded[len(lattice) :]])
            suspect, kept = suspect[left], left[len(lattice) :]
            placed = replace(placed, feature=placed.feature[kept], peak=placed.peak[kept])
    return placed


def find_suspects(patches: Patches, placed: Placed, lattice: Vectors) -> BoolArray:
    """Return the vertices, (n + f,), where fans and moved crossings may fold the surface.

    There it does not face one way: the triangles at the vertex, or the planes of the crossings
    round a node of the lattice, where two sheets may pass.
    """
    to_node = length(lattice - np.rint(lattice))
    moved = length(placed.position - lattice) > LEAST_MOVE * to_node
    changed = np.concatenate([moved, np.ones(len(placed.feature), bool)])
    _, triangles = triangles_of(patches, placed, _having(patches, placed, changed))
    a, b, c = (placed.points.take(corner, 0) for corner in triangles.T)
    normals = np.tile(unit(np.cross(b - a, c - a)), (3, 1))
    suspect = _turns(triangles.T.ravel(), normals, len(changed))
    nodes, node = np.unique(keys_of(np.rint(lattice)), return_inverse=True)
    sheets = _turns(node, placed.normal, len(nodes))[node]
    used = np.zeros(len(changed), bool)
    used[triangles] = True
    suspect[: len(lattice)] |= sheets & used[: len(lattice)]
    return suspect


def _turns(place: Index, normals: Vectors, count: int) -> BoolArray:
    """Return which of ``count`` places have normals that do not face one way."""
    mean = unit(sums_at(place, normals, count))
    found: BoolArray = np.zeros(count, bool)
    found[place[dot(normals, mean.take(place, 0)) < ONE_WAY]] = True
    return found


def _having(patches: Patches, placed: Placed, chosen: BoolArray) -> BoolArray:
    """Return the patches, (P,), that have some of the vertices, (n + f,)."""
    crossings, peaks = np.split(chosen, [len(placed.position)])
    found = patches.having(crossings)
    found[placed.feature[peaks]] = True
    return found


def put_back(patches: Patches, placed: Placed, lattice: Vectors, chosen: BoolArray) -> Placed:
    """Return the vertices, chosen ones on their lattice edges or in their cells.

    Features' vertices are pulled towards the middles of their crossings.
    """
    crossings, peaks = np.split(chosen, [len(lattice)])
    placed = replace(placed, position=np.where(crossings[:, None], lattice, placed.position))
    fans = patches.chosen(placed.feature)
    low, high = fans.low + INSIDE_CELL, fans.low + 1 - INSIDE_CELL
    middle = np.clip(fans.mean(placed.position), low, high)
    way = placed.peak - middle
    room = np.where(way > 0, high - middle, middle - low)
    share = np.min(room / np.maximum(np.abs(way), 1e-12), axis=1)[:, None]
    pulled = peaks[:, None] & (share < 1)
    return replace(placed, peak=np.where(pulled, middle + share * way, placed.peak))


def overlapping_boxes(points: Vectors, triangles: Index, suspect: BoolArray) -> tuple[Index, Index]:
    """Return pairs of triangles whose boxes overlap, one at a suspect; some pairs twice.

    A triangle is listed in the cells from which it reaches into the next, or in its only one.
    """
    a, b, c = (points.take(corner, 0) for corner in triangles.T)
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    first, last = np.floor(low).astype(np.int64), np.floor(high).astype(np.int64)
    chosen: BoolArray = np.any(suspect[triangles], axis=1)
    mine, my_cell = _cells_of(first - 1, last, np.flatnonzero(chosen))
    listed, cell = _cells_of(first, np.maximum(first, last - 1), np.arange(len(chosen)))
    order = np.argsort(cell)
    cell, listed = cell[order], listed[order]
    start, stop = np.searchsorted(cell, my_cell), np.searchsorted(cell, my_cell, "right")
    pair = np.repeat(np.arange(len(mine)), stop - start)
    one, other = mine[pair], listed[start[pair] + nth_of_run(stop - start)]
    for lower, upper in zip(low.T, high.T):
        kept = (lower[one] <= upper[other]) & (lower[other] <= upper[one])
        one, other = one[kept], other[kept]
    once = (one < other) | ~chosen[other]
    return one[once], other[once]


def _cells_of(first: Index, last: Index, rows: Index) -> tuple[Index, Index]:
    """Return the cells from the first to the last, (b, 3), of some rows: which row, and key."""
    size = last[rows] - first[rows] + 1
    times = size[:, 0] * size[:, 1] * size[:, 2]
    row = np.repeat(np.arange(len(rows)), times)
    nth, k = np.divmod(nth_of_run(times), size[row, 2])
    i, j = np.divmod(nth, size[row, 1])
    return rows[row], keys_of(first[rows])[row] + (i * FARTHEST + j) * FARTHEST + k


def keys_of(ijk: NDArray[Any]) -> Index:
    """Return a number for each cell, (n,)."""
    i, j, k = ijk.astype(np.int64).T
    return np.asarray((i * FARTHEST + j) * FARTHEST + k)


def intersecting(points: Vectors, first: Index, second: Index) -> tuple[Index, Index]:
    """Return those of pairs of triangles, corners (m, 3) each, that intersect.

    A side of one of them then pierces the other, off common vertices.
    """
    for _ in range(2):
        heights = _heights_over(points, first, second)
        low, high = np.fmin.reduce(heights), np.fmax.reduce(heights)
        kept = (low < TOUCHING) & (high > -TOUCHING) & (low < high)
        first, second = second[kept], first[kept]
    found = _pierced(points, first, second) | _pierced(points, second, first)
    return first[found], second[found]


def _heights_over(points: Vectors, first: Index, second: Index) -> Vectors:
    """Return how far over the first triangles the second's corners are, (3, m); NaN if common."""
    a, b, c = (points.take(corner, 0) for corner in first.T)
    normals = unit(np.cross(b - a, c - a))
    heights = np.stack([dot(points.take(corner, 0) - a, normals) for corner in second.T])
    heights[np.any(second.T[:, None] == first.T, axis=1)] = np.nan
    return heights


def _pierced(points: Vectors, first: Index, second: Index) -> BoolArray:
    """Return which of the first triangles are pierced by a side of the second, (m,)."""
    heights = _heights_over(points, first, second)
    found: BoolArray = np.zeros(len(first), bool)
    for k in range(3):
        low, high = np.minimum(heights[k], heights[k - 1]), np.maximum(heights[k], heights[k - 1])
        slack = np.where(high - low > STEEP, TOUCHING, -FLAT)
        rows = np.flatnonzero((low < slack) & (high > -slack))
        start, end = points[second[rows, k]], points[second[rows, k - 1]]
        way, slack = unit(end - start), slack[rows]
        a, b, c = (points[corner] - start for corner in first[rows].T)
        beyond = [dot(way, np.cross(p, unit(q - p))) for p, q in ((a, b), (b, c), (c, a))]
        found[rows] |= np.minimum.reduce(beyond) > -slack
        found[rows] |= np.maximum.reduce(beyond) < slack
    return found
