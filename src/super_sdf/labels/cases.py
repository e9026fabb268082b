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
from itertools import pairwise

import numpy as np

from ..arrays import CORNERS, IntArray
from ..surface.cell_cases import EDGE_BETWEEN, segments, triangulate
from ..surface.marching import EDGE_AXIS, EDGE_START, FACES

# The numbers of points: first those of the twelve edges, then those on faces, then in the cell.
FACE_POINTS, CELL_POINTS, MOST_POINTS = 12, 18, 26
ON_EDGES = 2 * CORNERS[list(EDGE_START)] + np.eye(3, dtype=np.int32)[list(EDGE_AXIS)]
ON_FACES = [CORNERS[list(face)].sum(0) // 2 for face in FACES]
IN_CELL = np.ones((MOST_POINTS - CELL_POINTS, 3), np.int32)
# Where the points are in a cell of two steps along each axis, (26, 3).
PLACES: IntArray = np.concatenate([ON_EDGES, ON_FACES, IN_CELL]).astype(np.int32)

Segment = tuple[int, int, int, int]
"""Two points, and the labels inside and outside: the higher is inside, counter-clockwise."""
Sides = dict[tuple[int, int], int]
"""The label beside each segment, in the direction in which its region is inside."""


@lru_cache(maxsize=1 << 14)
def walls_of_cell(ranks: int, joined: int) -> IntArray:
    """Return the triangles of a case, (n, 5): three points, and a corner on either side.

    Of ``ranks`` three bits are for each corner: how many labels at corners are lower. ``joined``
    has a bit for each face with two labels at the ends of its diagonals: whether it joins those of
    the higher. Triangles are counter-clockwise seen from the second corner, whose label is lower.
    A point in the cell is the last of its triangle.
    """
    label = [ranks >> 3 * corner & 7 for corner in range(8)]
    rows = [row for n in range(6) for row in _segments_on(n, label, joined >> n & 1)]
    faces = [(*abc, label.index(high), label.index(low)) for *abc, high, low in _triangles(rows)]
    return np.array(faces, np.int32).reshape(-1, 5)


def _segments_on(n: int, label: list[int], joined: int) -> Iterator[Segment]:
    """Yield the segments on a face of a cell with these labels at its corners."""
    of = [label[corner] for corner in FACES[n]]
    edge = [EDGE_BETWEEN[frozenset((FACES[n][at - 1], FACES[n][at]))] for at in range(4)]
    if len(set(of)) == 2:
        inside = tuple(int(x == max(of)) for x in of)
        for start, end in segments(n, inside, joined).items():
            yield start, end, max(of), min(of)
        return
    if of[0] == of[2] or of[1] == of[3]:
        first = int(of[0] == of[2])  # the first corner that is cut off
        cut = (first, first + 2) if len(set(of)) > 2 else ()
        found = [(edge[at], edge[(at + 1) % 4], of[at], of[at - 1]) for at in cut]
    else:
        found = [
            (edge[at], FACE_POINTS + n, of[at], of[at - 1])
            for at in range(4)
            if of[at] != of[at - 1]
        ]
    for start, end, one, other in found:
        yield (start, end, one, other) if one > other else (end, start, other, one)


def _triangles(rows: list[Segment]) -> Iterator[tuple[int, ...]]:
    """Yield triangles, and the labels inside and outside, of the segments on a cell."""
    free = CELL_POINTS
    while rows:
        loop, points, some = [rows[-1][0]], {rows[-1][0]}, []
        while more := [row for row in rows if points & set(row[:2])]:  # all that hang together
            some += more
            points |= {point for row in more for point in row[:2]}
            rows = [row for row in rows if row not in more]
        if max(points) >= FACE_POINTS:
            made = list(_joined(some, free))
            free = 1 + max(third for _, _, third, *_ in made)
            yield from made
            continue
        after = {start: end for start, end, *_ in some}
        while (point := after[loop[-1]]) != loop[0]:
            loop.append(point)
        yield from ((*triangle, *some[0][2:]) for triangle in triangulate(tuple(loop)))


def _joined(rows: list[Segment], point: int) -> Iterator[tuple[int, ...]]:
    """Yield the triangles of segments that are joined to points in the cell, from ``point`` on."""
    sides: Sides = {}
    for start, end, one, other in rows:
        sides[start, end], sides[end, start] = one, other
    while region := _region_to_cut(sides):
        around = list(zip(region, region[1:] + region[:1]))
        inside, beside = sides[around[0]], [sides[end, start] for start, end in around]
        for (start, end), outside in zip(around, beside):
            del sides[start, end], sides[end, start]
            ends = (start, end) if inside > outside else (end, start)
            yield (*ends, point, max(inside, outside), min(inside, outside))
        # what is left beside the region meets at its point
        for at, outside in enumerate(beside):
            if beside[at - 1] != outside:
                sides[point, region[at]], sides[region[at], point] = outside, beside[at - 1]
        point += 1
    for (start, end), one in sides.items():
        if one > (other := sides[end, start]):
            yield start, end, point, one, other


def _region_to_cut(sides: Sides) -> list[int] | None:
    """Return the points round the smallest region that has to be cut off, and can be."""
    after = {(label, start): end for (start, end), label in sides.items()}
    regions: dict[int, list[list[int]]] = {}
    while after:
        (label, first), point = after.popitem()
        region = [first]
        while point != first:
            region.append(point)
            point = after.pop((label, point))
        regions.setdefault(label, []).append(region)
    several = [region for some in regions.values() if len(some) > 1 for region in some]
    for region in sorted(several, key=len):
        beside = [sides[end, start] for start, end in pairwise([*region, region[0]])]
        runs = sum(beside[at - 1] != outside for at, outside in enumerate(beside))
        if runs == len(set(beside)) > 1:
            return region
    return None
