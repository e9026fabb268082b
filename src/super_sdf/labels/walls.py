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
on faces and in cells apart. They are in the order of these names, and triangles in that of the
cells, so a surface made slab by slab is the same as one made at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from ..surface.mesh import CLEARANCE
from ..network.neighbourhood import CORNERS, NEIGHBOURHOOD
from ..surface.cap import outer_voxels
from ..surface.cell_cases import (EDGE_AXIS, EDGE_BETWEEN, EDGE_START, FACES, segments, triangulate)
from ..surface.marching import CAP_HEIGHT, cells_low_nodes, strides
from ..refine.nodes import SHARING, VoxelIndex, block_ijk, part_of_node

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
Cells = tuple[Keys, Labels]


@dataclass(frozen=True, eq=False)
class Labelled:
    """The fields of some labels at the nodes of voxels in which the walls can be."""

    shape: tuple[int, int, int]  # samples of the coarse grid along each axis
    factor: int  # K
    planes: tuple[int, int]  # planes of voxels, from the first to before the second
    voxel_ijk: IntArray  # (D, 3), the voxels, in C order
    # (Q, S), their blocks, label by label; NaN where that of label 0 is minus that of any other
    values: FloatArray
    # (S,), ``voxel * labels + label``, in ascending order, of each column ``order`` of the values
    column: Keys
    order: NDArray[np.intp]  # (S,)
    labels: int  # number of labels, 0 included, which is beside all others
    holder: Labels  # (Q, D), the label of each node

    @cached_property
    def index(self) -> VoxelIndex:
        """Finds the row of a voxel."""
        return VoxelIndex(self.voxel_ijk, self.shape)

    def apart(self, low: Keys, node: Keys, between: Labels, holder: Labels) -> NDArray[np.float64]:
        """Return by how much the field of a node's holder is lower than that of another, (n,)."""
        voxel = np.clip(low // self.factor, 0, np.array(self.shape) - 1)
        row, place = self.index.find(voxel), (node - self.factor * voxel) @ strides(self.factor)
        values = []
        for label in between:
            at = np.searchsorted(self.column, row * self.labels + label)
            values.append(self.values[place, self.order[at]].astype(np.float64))
        values[0] = np.where(np.isnan(values[0]), -values[1], values[0])  # of label 0, the lower
        apart = np.where(holder == between[0], values[1] - values[0], values[0] - values[1])
        least: NDArray[np.float64] = np.maximum(apart, 0)
        return least  # the other may be lower where it cannot hold the node


@dataclass(frozen=True, eq=False)
class Part:
    """The field of one label in some planes."""

    # (n, 3), the voxels round which some samples have the label, and others do not, in C order
    voxel_ijk: IntArray
    # (27, n), which parts of their blocks touch a voxel round which no sample has the label
    absent: BoolArray
    blocks: FloatArray  # (Q, n), their values; NaN where they are not known


def absent_parts(
    table: IntArray, voxel_ijk: IntArray, inside: BoolArray, shape: tuple[int, int, int]
) -> BoolArray:
    """Return ``Part.absent``."""
    none = table < 0
    for place, step in enumerate(NEIGHBOURHOOD):
        beside = voxel_ijk + step
        none[place] &= ((beside >= 0) & (beside < shape)).all(1) & ~inside
    return np.array([none[sharing].any(0) for sharing in SHARING])


def put_together(
    parts: Iterable[tuple[int, Part]],
    ground: Part,
    shape: tuple[int, int, int],
    factor: int,
    planes: tuple[int, int],
) -> Labelled:
    """Return the fields of labels in some planes."""
    number, every = zip((0, ground), *parts)
    counts = [len(part.voxel_ijk) for part in every]
    places = np.concatenate([part.voxel_ijk for part in every])
    keys, row = np.unique(VoxelIndex(places, shape).keys, return_inverse=True)
    voxel_ijk = np.stack(np.unravel_index(keys, shape), 1).astype(np.int32)
    rows = np.split(row, np.cumsum(counts)[:-1])
    holder = _holders(number, every, rows, len(voxel_ijk))
    labels = max(number) + 1
    column = row * labels + np.repeat(number, counts)
    order = np.argsort(column)
    values = np.concatenate([part.blocks for part in every], axis=1)
    return Labelled(shape, factor, planes, voxel_ijk, values, column[order], order, labels, holder)


def _holders(
    number: tuple[int, ...], parts: tuple[Part, ...], rows: list[NDArray[np.intp]], count: int
) -> Labels:
    """Return the label that holds each node of ``count`` voxels, (Q, D); forget unused values."""
    size = len(parts[0].blocks)
    lowest, able = np.full((size, count), np.inf, np.float32), np.zeros((size, count), np.int8)
    holder = np.zeros(lowest.shape, np.int16)
    of_block = part_of_node(round(size ** (1 / 3)) - 1)[0]
    for nth in (*range(1, len(parts)), 0):
        label, part, row = number[nth], parts[nth], rows[nth]
        for node, place in enumerate(of_block):
            value, able_here = part.blocks[node], able[node, row]
            if label == 0:
                value[able_here < 2] = np.nan
                value = np.where(np.isnan(value), -lowest[node, row], value)
            can = ~part.absent[place]
            lower = np.flatnonzero(can & (value < lowest[node, row]))
            lowest[node, row[lower]], holder[node, row[lower]] = value[lower], label
            able[node, row] = np.minimum(able_here + can, 2)
    return holder


def extract_walls(
    field: Labelled, border: IntArray
) -> tuple[NDArray[np.float64], IntArray, Labels, int]:
    """Return the walls in the planes of fields: vertices, triangles, labels on both sides.

    Triangles are counter-clockwise seen from the second label, which is lower. ``border``, (b, 4),
    are the voxels on the border of the grid and the label of each, which is closed there. The last
    number is that of vertices on the first face of the planes: they come first.
    """
    cells = low, _ = _cells(field, border)
    lattice = Halves(field.shape, field.factor)
    base = lattice.keys(2 * low)
    faces, sides, inner = _connect(field, cells, base, lattice)
    keys, places = _edge_points(field, cells, base, lattice)
    keys, places = _inner_points(keys, places, np.unique(faces[inner]), lattice)
    after = np.array([2 * field.factor * field.planes[0] + 1, -lattice.beyond, -lattice.beyond])
    before = int(np.searchsorted(keys, lattice.keys(after))) if field.planes[0] else 0
    return places, np.searchsorted(keys, faces).astype(np.int32), sides, before


class Halves:
    """The lattice of half the fine spacing, one coarse voxel larger than the grid on all sides."""

    def __init__(self, shape: tuple[int, int, int], factor: int) -> None:
        self.beyond = 2 * factor
        _, ny, nz = (2 * factor * (n + 2) + 1 for n in shape)
        self.strides = np.array([ny * nz, nz, 1], np.int64)

    def keys(self, place: NDArray[Any]) -> Keys:
        """Return a number for each place (..., 3), in C order."""
        keys: Keys = (place.astype(np.int64) + self.beyond) @ self.strides
        return keys


def _cells(field: Labelled, border: IntArray) -> Cells:
    """Return the low nodes, (n, 3), and labels, (n, 8), of the cells in which walls are."""
    voxel_ijk, holder = _closed(field, border)
    corners = holder.reshape(*(field.factor + 1,) * 3, -1)
    low, high = corners, corners
    for axis in range(3):
        some, more = (slice(None),) * axis + (slice(-1),), (slice(None),) * axis + (slice(1, None),)
        low, high = np.minimum(low[some], low[more]), np.maximum(high[some], high[more])
    active = np.flatnonzero(np.moveaxis(low != high, -1, 0))
    row, cell = np.divmod(active, field.factor**3)
    node = cells_low_nodes(field.factor)[cell]
    steps = CORNERS @ strides(field.factor)
    label = holder[node[:, None] + steps, row[:, None]]
    low_ijk = field.factor * voxel_ijk[row].astype(np.int64) + block_ijk(field.factor)[node]
    return low_ijk, label


def _closed(field: Labelled, border: IntArray) -> tuple[IntArray, Labels]:
    """Return voxels and the labels of their nodes, with those beyond the border: see ``cap``."""
    shape, factor = np.array(field.shape), field.factor
    filled = border[(border[:, 3] > 0) & (field.index.find(border[:, :3]) < 0)]
    of_filled = np.broadcast_to(filled[:, 3].astype(np.int16), (len(field.holder), len(filled)))
    voxel_ijk = np.concatenate([field.voxel_ijk, filled[:, :3]])
    holder, order = np.concatenate([field.holder, of_filled], axis=1), np.lexsort(voxel_ijk.T[::-1])
    outer = outer_voxels(voxel_ijk, np.array([(0, 0, 0), field.shape]))
    ends = [-1 if at == 0 else at + (at == field.shape[0]) for at in field.planes]
    outer = outer[(outer[:, 0] >= ends[0]) & (outer[:, 0] < ends[1])]  # others are of other planes
    beside = np.clip(outer, 0, shape - 1)
    row = VoxelIndex(voxel_ijk[order], field.shape).find(beside)
    of_outer = np.zeros((len(holder), len(outer)), holder.dtype)
    for nth, step in enumerate(block_ijk(factor)):  # one by one, to save memory
        node = factor * outer + step
        some = np.flatnonzero(((node >= 0) & (node <= factor * shape)).all(1) & (row >= 0))
        place = (node - factor * beside)[some] @ strides(factor)
        of_outer[nth, some] = holder[place, order[row[some]]]
    voxel_ijk = np.concatenate([voxel_ijk, outer])
    order = np.lexsort(voxel_ijk.T[::-1])
    return voxel_ijk[order], np.concatenate([holder, of_outer], axis=1)[:, order]


def _connect(
    field: Labelled, cells: Cells, base: Keys, lattice: Halves
) -> tuple[Keys, Labels, BoolArray]:
    """Return the triangles as names of points, the labels beside, and which are not on edges."""
    case, of_cell = np.unique(_cases(field, cells), return_inverse=True)
    tables = [walls(int(number) & (1 << 24) - 1, int(number) >> 24) for number in case]
    counts = np.array([len(table) for table in tables], np.int64)
    first, times = (np.cumsum(counts) - counts)[of_cell], counts[of_cell]
    cell = np.repeat(np.arange(len(base)), times)
    nth = np.arange(len(cell)) - np.repeat(np.cumsum(times) - times, times) + first[cell]
    table = np.concatenate([np.empty((0, 5), np.int32), *tables])[nth]
    steps = PLACES.astype(np.int64) @ lattice.strides
    points = table[:, :3]
    label = cells[1][cell[:, None], table[:, 3:]]
    return base[cell, None] + steps[points], label, points >= FACE_POINTS


def _cases(field: Labelled, cells: Cells) -> Keys:
    """Return the case of each cell: the ranks of its labels, and which faces join (``walls``).

    A face joins its corners with the higher label where the difference of the labels' fields,
    interpolated bilinearly, is so at its saddle: see ``marching.choose_cases``.
    """
    label, ordered = cells[1], np.sort(cells[1], axis=1)
    rank = np.zeros(label.shape, np.int64)
    for nth in range(1, 8):
        is_next = ordered[:, nth] > ordered[:, nth - 1]
        rank += is_next[:, None] & (label >= ordered[:, nth, None])
    case: Keys = rank @ (1 << 3 * np.arange(8))
    for n, face in enumerate(FACES):
        a, b, c, d = label[:, face].T
        unsure = np.flatnonzero((a == c) & (b == d) & (a != b))
        low, holder = cells[0][unsure], np.stack([a, b])[:, unsure]
        between = np.sort(holder, axis=0)
        one, other = (
            np.prod([field.apart(low, low + CORNERS[at], between, own) for at in corners], axis=0)
            for corners, own in zip((face[::2], face[1::2]), holder)
        )
        joined = np.where(holder[0] > holder[1], one > other, other > one)
        case[unsure] |= joined.astype(np.int64) << (24 + n)
    return case


def _edge_points(
    field: Labelled, cells: Cells, base: Keys, lattice: Halves
) -> tuple[Keys, NDArray[np.float64]]:
    """Return the points on crossed edges of cells: names, in order, and places in fine spacings."""
    keys, found = [np.empty(0, np.int64)], [np.empty((0, 3), np.int64)]
    for edge, (start, axis) in enumerate(zip(EDGE_START, EDGE_AXIS)):
        end = start + (4, 2, 1)[axis]
        cell = np.flatnonzero(cells[1][:, start] != cells[1][:, end])
        keys.append(base[cell] + PLACES[edge].astype(np.int64) @ lattice.strides)
        found.append(np.stack([cell, np.full_like(cell, start), np.full_like(cell, end)], 1))
    names, first = np.unique(np.concatenate(keys), return_index=True)
    cell, *corners = np.concatenate(found)[first].T
    low = cells[0][cell]
    ends = [low + CORNERS[corner] for corner in corners]
    labels = [cells[1][cell, corner] for corner in corners]
    last = field.factor * np.array(field.shape)
    share = np.full(len(cell), 0.5)  # half-way, if an end is beyond the border
    within = np.flatnonzero(((np.minimum(*ends) >= 0) & (np.maximum(*ends) <= last)).all(1))
    between = np.sort(np.stack(labels)[:, within], axis=0)
    one, other = (
        field.apart(low[within], end[within], between, label[within])
        for end, label in zip(ends, labels)
    )
    none = one + other == 0
    share[within] = np.where(none, 0.5, one / np.where(none, 1, one + other))
    share = np.clip(share, CLEARANCE, 1 - CLEARANCE)
    begin, stop = (np.clip(end.astype(float), -CAP_HEIGHT, last + CAP_HEIGHT) for end in ends)
    return names, begin + share[:, None] * (stop - begin)


def _inner_points(
    keys: Keys, places: NDArray[np.float64], used: Keys, lattice: Halves
) -> tuple[Keys, NDArray[np.float64]]:
    """Return points with those on faces, and then those in cells: means of the ones beside them."""
    i, rest = np.divmod(used, lattice.strides[0])
    odd = np.stack([i, *np.divmod(rest, lattice.strides[1])], 1) % 2 == 1  # between nodes
    for axes in (2, 3):
        some = odd.sum(1) == axes
        total, times = np.zeros((np.count_nonzero(some), 3)), np.zeros(np.count_nonzero(some))
        for axis, step in product(range(3), (-1, 1)):
            near = used[some] + step * lattice.strides[axis]
            at = np.searchsorted(keys, near).clip(max=len(keys) - 1)
            there = np.flatnonzero(odd[some, axis] & (keys[at] == near))
            total[there] += places[at[there]]
            times[there] += 1
        keys = np.concatenate([keys, used[some]])
        order = np.argsort(keys)
        keys, places = keys[order], np.concatenate([places, total / times[:, None]])[order]
    return keys, places
