"""Voxels that may hold an edge, and the patches of the surface in their cells.

On a fine grid almost all of a surface is smooth. Finding that out block by block, by the largest
and smallest differences along each axis, takes a tenth of the time of looking for edges.

A patch is a piece of the surface in one cell: a loop of crossed lattice edges, from one to the
next across the faces of the cell. Two cells that share a face share the crossings on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ...arrays import BoolArray, FloatArray, IntArray
from ...machine.threads import chunks_of, map_chunks
from ...neighbourhood import CENTRE, STRIDES
from ..cell_cases import loop_table
from ..field import FineField
from ..marching import Crossings, cells_low_nodes, edge_steps, edge_table, owners_of
from ..nodes import block_ijk

Index = NDArray[np.int64]
NEAR_SURFACE = 2.0  # fine spacings: differences between nodes nearer than this count
TURN = 0.35  # of a component of the gradient, over a voxel and those beside it
TEMPORARIES = 8  # numbers per node of a block


def voxels_near_kinks(field: FineField, rows: slice, threads: int = 1) -> BoolArray:
    """Return the voxels, (D,), in or beside which the gradient turns by more than ``TURN``.

    Only voxels of these rows are looked at; the others are False.
    """
    chunks = map_chunks(
        lambda some: _ranges(
            field.blocks[:, rows.start + some.start : rows.start + some.stop], field.factor
        ),
        rows.stop - rows.start,
        TEMPORARIES * len(field.blocks),
        threads,
    )
    low, high = (np.concatenate(arrays, 1) for arrays in zip(*chunks))
    for axis in range(3):
        alone = low.copy(), high.copy()
        for step in (-int(STRIDES[axis]), int(STRIDES[axis])):
            other = field.parts.table[CENTRE + step, rows]
            known = np.flatnonzero((other >= rows.start) & (other < rows.stop))
            other = other[known] - rows.start
            low[:, known] = np.fmin(low[:, known], alone[0][:, other])
            high[:, known] = np.fmax(high[:, known], alone[1][:, other])
    near = np.zeros(len(field.voxel_ijk), bool)
    near[rows] = np.any(high - low > TURN, axis=0)
    return near


def _ranges(blocks: FloatArray, factor: int) -> tuple[FloatArray, FloatArray]:
    """Return the smallest and largest differences along each axis, (3, n), of blocks (Q, n).

    They are slopes, 1 for a distance; NaN for blocks without nodes near the surface.
    """
    near = np.abs(blocks) < np.float32(NEAR_SURFACE * 2 / factor)
    cube = np.where(near, blocks, np.float32(np.nan)).reshape(*(factor + 1,) * 3, -1)
    low, high = np.empty((2, 3, blocks.shape[1]), np.float32)
    for axis in range(3):
        values = np.moveaxis(cube, axis, 0)
        step = (values[1:] - values[:-1]).reshape(-1, blocks.shape[1])
        np.fmin.reduce(step, 0, out=low[axis])
        np.fmax.reduce(step, 0, out=high[axis])
    return low * np.float32(factor / 2), high * np.float32(factor / 2)


def beside(field: FineField, chosen: BoolArray, rings: int) -> BoolArray:
    """Return the voxels, (D,), within some rings of voxels round chosen ones."""
    for _ in range(rings):
        for axis in range(3):
            step = int(STRIDES[axis])
            before, after = field.parts.table[CENTRE - step], field.parts.table[CENTRE + step]
            chosen = chosen | (chosen[before] & (before >= 0)) | (chosen[after] & (after >= 0))
    return chosen


@dataclass(frozen=True, eq=False)
class Patches:
    """The patches of the surface in the crossed cells of some blocks, in the order of the cells."""

    row: IntArray  # (P,), the voxel of each
    low: NDArray[np.float64]  # (P, 3), the low corner of its cell, in fine spacings
    loop: Index  # (P,), which row of ``loop_table`` it is
    sides: Index  # (P,), how many crossings it has
    # (P, S), its crossings in order, counter-clockwise from outside, -1 after the last
    crossing: Index

    def chosen(self, rows: Index | slice) -> Patches:
        """Return some of the patches."""
        return Patches(
            self.row[rows], self.low[rows], self.loop[rows], self.sides[rows], self.crossing[rows]
        )

    @property
    def there(self) -> BoolArray:
        """Which entries of ``crossing`` are crossings, (P, S)."""
        return self.crossing >= 0

    def joined(self) -> tuple[Index, Index]:
        """Return the patch and the crossing of every entry of ``crossing`` that is one."""
        patch, place = np.nonzero(self.there)
        return patch, self.crossing[patch, place]


def find_patches(
    field: FineField, crossings: Crossings, voxels: BoolArray
) -> tuple[Patches, Index]:
    """Return the patches in the crossed cells of some voxels, and the crossings that they use."""
    table, factor = loop_table(), field.factor
    slot, edge_at = _edges_of(field, crossings, voxels)
    some = voxels[crossings.cell_row]
    case = crossings.case[some]
    count = table.times[case]
    cell = np.repeat(np.arange(len(count)), count)
    loop = table.first[case[cell]] + nth_of_row(cell, count)
    row = crossings.cell_row[some][cell]
    low_node = cells_low_nodes(factor)[crossings.cell[some][cell]]
    first = slot[row] * (3 * len(field.blocks)) + low_node
    edges = table.edges[loop, : table.sides[loop].max(initial=3)]  # the longest loops are rare
    at = first[:, None] + edge_steps(factor)[edges]
    there = edges >= 0
    crossing = edge_at.take(at, mode="clip")
    used = np.zeros(len(crossings.own_row), bool)
    used[crossing[there]] = True
    new = np.cumsum(used) - 1
    low = factor * field.voxel_ijk[row] + block_ijk(factor)[low_node]
    joined = np.where(there, new[np.where(there, crossing, 0)], -1)
    patches = Patches(row, low.astype(np.float64), loop, table.sides[loop], joined)
    return patches, np.flatnonzero(used)


def _edges_of(field: FineField, crossings: Crossings, voxels: BoolArray) -> tuple[Index, IntArray]:
    """Return the crossings on the edges of some voxels' blocks, set only where there is one.

    Before it comes the place of each voxel in the table, (D,).
    """
    others = np.flatnonzero(voxels[crossings.other_row])
    listed = voxels.copy()
    listed[owners_of(field, crossings, others)[1]] = True
    slot: Index = np.cumsum(listed) - 1
    own = np.flatnonzero(listed[crossings.own_row])
    return slot, edge_table(field, crossings, slot.take, int(listed.sum()), own, others, own)


def dilate(patches: Patches, chosen: BoolArray, rings: int, count: int) -> BoolArray:
    """Return which of ``count`` crossings lie within some rings of patches round chosen ones."""
    near: BoolArray = np.zeros(count, bool)
    there = patches.there
    for _ in range(rings):
        mine = patches.crossing[chosen]
        near[mine[mine >= 0]] = True
        chosen = cast(BoolArray, np.any(near[patches.crossing] & there, axis=1))
    return near


def pairs_in_patches(patches: Patches) -> tuple[Index, Index]:
    """Return every ordered pair of crossings of a patch, in the order of the patches.

    Two crossings on a face that two cells share come twice.
    """
    sides = patches.crossing.shape[1]
    places = np.nonzero(~np.eye(sides, dtype=bool))
    empty = np.empty(0, np.int64)
    parts = [(empty, empty)]
    for some in chunks_of(len(patches.crossing), 6 * len(places[0])):
        one, other = (patches.crossing[some, place].ravel() for place in places)
        both = (one >= 0) & (other >= 0)
        parts.append((one[both], other[both]))
    first, second = zip(*parts)
    return np.concatenate(first), np.concatenate(second)


def nth_of_row(row: NDArray[Any], counts: NDArray[Any]) -> Index:
    """Return the place of each entry among those of its row; rows come in order."""
    first: Index = np.cumsum(counts) - counts
    nth: Index = np.arange(len(row)) - first[row]
    return nth
