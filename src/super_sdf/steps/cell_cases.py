"""The 256 cases of marching cubes, generated from one rule.

A cell has 8 corners, numbered ``4 x + 2 y + z``, and 12 edges. A case has a bit for each corner
that is inside. The surface meets each face of the cell in segments, which always separate inside
corners at opposite ends of a diagonal. This rule uses only the face itself, so the two cells that
share it agree (Lorensen and Cline 1987, with a face-consistent choice in the ambiguous cases;
Montani et al. 1994). The segments form closed loops, and each loop is triangulated by diagonals
that do not lie on a face, so that no edge can belong to more than two triangles.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..arrays import IntArray

CORNERS: IntArray = np.indices((2, 2, 2)).reshape(3, 8).T.astype(np.int32)
# Edge e runs from corner EDGE_START[e] one step along EDGE_AXIS[e].
EDGE_START = (0, 1, 2, 3, 0, 1, 4, 5, 0, 2, 4, 6)
EDGE_AXIS = (0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2)
# The corners of each face in counter-clockwise order, seen from outside the cell.
FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))

_STEP = (4, 2, 1)
_EDGE_BETWEEN = {
    frozenset((start, start + _STEP[axis])): edge
    for edge, (start, axis) in enumerate(zip(EDGE_START, EDGE_AXIS))
}


@lru_cache(maxsize=1)
def triangle_table() -> tuple[IntArray, IntArray]:
    """Return the triangles of every case.

    Returns
    -------
    (256,) int32 and (256, T, 3) int32
        The number of triangles of a case, and the cell edges on which their vertices lie, in
        counter-clockwise order seen from outside; unused rows are 0.
    """
    cases = [[t for loop in _loops(case) for t in _triangulate(loop)] for case in range(256)]
    counts = np.array([len(triangles) for triangles in cases], np.int32)
    table = np.zeros((256, counts.max(), 3), np.int32)
    for case, triangles in enumerate(cases):
        if triangles:
            table[case, : len(triangles)] = triangles
    return counts, table


@dataclass(frozen=True, eq=False)
class LoopTable:
    """The loops of all cases, one after the other: each is a patch of the surface in a cell.

    Attributes
    ----------
    count, first : (256,) int64
        How many loops a case has, and which is its first.
    sides : (L,) int64
        How many edges a loop has.
    edges : (L, S) int64
        Its cell edges in order, counter-clockwise from outside; -1 after the last.
    triangles : (L, T, 3) int64
        Places in the loop of the corners of its triangles, of which there are ``sides - 2``.
    """

    count: NDArray[np.int64]
    first: NDArray[np.int64]
    sides: NDArray[np.int64]
    edges: NDArray[np.int64]
    triangles: NDArray[np.int64]


@lru_cache(maxsize=1)
def loop_table() -> LoopTable:
    """Return the loops of every case, in the order of ``triangle_table``."""
    loops = [list(_loops(case)) for case in range(256)]
    count = np.array([len(some) for some in loops])
    flat = [loop for some in loops for loop in some]
    sides = np.array([len(loop) for loop in flat])
    edges = np.full((len(flat), sides.max()), -1)
    triangles = np.zeros((len(flat), sides.max() - 2, 3), np.int64)
    for row, loop in enumerate(flat):
        edges[row, : len(loop)] = loop
        place = {edge: nth for nth, edge in enumerate(loop)}
        cut = [[place[edge] for edge in triangle] for triangle in _triangulate(loop)]
        triangles[row, : len(cut)] = cut
    return LoopTable(count, np.cumsum(count) - count, sides, edges, triangles)


def _loops(case: int) -> Iterator[list[int]]:
    """Yield the closed loops of cell edges that the surface crosses."""
    after = dict(segment for face in FACES for segment in _segments(case, face))
    while after:
        first, edge = after.popitem()
        loop = [first]
        while edge != first:
            loop.append(edge)
            edge = after.pop(edge)
        yield loop


def _segments(case: int, face: tuple[int, ...]) -> Iterator[tuple[int, int]]:
    """Yield the segments on a face: one for each run of inside corners, from its start to its end.

    A run starts where, going round counter-clockwise, an inside corner follows an outside one.
    """
    inside = [bool(case >> corner & 1) for corner in face]
    for at in range(4):
        if inside[at] and not inside[at - 1]:
            end = next(n for n in range(at, at + 4) if not inside[(n + 1) % 4])
            leaving = frozenset((face[end % 4], face[(end + 1) % 4]))
            entering = frozenset((face[at - 1], face[at]))
            yield _EDGE_BETWEEN[entering], _EDGE_BETWEEN[leaving]


def _triangulate(loop: list[int]) -> list[tuple[int, int, int]]:
    """Return the triangles of a loop, cut along diagonals that lie on no face of the cell."""
    if len(loop) < 3:
        return []
    first, last = loop[0], loop[-1]
    for middle in range(1, len(loop) - 1):
        left, right = loop[: middle + 1], loop[middle:]
        if all(len(part) == 2 or not _share_face(part[0], part[-1]) for part in (left, right)):
            try:
                parts = _triangulate(left) + _triangulate(right)
            except _CannotCutError:
                continue
            return [(first, loop[middle], last), *parts]
    raise _CannotCutError


class _CannotCutError(Exception):
    """Raised for a part of a loop that cannot be triangulated; another middle may work."""


def _share_face(a: int, b: int) -> bool:
    """Return whether two cell edges lie on one face."""
    ends = {EDGE_START[a], EDGE_START[a] + _STEP[EDGE_AXIS[a]]}
    ends |= {EDGE_START[b], EDGE_START[b] + _STEP[EDGE_AXIS[b]]}
    return any(ends <= set(face) for face in FACES)
