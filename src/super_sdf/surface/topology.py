"""How the triangles of a mesh meet: at edges and around vertices, whatever their positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import IntArray
from ..threads import chunks_of
from .mesh import Mesh

TEMPORARIES = 8  # for chunks of 2^16 triangles: smaller ones may span as many vertices
END = np.int64(32)  # bits of the end of an edge; those above are of its start
MARKS = 1 << 46  # 2^7 of them can be summed in float64 without rounding


@dataclass(frozen=True)
class Edges:
    """Numbers of edges that are not shared by exactly two triangles of the same orientation."""

    open_edges: int  # of one triangle
    crowded_edges: int  # of more than two triangles: not manifold
    flipped_edges: int  # of two triangles that pass them in the same direction


def without_collapsed(faces: IntArray) -> IntArray:
    """Return the faces (m, 3) without those that have a vertex twice, and so no area."""
    a, b, c = faces.T
    whole = (a != b) & (b != c) & (c != a)
    return faces if whole.all() else faces[whole]


def pair_edges(faces: IntArray, count: int) -> tuple[IntArray, Edges]:
    """Find the neighbour of each triangle across each of its edges.

    Half-edge 3 f + i runs from corner i of face f to the next corner.
    """
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    key = np.minimum(start, end).astype(np.int64)
    key *= count
    key += np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    key = key[order]
    order = order.astype(np.int32)  # meshes are large: half of the memory
    first = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
    del key
    uses = np.diff(np.append(first, faces.size))
    pair = first[uses == 2]
    one, other = order[pair], order[pair + 1]
    against = start[one] == end[other]
    opposite = np.full(faces.size, -1, np.int32)
    opposite[one[against]], opposite[other[against]] = other[against], one[against]
    numbers = (uses == 1).sum(), (uses > 2).sum(), (~against).sum()
    return opposite, Edges(*map(int, numbers))


def count_fans(faces: IntArray, opposite: IntArray) -> NDArray[np.int64]:
    """Return for each vertex, (n,), how many fans of triangles meet there: 1 in a manifold.

    The half-edges of a vertex are walked from triangle to triangle, in steps of 1, 2, 4, ... A fan
    is a cycle, counted at its lowest half-edge, or ends at an edge without a neighbour.
    """
    start, half = faces.ravel(), np.arange(faces.size, dtype=np.int32)
    step = opposite[half.reshape(-1, 3)[:, [2, 0, 1]].ravel()]
    ends = step < 0
    step = np.where(ends, half, step)
    lowest = half
    for _ in range(int(np.bincount(start).max(initial=1)).bit_length()):
        lowest = np.minimum(lowest, lowest[step])
        step = step[step]
    cycles = (lowest == half) & ~ends[step]
    size = int(start.max(initial=-1)) + 1
    return np.bincount(start[ends], minlength=size) + np.bincount(start[cycles], minlength=size)


def vertex_components(faces: IntArray, count: int) -> NDArray[np.int64]:
    """Return the lowest vertex of the piece of each of ``count`` vertices, (count,).

    In rounds, the roots at both ends of each edge are joined, and the ways to them shortened.
    """
    root = np.arange(count)
    start, end = faces[:, :2].ravel(), faces[:, 1:].ravel()
    while len(start):
        one, other = root[start], root[end]
        apart = one != other
        start, end, one, other = start[apart], end[apart], one[apart], other[apart]
        np.minimum.at(root, np.maximum(one, other), np.minimum(one, other))
        while not np.array_equal(root, above := root[root]):
            root = above
    return root


def _marks(count: int) -> NDArray[np.float64]:
    """Return random whole numbers below ``MARKS``, by SplitMix64: numpy.random takes 10 ms to load.

    The first are the same for any count.
    """
    mixed = np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        mixed ^= mixed >> np.uint64(shift)
        mixed *= np.uint64(factor)
    mixed ^= mixed >> np.uint64(31)
    return (mixed % np.uint64(MARKS)).astype(np.float64)


class OpenEdges:
    """A running count of the open edges of a mesh that comes in pieces.

    An edge is open if triangles pass it more often in one direction than in the other. Only open
    edges are held: those at the end of the triangles so far, and those that no later one closes.

    To find them without sorting all edges, each vertex gets a random mark. At a vertex inside the
    surface, every neighbour follows in one triangle and precedes in another: the marks of those
    that follow, less those that precede, sum to 0. Edges between other vertices are paired exactly.
    At the end of an open edge the sum is 0 by chance once in 2^46 cases. A hole has three such ends
    at least, and is missed if two of them are.
    """

    def __init__(self) -> None:
        self.edges = np.empty(0, np.int64)
        self._marks = np.empty(0)

    def __len__(self) -> int:
        return len(self.edges)

    def add(self, faces: IntArray) -> None:
        """Add triangles, (m, 3) int32, which number the vertices of all pieces."""
        loose = [self._loose(faces[some]) for some in chunks_of(len(faces), TEMPORARIES)]
        self.edges = _unpaired(np.concatenate([self.edges, *loose]))

    def before(self, vertex: int) -> NDArray[np.int64]:
        """Return the open edges between vertices with numbers below one."""
        start, end = _ends(self.edges)
        return self.edges[np.maximum(start, end) < vertex]

    def _loose(self, faces: IntArray) -> NDArray[np.int64]:
        """Return the edges of triangles, (n,), of which each may be open."""
        lowest = faces.min()
        corners = faces.T.astype(np.intp, order="C")
        corners -= lowest
        count = int(corners.max()) + 1
        if count > len(self._marks):
            self._marks = _marks(count)
        marks = self._marks.take(corners)
        sides = np.empty_like(marks)
        for at in range(3):
            np.subtract(marks[at - 2], marks[at - 1], out=sides[at])
        is_open = np.bincount(corners.ravel(), sides.ravel(), count) != 0
        ends = is_open.take(corners)
        loose = []
        for at in range(3):
            some = np.flatnonzero(ends[at] & ends[at - 2])
            loose.append(_edge(corners[at, some] + lowest, corners[at - 2, some] + lowest))
        return np.concatenate(loose)


def _edge(start: NDArray[np.intp], end: NDArray[np.intp]) -> NDArray[np.int64]:
    """Return edges as numbers, (n,): see ``OpenEdges.edges``."""
    edges: NDArray[np.int64] = (start.astype(np.int64) << END) + end
    return edges


def _ends(edges: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the start and the end of edges."""
    start = edges >> END
    return start, edges - (start << END)


def _unpaired(edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the edges, sorted, without each that another one passes in the other direction."""
    start, end = _ends(edges)
    edges = np.where(start < end, edges, _edge(end, start))
    order = np.argsort(edges)
    edges, direction = edges[order], np.sign(end - start)[order]
    first = np.flatnonzero(np.append(True, edges[1:] != edges[:-1])[: len(edges)])
    left = np.add.reduceat(direction, first) if len(first) else first
    edges = edges[first]
    start, end = _ends(edges)
    return np.repeat(np.where(left > 0, edges, _edge(end, start)), np.abs(left))


def row_keys(rows: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return a hash of each row of numbers, (n,): equal rows have equal ones, others hardly ever.

    Zeros of either sign are equal.
    """
    keys = np.zeros(len(rows), np.uint64)
    for column in np.ascontiguousarray(rows.T + 0.0).view(np.uint64):
        keys = (keys ^ column) * np.uint64(0x9E3779B97F4A7C15)
        keys ^= keys >> np.uint64(29)
    return keys


def irregular_places(mesh: Mesh) -> NDArray[np.float64]:
    """Return where a mesh is no closed manifold, (n, 6): the two ends of an edge, or a point twice.

    These are the edges, in the direction of their triangle, without exactly one triangle that
    passes them in the other direction, and the vertices at which several fans of triangles meet, or
    that are at the position of another one, or at which two triangles have the same three corners.
    """
    positions, faces = mesh.vertices.astype(np.float64), mesh.faces
    opposite, _ = pair_edges(faces, len(positions))
    fans = count_fans(faces, opposite)
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
