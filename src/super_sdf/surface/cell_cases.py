"""The rule by which the cases of marching cubes, the file ``cell_cases.npz``, were generated.

A cell has 8 corners, numbered ``4 x + 2 y + z``, and 12 edges. The first 256 cases have a bit for
each corner that is inside. The surface meets each face of the cell in segments. A face whose inside
corners are the ends of a diagonal is ambiguous: in these cases its segments separate them. Further
cases have the same corners inside and join them across some of these faces. Which it is depends on
the values at the corners of the face (``marching``), so the two cells that share it agree.

The segments form closed loops, and each loop is triangulated by diagonals that do not lie on a
face, or on one that the cell beyond it does not use, so that no edge can belong to more than two
triangles.

References
----------
Lorensen and Cline, "Marching Cubes", 1987. Nielson and Hamann, "The Asymptotic Decider: Resolving
the Ambiguity in Marching Cubes", 1991.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, lru_cache

import numpy as np

from .marching import CASES, EDGE_AXIS, EDGE_START, FACES, LOOPS, Tables, with_triangles

_STEP = (4, 2, 1)
EDGE_BETWEEN = {
    frozenset((start, start + _STEP[axis])): edge
    for edge, (start, axis) in enumerate(zip(EDGE_START, EDGE_AXIS))
}


def make_tables() -> Tables:
    """Return the tables by the rule; ``write_tables`` puts them into the file."""
    ambiguous = np.array([_ambiguous(inside) for inside in range(256)], np.uint8)
    number = np.full((256, 64), -1, np.int16)
    cases = [
        (inside, joined)
        for joined in range(64)
        for inside in range(256)
        if not joined & ~int(ambiguous[inside])
    ]
    number[tuple(np.transpose(cases))] = np.arange(len(cases))
    loops = [list(_loops(*case)) for case in cases]
    flat = [loop for some in loops for loop in some]
    sides = np.array([len(loop) for loop in flat], np.int8)
    edges = np.full((len(flat), sides.max()), -1, np.int8)
    places = np.zeros((len(flat), sides.max() - 2, 3), np.int8)
    for row, loop in enumerate(flat):
        edges[row, : len(loop)] = loop
        cut = [[loop.index(edge) for edge in triangle] for triangle in triangulate(loop)]
        places[row, : len(cut)] = cut
    count = np.array([len(some) for some in loops], np.int8)
    return with_triangles(ambiguous, number, count, sides, edges, places)


def write_tables() -> None:
    """Write the file of the package."""
    made = make_tables()._asdict()
    np.savez_compressed(CASES, **{name: made[name] for name in ("ambiguous", "number", *LOOPS)})


def _ambiguous(inside: int) -> int:
    """Return a bit for each face: whether its inside corners are the ends of a diagonal."""
    bits = [[inside >> corner & 1 for corner in face] for face in FACES]
    return sum(1 << n for n, (a, b, c, d) in enumerate(bits) if a == c != b == d)


def _loops(inside: int, joined: int) -> Iterator[tuple[int, ...]]:
    """Yield the closed loops of cell edges that the surface crosses."""
    after: dict[int, int] = {}
    for n, face in enumerate(FACES):
        after |= segments(n, tuple(inside >> corner & 1 for corner in face), joined >> n & 1)
    while after:
        first, edge = after.popitem()
        loop = [first]
        while edge != first:
            loop.append(edge)
            edge = after.pop(edge)
        yield tuple(loop)


@lru_cache(maxsize=192)
def segments(n: int, inside: tuple[int, ...], joined: int) -> dict[int, int]:
    """Return the segments on face ``n``: the edge where one ends, by that where it begins.

    Going round counter-clockwise, a run of inside corners begins after an outside one, and a
    segment begins with it. It ends where the run does; if the face joins two runs, where the other
    one does.
    """
    begins = [at for at in range(4) if inside[at] and not inside[at - 1]]
    ends = [next(n % 4 for n in range(at, at + 4) if not inside[(n + 1) % 4]) for at in begins]
    edges = [EDGE_BETWEEN[frozenset((FACES[n][at - 1], FACES[n][at]))] for at in range(4)]
    return {
        edges[at]: edges[(end + 1) % 4] for at, end in zip(begins, ends[::-1] if joined else ends)
    }


@cache
def triangulate(loop: tuple[int, ...]) -> list[tuple[int, int, int]]:
    """Return the triangles of a loop, cut along diagonals that lie on no face of the cell.

    Some loops that cross a face twice cannot be cut so. There, a diagonal may also join opposite
    edges of a face: along the first axis of a lower face, along the second of an upper one. A face
    is a lower one of one cell and an upper one of the other, so both never have the same diagonal.
    """
    return _cut(loop, on_faces=False) or _cut(loop, on_faces=True) or []


def _cut(loop: tuple[int, ...], on_faces: bool) -> list[tuple[int, int, int]] | None:
    """Return the triangles of a loop, cut along diagonals that may be; None if there are none."""
    if len(loop) < 3:
        return []
    for middle in range(1, len(loop) - 1):
        left, right = loop[: middle + 1], loop[middle:]
        if all(len(x) == 2 or _may_join(x[0], x[-1], on_faces) for x in (left, right)):
            some, others = _cut(left, on_faces), _cut(right, on_faces)
            if some is not None and others is not None:
                return [(loop[0], loop[middle], loop[-1]), *some, *others]
    return None


@lru_cache(maxsize=288)
def _may_join(a: int, b: int, on_faces: bool) -> bool:
    """Return whether a diagonal may join two cell edges, if need be on a face."""
    ends = {EDGE_START[a], EDGE_START[a] + _STEP[EDGE_AXIS[a]]}
    ends |= {EDGE_START[b], EDGE_START[b] + _STEP[EDGE_AXIS[b]]}
    face = next((n for n, corners in enumerate(FACES) if ends <= set(corners)), None)
    if face is None:
        return True
    axis, is_upper = divmod(face, 2)
    along = [other for other in range(3) if other != axis][is_upper]
    return on_faces and EDGE_AXIS[a] == EDGE_AXIS[b] == along
