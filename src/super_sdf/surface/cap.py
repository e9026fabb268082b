"""Where the surface leaves what is known of the grid: closed along its border, or open.

It ends where samples are unknown. As in marching cubes of the samples, a cell has a surface only if
all its eight samples are known. Such a cell holds one octant of each of eight voxels.

``border``, (2, 3), is the first voxel of the whole grid along each axis and the one after its last,
counted from the first voxel of the field: (0, 0, 0) and the field's shape, unless the field is of a
part of the grid. A part is closed only where its border is that of the grid.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import CORNERS, NEIGHBOURHOOD, FloatArray, IntArray
from ..errors import GridError
from ..grid.sdf_grid import SdfGrid
from ..refine.band import neighbour_table, rescale
from ..refine.field import FineField
from ..refine.nodes import (
    BARELY_INSIDE,
    BARELY_OUTSIDE,
    SHARING,
    block_ijk,
    nodes_of_part,
    seen_from,
    share_parts,
)
from ..threads import chunks_of

WAY_OUT = (
    "end the surface there (--open), or replace each by a distance of the right sign (the cut-off "
    "value of its side)"
)


def close(field: FineField, *, cap: bool, border: IntArray | None = None) -> FineField:
    """Return the field with voxels beyond the border of the grid, where it should be closed there.

    That is where the solid leaves the grid, with ``cap``. A tip that ends just before the border
    may also cross it, though all samples there are outside: the fine lattice reaches half a voxel
    farther than the samples. Such a solid does not leave, and is closed in any case.

    Added are the border voxels inside the solid that were not decoded, and a layer beyond, whose
    nodes are placed on the border (see ``marching``), so the cap is flat.
    """
    if field.octants is not None or (field.leaves and not cap):
        return field
    border = np.array([(0, 0, 0), field.shape]) if border is None else border
    known = field.voxel_ijk
    filled = find_border_inside(field, border) if field.leaves else known[:0]
    reaches, ends = np.zeros(len(known), bool), block_ijk(field.factor) / field.factor  # 0 to 1
    for axis, end in product(range(3), range(2)):  # a face of the fine lattice
        rows = np.flatnonzero(known[:, axis] == border[end, axis] - end)
        nodes = np.flatnonzero(ends[:, axis] == end)
        reaches[rows] |= (field.blocks[nodes[:, None], rows] <= 0).any(0)
    solid = np.concatenate([known[reaches], filled])
    if not len(solid):
        return field
    voxel_ijk = np.concatenate([known, filled, outer_voxels(solid, border)])
    order = np.lexsort(voxel_ijk.T[::-1])
    voxel_ijk = voxel_ijk[order]
    nx, ny, nz = field.shape
    parts = share_parts(neighbour_table(voxel_ijk + 1, (nx + 2, ny + 2, nz + 2)))
    column_of = np.empty(len(order), np.int32)  # of each voxel before sorting
    column_of[order] = np.arange(len(order))
    known_at, filled_at = column_of[: len(known)], column_of[len(known) :][: len(filled)]
    blocks = np.full((len(field.blocks), len(voxel_ijk)), BARELY_OUTSIDE, np.float32)
    closed = replace(field, voxel_ijk=voxel_ijk, blocks=blocks, parts=parts)
    _set_blocks(closed, filled_at, BARELY_INSIDE)
    near = ((known <= border[0] + 1) | (known >= border[1] - 2)).any(1)  # others have no new voxel
    blocks[:, known_at[~near]] = field.blocks[:, ~near]  # beside them
    _set_blocks(closed, known_at[near], field.blocks[:, near])
    return closed


def find_border_inside(field: FineField, border: IntArray | None = None) -> IntArray:
    """Return the border voxels (n, 3) that are inside and have no block."""
    if field.border_inside is not None:
        return field.border_inside
    border = np.array([(0, 0, 0), field.shape]) if border is None else border
    grid, found = field.grid, [np.empty((0, 3), np.int64)]
    ends = [
        np.isin(np.arange(n), (low, high - 1))
        for n, low, high in zip(field.shape, *border.tolist())
    ]
    for planes in chunks_of(field.shape[0], field.shape[1] * field.shape[2]):
        inside = rescale(grid, field.offset, planes.start, planes.stop) <= 0
        inside &= ends[0][planes, None, None] | ends[1][:, None] | ends[2]
        low, high = np.searchsorted(field.voxel_ijk[:, 0], [planes.start, planes.stop])
        i, j, k = field.voxel_ijk[low:high].T
        inside[i - planes.start, j, k] = False
        found.append(np.argwhere(inside) + np.array([planes.start, 0, 0]))
    return np.concatenate(found).astype(np.int32)


def _set_blocks(field: FineField, columns: IntArray, values: FloatArray | np.float32) -> None:
    """Set the blocks of some voxels, columns of all blocks, and what others share with them."""
    values = np.broadcast_to(values, (len(field.blocks), len(columns)))
    nodes = nodes_of_part(field.factor)
    for part, sharing in enumerate(SHARING):
        for place in sharing:
            neighbour = field.parts.table[place, columns]
            there = np.flatnonzero(neighbour >= 0)
            seen = nodes[seen_from(part, place)]
            field.blocks[seen[:, None], neighbour[there]] = values[nodes[part][:, None], there]


def outer_voxels(voxel_ijk: IntArray, border: NDArray[Any]) -> IntArray:
    """Return the neighbours (n, 3) of these voxels that lie beyond the grid."""
    outermost = voxel_ijk[((voxel_ijk == border[0]) | (voxel_ijk == border[1] - 1)).any(1)]
    around = (outermost[:, None] + NEIGHBOURHOOD).reshape(-1, 3)
    beyond = around[((around < border[0]) | (around >= border[1])).any(1)]
    return np.unique(beyond, axis=0).astype(np.int32)


def check_can_close(grid: SdfGrid, *, cap: bool) -> None:
    """Raise GridError if a surface is to be closed, and samples that may hide it are unknown."""
    unseen = grid.field.unseen
    if unseen is not None and cap:
        why = grid.field.why_open or "samples beside the surface are unknown"
        raise GridError(f"{why}; {WAY_OUT}")


def check_all_seen(grid: SdfGrid, what: str) -> None:
    """Raise GridError if something cannot be done with a surface that ends at unknown samples."""
    if grid.field.unseen is not None:
        raise GridError(f"samples beside the surface are unknown, so it is open there: {what}")


def seen_octants(unseen: Any, voxel_ijk: IntArray) -> NDArray[np.uint8]:
    """Return a bit for each octant of voxels (D, 3), (D,): whether no sample round it is unseen.

    ``unseen`` is an array of the grid's shape, sliced by planes: which samples are unknown.
    """
    seen = np.empty(len(voxel_ijk), np.uint8)
    for planes in chunks_of(unseen.shape[0], unseen.shape[1] * unseen.shape[2]):
        rows = slice(*np.searchsorted(voxel_ijk[:, 0], [planes.start, planes.stop]).tolist())
        low = max(planes.start - 1, 0)
        any_of = np.pad(np.asarray(unseen[low : planes.stop + 1]), 1, mode="edge")
        for axis in range(3):
            lines = np.moveaxis(any_of, axis, 0)
            any_of = np.moveaxis(lines[1:] | lines[:-1], 0, axis)
        cell = voxel_ijk[rows] - np.array([low, 0, 0], np.int32)
        octants = [any_of[tuple((cell + corner).T)] for corner in CORNERS]
        seen[rows] = np.packbits(~np.stack(octants, 1), axis=1, bitorder="little")[:, 0]
    return seen
