"""Surfaces of several labels that share their walls, made of the labels' fine fields.

The label whose field is lowest holds a node of the fine lattice: in a tie the lower label, 0 last.
Label 0 is what is beside all others; its field is minus that of a label, unless two others or more
could hold the node, which no label can in a voxel round which no sample has it. A wall crosses the
edge between nodes of two labels where their fields are equal, by linear interpolation: both labels
get the very same vertex. So each surface is closed, and there is neither gap nor overlap.

``cases`` says how walls run in a cell. A point is named by its place in the lattice of half the
fine spacing; further points in a cell have that of its middle, and a number above all places.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import CORNERS, FloatArray, IntArray, sums_at
from ..refine.nodes import VoxelIndex, block_ijk
from ..simplify.walls import Walls
from ..surface.marching import CAP_HEIGHT, EDGE_AXIS, EDGE_START, FACES, cells_low_nodes, strides
from ..surface.mesh import CLEARANCE
from .cases import CELL_POINTS, FACE_POINTS, PLACES, walls_of_cell

EDGES = tuple(zip(EDGE_START, EDGE_AXIS))
STEP = (4, 2, 1)  # from a corner of a cell to the next one along each axis

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


def extract_walls(field: Labelled) -> Walls:
    """Return the walls of all labels, in fine spacings from node (0, 0, 0)."""
    low, label = _crossed_cells(field)
    # of the lattice of half the fine spacing, a voxel beyond the grid to every side
    nx, ny, nz = (2 * field.factor * (n + 2) + 1 for n in field.shape)
    along = np.array([ny * nz, nz, 1], np.int64)
    steps = PLACES @ along
    steps[CELL_POINTS:] += nx * ny * nz * np.arange(len(PLACES) - CELL_POINTS)
    base = 2 * (low + field.factor) @ along

    # the triangles of each cell's case, by the names of their points
    case, of_cell = np.unique(_cases(field, low, label), return_inverse=True)
    tables = [walls_of_cell(int(number) & (1 << 24) - 1, int(number) >> 24) for number in case]
    counts = np.array([len(table) for table in tables], np.int64)
    first, times = (np.cumsum(counts) - counts)[of_cell], counts[of_cell]
    cell = np.repeat(np.arange(len(base)), times)
    nth = np.arange(len(cell)) - np.repeat(np.cumsum(times) - times, times) + first[cell]
    table = np.concatenate([np.empty((0, 5), np.int32), *tables])[nth]
    faces, sides = base[cell, None] + steps[table[:, :3]], label[cell[:, None], table[:, 3:]]

    # a point on each crossed edge
    edges = [np.flatnonzero(label[:, at] != label[:, at + STEP[axis]]) for at, axis in EDGES]
    named = np.concatenate([base[some] + step for some, step in zip(edges, steps)])
    keys, one = np.unique(named, return_index=True)
    edge = np.repeat(np.arange(12), [len(some) for some in edges])[one]
    places = _on_edges(field, low, label, np.concatenate(edges)[one], edge)

    # on a face the mean of the points that it is joined to on edges; then so in a cell, which is
    # the last of its triangle
    kind = table[:, :3]
    on_face = (kind >= FACE_POINTS) & (kind < CELL_POINTS)
    in_cell = (kind >= CELL_POINTS) & [False, False, True]
    for least, which in ((FACE_POINTS, on_face), (CELL_POINTS, in_cell)):
        row, corner = np.nonzero(which)
        named, of = np.unique(faces[row, corner], return_inverse=True)
        sums = np.zeros((len(named), 4))  # and how many they are
        for other in ((corner + 1) % 3, (corner + 2) % 3):
            some = np.flatnonzero(kind[row, other] < least)
            at = np.searchsorted(keys, faces[row, other][some])
            sums += sums_at(of[some], np.insert(places[at], 3, 1, axis=1), len(named))
        order = np.argsort(np.append(keys, named))
        keys = np.append(keys, named)[order]
        places = np.concatenate([places, sums[:, :3] / sums[:, 3:]])[order]
    return Walls(places, np.searchsorted(keys, faces).astype(np.int32), sides)


def _crossed_cells(field: Labelled) -> tuple[Keys, Labels]:
    """Return the low nodes of the cells that a wall crosses, (n, 3), and their labels, (n, 8)."""
    factor = field.factor
    least = most = field.holder.reshape(*(factor + 1,) * 3, -1)
    for axis in range(3):
        some, more = (slice(None),) * axis + (slice(-1),), (slice(None),) * axis + (slice(1, None),)
        least, most = np.minimum(least[some], least[more]), np.maximum(most[some], most[more])
    row, cell = np.divmod(np.flatnonzero(np.moveaxis(least != most, -1, 0)), factor**3)
    node = cells_low_nodes(factor)[cell]
    label = field.holder[node[:, None] + CORNERS @ strides(factor), row[:, None]]
    return factor * field.voxel_ijk[row].astype(np.int64) + block_ijk(factor)[node], label


def _cases(field: Labelled, low: Keys, label: Labels) -> Keys:
    """Return the case of each cell: the ranks of its labels, and which faces join (``cases``).

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
