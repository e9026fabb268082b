"""The walls between labels in a cell, by the labels at its corners.

On a face with two labels the wall runs as in ``surface.cell_cases``. Where three or four meet, a
point on the face is joined to all crossed edges, unless opposite corners have the same label: they
are joined, and each of the others is cut off. Both cells beside the face agree on it.

These segments part the surface of the cell into regions, each of one label. A loop between two
labels is cut into triangles as in ``cell_cases``. Segments that hang together by points on faces
are joined to a point in the cell. A label with two regions round them would have two fans of
triangles at that point, so one of the two is cut off by a point of its own, between its corners.
That cannot be done where a label is beside the region twice.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from ..arrays import CORNERS, IntArray
from ..surface.cell_cases import EDGE_BETWEEN, triangulate
from ..surface.marching import FACES

# The numbers of points: first those of the twelve edges, then those on faces, then in the cell.
FACE_POINTS, CELL_POINTS, MOST_POINTS = 12, 18, 26
EDGE_ENDS = np.array([sorted(ends) for ends in EDGE_BETWEEN]).T  # corners, (2, 12)
ON_FACES = [CORNERS[list(face)].sum(0) // 2 for face in FACES]
IN_CELL = np.ones((MOST_POINTS - CELL_POINTS, 3), int)
# Where the points are in a cell of two steps along each axis, (26, 3).
PLACES = np.concatenate([CORNERS[EDGE_ENDS].sum(0), ON_FACES, IN_CELL])

Segment = tuple[int, int, int, int]
"""Two points, and the labels inside and outside: the higher is inside, counter-clockwise."""
Sides = dict[tuple[int, int], int]
"""The label beside each segment, in the direction in which its region is inside."""


@lru_cache(maxsize=1 << 14)
def walls_of_cell(ranks: int, joined: int) -> IntArray:
    """Return the triangles of a case, (n, 5): three points, and a corner on either side.

    Of ``ranks`` three bits are for each corner: how many corners have a lower label. ``joined``
    has a bit for each face with two labels at the ends of its diagonals: whether it joins those of
    the higher. Triangles are counter-clockwise seen from the second corner, whose label is lower.
    A point in the cell is the last of its triangle.
    """
    label = [ranks >> 3 * corner & 7 for corner in range(8)]
    rows = [row for n in range(6) for row in _segments_on(n, label, joined >> n & 1)]
    found, free = list[tuple[int, ...]](), iter(range(CELL_POINTS, MOST_POINTS))
    while rows:
        loop, points, some = [rows[-1][0]], {rows[-1][0]}, []
        while more := [row for row in rows if points & set(row[:2])]:  # all that hang together
            some += more
            points |= {point for row in more for point in row[:2]}
            rows = [row for row in rows if row not in more]
        if max(points) >= FACE_POINTS:
            found += _joined(some, free)
            continue
        after = {start: end for start, end, *_ in some}
        while (point := after[loop[-1]]) != loop[0]:
            loop.append(point)
        found += [(*triangle, *some[0][2:]) for triangle in triangulate(tuple(loop))]
    faces = [(*abc, label.index(high), label.index(low)) for *abc, high, low in found]
    return np.array(faces, np.int32).reshape(-1, 5)


def _segments_on(n: int, label: list[int], joined: int) -> Iterator[Segment]:
    """Yield the segments on a face of a cell with these labels at its corners."""
    a, b, c, d = of = [label[corner] for corner in FACES[n]]
    edge = [EDGE_BETWEEN[frozenset((FACES[n][at - 1], FACES[n][at]))] for at in range(4)]
    crossed = [at for at in range(4) if of[at] != of[at - 1]]
    if a == c or b == d:  # two corners are joined, and each of the others is cut off
        first = int(a == c and (b != d or (b > a) != joined))
        cut = sorted((first, first + 2), key=lambda at: (at + joined) % 4)
        found = [(edge[at], edge[(at + 1) % 4], at) for at in cut if at in crossed]
    elif len(crossed) == 2:
        found = [(edge[crossed[0]], edge[crossed[1]], crossed[0])]
    else:
        found = [(edge[at], FACE_POINTS + n, at) for at in crossed]
    for start, end, at in found:
        one, other = of[at], of[at - 1]
        yield (start, end, one, other) if one > other else (end, start, other, one)


def _joined(rows: list[Segment], free: Iterator[int]) -> Iterator[tuple[int, ...]]:
    """Yield triangles, and the labels beside them, that join segments to ``free`` points."""
    sides: Sides = {}
    for start, end, one, other in rows:
        sides[start, end], sides[end, start] = one, other
    while region := _region_to_cut(sides):
        inside, point = sides[region[0]], next(free)
        beside = [sides[end, start] for start, end in region]
        for at, (start, end) in enumerate(region):
            outside, before = beside[at], beside[at - 1]
            del sides[start, end], sides[end, start]
            ends = (start, end) if inside > outside else (end, start)
            yield (*ends, point, max(inside, outside), min(inside, outside))
            if before != outside:  # what is left beside the region meets at its point
                sides[point, start], sides[start, point] = outside, before
    point = next(free)
    for (start, end), one in sides.items():
        if one > (other := sides[end, start]):
            yield start, end, point, one, other


def _region_to_cut(sides: Sides) -> list[tuple[int, int]]:
    """Return the segments round the smallest region that has to be cut off, and can be, if any."""
    after = {(label, start): end for (start, end), label in sides.items()}
    regions: dict[int, list[list[tuple[int, int]]]] = {}
    while after:
        (label, first), point = after.popitem()
        region = [(first, point)]
        while point != first:
            region.append((point, after.pop((label, point))))
            point = region[-1][1]
        regions.setdefault(label, []).append(region)
    several = [region for some in regions.values() if len(some) > 1 for region in some]
    for region in sorted(several, key=len):
        beside = [sides[end, start] for start, end in region]
        runs = sum(beside[at - 1] != outside for at, outside in enumerate(beside))
        if runs == len(set(beside)) > 1:
            return region
    return []
