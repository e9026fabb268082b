"""Surfaces of several labels that share their walls, made of the labels' fine fields.

The label whose field is lowest holds a node of the fine lattice: in a tie the lower label, 0 last.
Label 0 is what is beside all others; its field is minus that of a label, unless two others or more
could hold the node, which no label can in a voxel round which no sample has it. A wall crosses the
edge between nodes of two labels where their fields are equal, by linear interpolation: both labels
get the very same vertex. So each surface is closed, and there is neither gap nor overlap.

On a face with two labels the wall runs as in ``cell_cases``. Where three or four meet, a point on
the face is joined to all crossed edges, unless opposite corners have the same label: they are
joined, and each of the others is cut off. Both cells beside the face agree on it. A loop of these
segments between two labels is cut into triangles as in ``cell_cases``; those that hang together by
points on faces are joined to one point in the cell.

A point is named by its place in the lattice of half the fine spacing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ..arrays import CORNERS, FloatArray, IntArray
from ..refine.nodes import VoxelIndex, block_ijk
from ..surface.cell_cases import EDGE_BETWEEN, segments, triangulate
from ..surface.marching import CAP_HEIGHT, EDGE_AXIS, EDGE_START, FACES, cells_low_nodes, strides
from ..surface.mesh import CLEARANCE

EDGES = tuple(zip(EDGE_START, EDGE_AXIS))
STEP = (4, 2, 1)  # from a corner of a cell to the next one along each axis
FACE_POINTS, CELL_POINT = 12, 18  # the numbers of points, after those of the twelve edges
ON_EDGES = 2 * CORNERS[list(EDGE_START)] + np.eye(3, dtype=np.int32)[list(EDGE_AXIS)]
ON_FACES = [CORNERS[list(face)].sum(0) // 2 for face in FACES]
# Where the points are in a cell of two steps along each axis, (19, 3).
PLACES: IntArray = np.concatenate([ON_EDGES, ON_FACES, [[1, 1, 1]]]).astype(np.int32)

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

    def add(start: int, end: int, one: int, other: int) -> None:
        rows.append((start, end, one, other) if one > other else (end, start, other, one))

    for n, face in enumerate(FACES):
        of = [label[corner] for corner in face]
        edge = [EDGE_BETWEEN[frozenset((face[at - 1], face[at]))] for at in range(4)]
        if len(set(of)) == 2:
            inside = tuple(int(x == max(of)) for x in of)
            rows += [
                (*ends, max(of), min(of)) for ends in segments(n, inside, joined >> n & 1).items()
            ]
        elif of[0] == of[2] or of[1] == of[3]:
            first = int(of[0] == of[2])  # the first corner that is cut off
            for at in (first, first + 2) if len(set(of)) > 2 else ():
                add(edge[at], edge[(at + 1) % 4], of[at], of[at - 1])
        else:
            for at in range(4):
                if of[at] != of[at - 1]:
                    add(edge[at], FACE_POINTS + n, of[at], of[at - 1])
    faces = [(*abc, label.index(high), label.index(low)) for *abc, high, low in _triangles(rows)]
    return np.array(faces, np.int32).reshape(-1, 5)


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


Keys = NDArray[np.int64]
Labels = NDArray[np.int16]


@dataclass(frozen=True, eq=False)
class Labelled:
    """The fields of some labels at the nodes of the voxels in which their walls can be."""

    shape: tuple[int, int, int]  # samples of the grid along each axis
    factor: int  # K
    index: VoxelIndex  # finds the row of a voxel, counted from (-1, -1, -1)
    voxel_ijk: IntArray  # (D, 3), the voxels, in C order, also beyond the border: closed there
    holder: Labels  # (Q, D), the label of each node
    # for each label voxels, as ascending rows (n,), and their blocks, (Q, n); of label 0 values are
    # NaN, or missing, where they are minus those of any other
    fields: dict[int, tuple[NDArray[np.int64], FloatArray]]

    def apart(self, low: Keys, node: Keys, between: Labels, holder: Labels) -> NDArray[np.float64]:
        """Return by how much the field of a node's holder is lower than that of another, (n,).

        ``between`` (2, n) are both labels, the lower one first; ``low`` are the cells of the nodes.
        """
        voxel = np.clip(low // self.factor, 0, np.array(self.shape) - 1)
        row, place = self.index.find(voxel + 1), (node - self.factor * voxel) @ strides(self.factor)
        values = np.full(between.shape, np.nan)
        for label, (rows, blocks) in self.fields.items():
            for side in (0, 1):
                some = np.flatnonzero(between[side] == label)
                at = np.searchsorted(rows, row[some])
                known = np.flatnonzero(np.append(rows, -1)[at] == row[some])
                values[side, some[known]] = blocks[place[some[known]], at[known]]
        lower = np.where(np.isnan(values[0]), -values[1], values[0])
        apart = np.where(holder == between[0], values[1] - lower, lower - values[1])
        least: NDArray[np.float64] = np.maximum(apart, 0)
        return least  # the other may be lower where it cannot hold the node


def extract_walls(field: Labelled) -> tuple[NDArray[np.float64], IntArray, Labels]:
    """Return points (n, 3), in fine spacings from node (0, 0, 0), and the triangles of all walls.

    Triangles (m, 3) are counter-clockwise seen from the second of the labels beside each, (m, 2),
    of which the higher one is the first.
    """
    # cells that a wall crosses: low nodes, (n, 3), and labels of the corners, (n, 8)
    factor = field.factor
    least = most = field.holder.reshape(*(factor + 1,) * 3, -1)
    for axis in range(3):
        some, more = (slice(None),) * axis + (slice(-1),), (slice(None),) * axis + (slice(1, None),)
        least, most = np.minimum(least[some], least[more]), np.maximum(most[some], most[more])
    row, cell = np.divmod(np.flatnonzero(np.moveaxis(least != most, -1, 0)), factor**3)
    node = cells_low_nodes(factor)[cell]
    label = field.holder[node[:, None] + CORNERS @ strides(factor), row[:, None]]
    low = factor * field.voxel_ijk[row].astype(np.int64) + block_ijk(factor)[node]

    # the triangles of each cell's case, by the names of their points
    _, ny, nz = (2 * factor * (n + 2) + 1 for n in field.shape)  # a voxel beyond the grid, too
    along = np.array([ny * nz, nz, 1], np.int64)
    base, steps = 2 * (low + factor) @ along, PLACES @ along
    case, of_cell = np.unique(_cases(field, low, label), return_inverse=True)
    tables = [walls(int(number) & (1 << 24) - 1, int(number) >> 24) for number in case]
    counts = np.array([len(table) for table in tables], np.int64)
    first, times = (np.cumsum(counts) - counts)[of_cell], counts[of_cell]
    cell = np.repeat(np.arange(len(base)), times)
    nth = np.arange(len(cell)) - np.repeat(np.cumsum(times) - times, times) + first[cell]
    table = np.concatenate([np.empty((0, 5), np.int32), *tables])[nth]
    faces, sides = base[cell, None] + steps[table[:, :3]], label[cell[:, None], table[:, 3:]]

    # a point on each crossed edge, and means of those beside on faces, and then in cells
    edges = [np.flatnonzero(label[:, at] != label[:, at + STEP[axis]]) for at, axis in EDGES]
    named = np.concatenate([base[some] + step for some, step in zip(edges, steps)])
    keys, one = np.unique(named, return_index=True)
    edge = np.repeat(np.arange(12), [len(some) for some in edges])[one]
    places = _on_edges(field, low, label, np.concatenate(edges)[one], edge)
    used = np.unique(faces[table[:, :3] >= FACE_POINTS])
    between = np.stack([used // along[0], used // nz % ny, used % nz], 1) % 2 == 1  # nodes
    for axes in (2, 3):
        inner = between.sum(1) == axes
        total, count = np.zeros((inner.sum(), 3)), np.zeros(inner.sum())
        for axis, step in product(range(3), (-1, 1)):
            near = used[inner] + step * along[axis]
            at = np.searchsorted(keys, near).clip(max=len(keys) - 1)
            there = np.flatnonzero(between[inner, axis] & (keys[at] == near))
            total[there] += places[at[there]]
            count[there] += 1
        keys = np.concatenate([keys, used[inner]])
        order = np.argsort(keys)
        keys, places = keys[order], np.concatenate([places, total / count[:, None]])[order]
    return places, np.searchsorted(keys, faces).astype(np.int32), sides


def _cases(field: Labelled, low: Keys, label: Labels) -> Keys:
    """Return the case of each cell: the ranks of its labels, and which faces join (``walls``).

    A face joins its corners with the higher label where the difference of the labels' fields,
    interpolated bilinearly, is so at its saddle: see ``marching.choose_cases``.
    """
    ordered, rank = np.sort(label, axis=1), np.zeros(label.shape, np.int64)
    for nth in range(1, 8):
        is_next = ordered[:, nth] > ordered[:, nth - 1]
        rank += is_next[:, None] & (label >= ordered[:, nth, None])
    case: Keys = rank @ (1 << 3 * np.arange(8))
    for n, face in enumerate(FACES):
        a, b, c, d = label[:, face].T
        unsure = np.flatnonzero((a == c) & (b == d) & (a != b))
        start, holder = low[unsure], np.stack([a, b])[:, unsure]
        between = np.sort(holder, axis=0)
        one, other = (
            np.prod([field.apart(start, start + CORNERS[at], between, own) for at in corners], 0)
            for corners, own in zip((face[::2], face[1::2]), holder)
        )
        joined = np.where(holder[0] > holder[1], one > other, other > one)
        case[unsure] |= joined.astype(np.int64) << (24 + n)
    return case


def _on_edges(
    field: Labelled, low: Keys, label: Labels, cell: NDArray[np.intp], edge: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Return the points on crossed edges of cells, (n, 3), in fine spacings."""
    start, axis = np.array(EDGES)[edge].T
    corners = start, start + np.array(STEP)[axis]
    ends = [low[cell] + CORNERS[corner] for corner in corners]
    labels = np.stack([label[cell, corner] for corner in corners])
    last = field.factor * np.array(field.shape)
    share = np.full(len(cell), 0.5)  # half-way, if an end is beyond the border
    within = np.flatnonzero(((np.minimum(*ends) >= 0) & (np.maximum(*ends) <= last)).all(1))
    between = np.sort(labels[:, within], axis=0)
    one, other = (
        field.apart(low[cell[within]], end[within], between, own[within])
        for end, own in zip(ends, labels)
    )
    none = one + other == 0
    share[within] = np.where(none, 0.5, one / np.where(none, 1, one + other))
    share = np.clip(share, CLEARANCE, 1 - CLEARANCE)
    begin, stop = (np.clip(end.astype(float), -CAP_HEIGHT, last + CAP_HEIGHT) for end in ends)
    places: NDArray[np.float64] = begin + share[:, None] * (stop - begin)
    return places
