"""Surfaces of several labels that share their walls, made of the labels' fine fields.

At every node of the fine lattice the label whose field is lowest holds the node: in a tie the lower
label, 0 last. Label 0 is what is beside all others; its field is minus that of a label, unless two
others or more could hold the node. A label cannot hold a node of a voxel round which no sample has
it. A wall crosses the edge between two nodes of different labels where the difference of the two
fields is 0, by linear interpolation: both labels get the very same vertex. So the surface of each
label is closed, and there is neither gap nor overlap between two.

On a face with two labels the wall runs as in ``cell_cases``. Where three labels or four meet on a
face, a point on it is joined to all edges that are crossed, unless two opposite corners have the
same label: they are joined, and each of the others is cut off. This depends on the face alone, so
both cells beside it agree. A loop of these segments between the same two labels is cut into
triangles as in ``cell_cases``; all that hang together by points on faces are joined to one point in
the cell.

A vertex is named by its place in the lattice of half the fine spacing, which tells points on edges,
on faces and in cells apart. So the walls of parts of a grid can be joined by the names.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import CORNERS, FloatArray, IntArray
from ..refine.nodes import VoxelIndex, block_ijk
from ..surface.cap import outer_voxels
from ..surface.cell_cases import EDGE_BETWEEN, segments, triangulate
from ..surface.marching import CAP_HEIGHT, EDGE_AXIS, EDGE_START, FACES, cells_low_nodes, strides
from ..surface.mesh import CLEARANCE

EDGES = tuple(zip(EDGE_START, EDGE_AXIS))
STEP = (4, 2, 1)  # from a corner of a cell to the next one along each axis
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

    def turned(start: int, end: int, inside: int, outside: int) -> Segment:
        return (start, end, inside, outside) if inside > outside else (end, start, outside, inside)

    if kinds == 2:
        inside = tuple(int(x == high) for x in label)
        for start, end in segments(n, inside, joined).items():
            yield start, end, high, min(label)
    elif kinds > 2 and (label[0] == label[2] or label[1] == label[3]):
        first = int(label[0] == label[2])  # the first corner that is cut off
        for at in (first, first + 2):
            yield turned(edge[at], edge[(at + 1) % 4], label[at], label[at - 1])
    elif kinds > 2:
        for at in range(4):
            if label[at] != label[at - 1]:
                yield turned(edge[at], FACE_POINTS + n, label[at], label[at - 1])


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
    planes: tuple[int, int]  # of voxels whose walls are made, from the first to before the second
    index: VoxelIndex  # finds the row of a voxel
    voxel_ijk: IntArray  # (D, 3), the voxels, in C order
    holder: Labels  # (Q, D), the label of each node
    border: IntArray  # (b, 4), voxels on the border of the grid and their labels: closed there
    # for each label voxels, as ascending rows (n,), and their blocks, (Q, n); of label 0 values are
    # NaN, or missing, where they are minus those of any other
    fields: dict[int, tuple[NDArray[np.int64], FloatArray]]

    @property
    def strides(self) -> Keys:
        """The steps of names along the axes; the lattice goes a coarse voxel beyond the grid."""
        _, ny, nz = (2 * self.factor * (n + 2) + 1 for n in self.shape)
        return np.array([ny * nz, nz, 1], np.int64)

    def apart(self, low: Keys, node: Keys, between: Labels, holder: Labels) -> NDArray[np.float64]:
        """Return by how much the field of a node's holder is lower than that of another, (n,).

        ``between`` (2, n) are both labels, the lower one first; ``low`` are the cells of the nodes.
        """
        voxel = np.clip(low // self.factor, 0, np.array(self.shape) - 1)
        row, place = self.index.find(voxel), (node - self.factor * voxel) @ strides(self.factor)
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


class Walls(NamedTuple):
    """Walls in a part of a grid: points in the order of their names, and triangles of names."""

    keys: Keys  # (n,), names: numbers on the lattice of half the fine spacing, see ``Labelled``
    places: NDArray[np.float64]  # (n, 3), in fine spacings from node (0, 0, 0)
    faces: Keys  # (m, 3), counter-clockwise seen from the second label beside it
    sides: Labels  # (m, 2), the labels beside it, the higher one first


def join_walls(parts: Sequence[Walls]) -> tuple[NDArray[np.float64], IntArray, Labels]:
    """Return the places of all points, triangles of their numbers, and the labels beside these."""
    keys, first = np.unique(np.concatenate([part.keys for part in parts]), return_index=True)
    places = np.concatenate([part.places for part in parts])[first]
    faces = np.searchsorted(keys, np.concatenate([part.faces for part in parts]))
    return places, faces.astype(np.int32), np.concatenate([part.sides for part in parts])


def extract_walls(field: Labelled) -> Walls:
    """Return the walls in the planes of fields."""
    low, label = _cells(field)
    base, steps = 2 * (low + field.factor) @ field.strides, PLACES @ field.strides

    # the triangles of each cell's case
    case, of_cell = np.unique(_cases(field, low, label), return_inverse=True)
    tables = [walls(int(number) & (1 << 24) - 1, int(number) >> 24) for number in case]
    counts = np.array([len(table) for table in tables], np.int64)
    first, times = (np.cumsum(counts) - counts)[of_cell], counts[of_cell]
    cell = np.repeat(np.arange(len(base)), times)
    nth = np.arange(len(cell)) - np.repeat(np.cumsum(times) - times, times) + first[cell]
    table = np.concatenate([np.empty((0, 5), np.int32), *tables])[nth]
    faces, sides = base[cell, None] + steps[table[:, :3]], label[cell[:, None], table[:, 3:]]

    # a point on each crossed edge, and means of these on faces and in cells
    edges = [np.flatnonzero(label[:, at] != label[:, at + STEP[axis]]) for at, axis in EDGES]
    keys, one = np.unique(
        np.concatenate([base[some] + step for some, step in zip(edges, steps)]), return_index=True
    )
    edge = np.repeat(np.arange(12), [len(some) for some in edges])[one]
    places = _on_edges(field, low, label, np.concatenate(edges)[one], edge)
    inner = np.unique(faces[table[:, :3] >= FACE_POINTS])
    return Walls(*_with_inner_points(keys, places, inner, field.strides), faces, sides)


def _cells(field: Labelled) -> tuple[Keys, Labels]:
    """Return the low nodes, (n, 3), and labels, (n, 8), of the cells in which walls are."""
    voxel_ijk, holder = _closed(field)
    corners = holder.reshape(*(field.factor + 1,) * 3, -1)
    least, most = corners, corners
    for axis in range(3):
        some, more = (slice(None),) * axis + (slice(-1),), (slice(None),) * axis + (slice(1, None),)
        least, most = np.minimum(least[some], least[more]), np.maximum(most[some], most[more])
    plane = np.clip(voxel_ijk[:, 0], 0, field.shape[0] - 1)
    crossed = (least != most) & (plane >= field.planes[0]) & (plane < field.planes[1])
    row, cell = np.divmod(np.flatnonzero(np.moveaxis(crossed, -1, 0)), field.factor**3)
    node = cells_low_nodes(field.factor)[cell]
    label = holder[node[:, None] + CORNERS @ strides(field.factor), row[:, None]]
    return field.factor * voxel_ijk[row].astype(np.int64) + block_ijk(field.factor)[node], label


def _closed(field: Labelled) -> tuple[IntArray, Labels]:
    """Return voxels and the labels of their nodes, with those beyond the border: see ``cap``."""
    shape, factor, size = np.array(field.shape), field.factor, len(field.holder)
    filled = field.border[field.index.find(field.border[:, :3]) < 0]
    voxel_ijk = np.concatenate([field.voxel_ijk, filled[:, :3]])
    order = np.lexsort(voxel_ijk.T[::-1])
    of_filled = np.broadcast_to(filled[:, 3].astype(np.int16), (size, len(filled)))
    voxel_ijk = voxel_ijk[order]
    holder = np.concatenate([field.holder, of_filled], axis=1)[:, order]
    outer = outer_voxels(voxel_ijk, np.array([(0, 0, 0), field.shape]))
    beside = np.clip(outer, 0, shape - 1)
    row = VoxelIndex(voxel_ijk, field.shape).find(beside)
    of_outer = np.zeros((size, len(outer)), np.int16)
    for nth, step in enumerate(block_ijk(factor)):  # one by one, to save memory
        node = factor * outer + step
        some = np.flatnonzero(((node >= 0) & (node <= factor * shape)).all(1) & (row >= 0))
        of_outer[nth, some] = holder[(node - factor * beside)[some] @ strides(factor), row[some]]
    return np.concatenate([voxel_ijk, outer]), np.concatenate([holder, of_outer], axis=1)


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


def _with_inner_points(
    keys: Keys, places: NDArray[np.float64], used: Keys, strides: Keys
) -> tuple[Keys, NDArray[np.float64]]:
    """Return points with those on faces, and then those in cells: means of the ones beside them."""
    i, rest = np.divmod(used, strides[0])
    odd = np.stack([i, *np.divmod(rest, strides[1])], 1) % 2 == 1  # between nodes
    for axes in (2, 3):
        some = odd.sum(1) == axes
        total, times = np.zeros((np.count_nonzero(some), 3)), np.zeros(np.count_nonzero(some))
        for axis, step in product(range(3), (-1, 1)):
            near = used[some] + step * strides[axis]
            at = np.searchsorted(keys, near).clip(max=len(keys) - 1)
            there = np.flatnonzero(odd[some, axis] & (keys[at] == near))
            total[there] += places[at[there]]
            times[there] += 1
        keys = np.concatenate([keys, used[some]])
        order = np.argsort(keys)
        keys, places = keys[order], np.concatenate([places, total / times[:, None]])[order]
    return keys, places
