"""The walls between several labels in a cell of the fine lattice, generated from one rule.

A wall crosses the edges of the cell whose ends have different labels. On a face with two labels it
runs as in ``cell_cases``. Where three labels or four meet on a face, a point on it is joined to all
edges that are crossed, unless two opposite corners have the same label: they are joined, and each
of the others is cut off. This depends on the face alone, so both cells beside it agree.

The segments on all faces bound the walls. A loop of them between the same two labels is cut into
triangles as in ``cell_cases``; all that hang together by points on faces are joined to one point in
the cell. So the surface of each label is closed, and each triangle has a label on either side.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from ..arrays import IntArray
from .cell_cases import CORNERS, EDGE_AXIS, EDGE_BETWEEN, EDGE_START, FACES, segments, triangulate

FACE_POINTS, CELL_POINT = 12, 18  # the numbers of points, after those of the twelve edges
# Where the points are in a cell of two steps along each axis, (19, 3).
PLACES: IntArray = np.concatenate(
    [
        2 * CORNERS[list(EDGE_START)] + np.eye(3, dtype=np.int32)[list(EDGE_AXIS)],
        [CORNERS[list(face)].sum(0) // 2 for face in FACES],
        [[1, 1, 1]],
    ]
).astype(np.int32)

Segment = tuple[int, int, int, int]
"""Two points, and the labels inside and outside: the higher is inside, counter-clockwise."""


@lru_cache(maxsize=1 << 14)
def walls(ranks: int, joined: int) -> IntArray:
    """Return the triangles of a case, (n, 5): three points, and a corner on either side.

    Of ``ranks`` three bits are for each corner: how many labels at corners are lower. ``joined``
    has a bit for each face with two labels at the ends of its diagonals: whether it joins those of
    the higher. Triangles are counter-clockwise seen from the second corner, whose label is lower.
    """
    label = [ranks >> 3 * corner & 7 for corner in range(8)]
    rows: list[Segment] = []
    for n, face in enumerate(FACES):
        rows += _on_face(n, [label[corner] for corner in face], joined >> n & 1)
    faces = [(*abc, label.index(high), label.index(low)) for *abc, high, low in _triangles(rows)]
    return np.array(faces, np.int32).reshape(-1, 5)


def _on_face(n: int, label: list[int], joined: int) -> Iterator[Segment]:
    """Yield the segments on face ``n`` with these labels at its corners."""
    high, kinds = max(label), len(set(label))
    edge = [EDGE_BETWEEN[frozenset((FACES[n][at - 1], FACES[n][at]))] for at in range(4)]
    if kinds == 2:
        inside = tuple(int(x == high) for x in label)
        for start, end in segments(n, inside, joined).items():
            yield start, end, high, min(label)
    elif kinds > 2 and (label[0] == label[2] or label[1] == label[3]):
        first = int(label[0] == label[2])  # the first corner that is cut off
        for at in (first, first + 2):
            yield _turned(edge[at], edge[(at + 1) % 4], label[at], label[at - 1])
    elif kinds > 2:
        for at in range(4):
            if label[at] != label[at - 1]:
                yield _turned(edge[at], FACE_POINTS + n, label[at], label[at - 1])


def _turned(start: int, end: int, inside: int, outside: int) -> Segment:
    """Return a segment with the higher label inside."""
    return (start, end, inside, outside) if inside > outside else (end, start, outside, inside)


def _triangles(rows: list[Segment]) -> Iterator[tuple[int, ...]]:
    """Yield triangles, and the labels inside and outside, of the segments on a cell."""
    while rows:
        loop, points, some = [rows[-1][0]], {rows[-1][0]}, []
        while more := [row for row in rows if points & set(row[:2])]:  # all that hang together
            some += more
            points |= {point for row in more for point in row[:2]}
            rows = [row for row in rows if row not in more]
        if max(points) >= FACE_POINTS:
            yield from ((start, end, CELL_POINT, *sides) for start, end, *sides in some)
            continue
        after = {start: end for start, end, *_ in some}
        while (point := after[loop[-1]]) != loop[0]:
            loop.append(point)
        yield from ((*triangle, *some[0][2:]) for triangle in triangulate(tuple(loop)))
