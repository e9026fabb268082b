"""Pairs of triangles that intersect.

Positions are in fine spacings, from node (0, 0, 0) of the fine lattice.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arrays import BoolArray
from .patches import Index, Vectors, cross, dot, nth_of_row, unit

FARTHEST = 1 << 20  # more cells than along any axis
TOUCHING = 1e-5  # fine spacings at which triangles intersect: vertices are rounded in the end ...
STEEP = 1e-2  # ... if a side rises by this over the other triangle ...
FLAT = 1e-9  # ... and by which it has to pass through if not: triangles of a plane do not


def overlapping_boxes(points: Vectors, triangles: Index, suspect: BoolArray) -> tuple[Index, Index]:
    """Return pairs of triangles whose boxes overlap, one at a suspect; some pairs twice.

    A triangle is listed in the cells from which it reaches into the next, or in its only one.
    """
    a, b, c = (points[corner] for corner in triangles.T)
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    first, last = np.floor(low).astype(np.int64), np.floor(high).astype(np.int64)
    a, b, c = triangles.T
    chosen = suspect[a] | suspect[b] | suspect[c]
    mine, my_cell = cells_of(first - 1, last, np.flatnonzero(chosen))
    listed, cell = cells_of(first, np.maximum(first, last - 1), np.arange(len(chosen)))
    order = np.argsort(cell)
    cell, listed = cell[order], listed[order]
    start, stop = np.searchsorted(cell, my_cell), np.searchsorted(cell, my_cell, "right")
    pair = np.repeat(np.arange(len(mine)), stop - start)
    one, other = mine[pair], listed[start[pair] + nth_of_row(pair, stop - start)]
    for lower, upper in zip(low.T, high.T):
        kept = (lower[one] <= upper[other]) & (lower[other] <= upper[one])
        one, other = one[kept], other[kept]
    once = (one < other) | ~chosen[other]
    return one[once], other[once]


def cells_of(first: Index, last: Index, rows: Index) -> tuple[Index, Index]:
    """Return the cells from the first to the last, (b, 3), of some rows: which row, and key."""
    size = last[rows] - first[rows] + 1
    times = size[:, 0] * size[:, 1] * size[:, 2]
    row = np.repeat(np.arange(len(rows)), times)
    nth, k = np.divmod(nth_of_row(row, times), size[row, 2])
    i, j = np.divmod(nth, size[row, 1])
    return rows[row], keys_of(first[rows])[row] + (i * FARTHEST + j) * FARTHEST + k


def keys_of(ijk: NDArray[Any]) -> Index:
    """Return a number for each cell, (n,)."""
    i, j, k = ijk.astype(np.int64).T
    keys: Index = (i * FARTHEST + j) * FARTHEST + k
    return keys


def intersecting(points: Vectors, first: Index, second: Index) -> tuple[Index, Index]:
    """Return those of pairs of triangles, corners (m, 3) each, that intersect.

    A side of one of them then pierces the other, off common vertices.
    """
    for _ in range(2):
        heights = heights_over(points, first, second)
        low, high = np.fmin.reduce(heights), np.fmax.reduce(heights)
        kept = (low < TOUCHING) & (high > -TOUCHING) & (low < high)
        first, second = second[kept], first[kept]
    found = pierced(points, first, second) | pierced(points, second, first)
    return first[found], second[found]


def heights_over(points: Vectors, first: Index, second: Index) -> NDArray[np.float64]:
    """Return how far over the first triangles the second's corners are, (3, m); NaN if common."""
    a, b, c = (points[corner] for corner in first.T)
    normals = unit(cross(b - a, c - a))
    heights = np.stack([dot(points[corner] - a, normals) for corner in second.T])
    heights[np.any(second.T[:, None] == first.T, axis=1)] = np.nan
    return heights


def pierced(points: Vectors, first: Index, second: Index) -> BoolArray:
    """Return which of the first triangles are pierced by a side of the second, (m,)."""
    heights = heights_over(points, first, second)
    found: BoolArray = np.zeros(len(first), bool)
    for k in range(3):
        low, high = np.minimum(heights[k], heights[k - 1]), np.maximum(heights[k], heights[k - 1])
        slack = np.where(high - low > STEEP, TOUCHING, -FLAT)
        rows = np.flatnonzero((low < slack) & (high > -slack))
        start, end = points[second[rows, k]], points[second[rows, k - 1]]
        way, slack = unit(end - start), slack[rows]
        a, b, c = (points[corner] - start for corner in first[rows].T)
        beyond = [dot(way, cross(p, unit(q - p))) for p, q in ((a, b), (b, c), (c, a))]
        found[rows] |= np.minimum.reduce(beyond) > -slack
        found[rows] |= np.maximum.reduce(beyond) < slack
    return found
