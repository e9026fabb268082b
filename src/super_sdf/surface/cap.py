"""Where the surface leaves what is known of the grid: closed along its border, or open.

It ends where samples are unknown. As in marching cubes of the samples, a cell has a surface only if
all its eight samples are known. Such a cell holds one octant of each of eight voxels.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray, IntArray
from ..errors import GridError
from ..grid.planes import SampleArray
from ..grid.sdf_grid import SdfGrid
from ..network.neighbourhood import CORNERS, NEIGHBOURHOOD
from ..refine.band import neighbour_table, plane_blocks, rescale
from ..refine.field import FineField, border_is_crossed
from ..refine.nodes import (BARELY_INSIDE, BARELY_OUTSIDE, SHARING, SharedParts, block_ijk, nodes_of_part, seen_from, share_parts)

WAY_OUT = (
    "end the surface there (--open), or replace each by a distance of the right sign (the cut-off "
    "value of its side)"
)


def close(field: FineField, *, cap: bool, beside: int = 1) -> FineField:
    """Return the field closed where it should be; where the solid leaves the grid, with ``cap``."""
    if field.octants is not None:  # it ends where samples are unknown, and cannot be closed
        return field
    if field.leaves:
        return close_at_border(field, beside) if cap else field
    # A tip that ends just before the border may cross it though all samples there are outside: the
    # fine lattice reaches half a voxel farther than the samples. Such a solid does not leave.
    if border_is_crossed(field, beside + 1):
        return _close(field, np.empty((0, 3), np.int32), beside)
    return field


def close_at_border(field: FineField, beside: int = 1) -> FineField:
    """Surround the grid with outside voxels, so that the surface is closed along the border.

    Added are the border voxels inside the solid that were not decoded, and a layer beyond, whose
    nodes are placed on the border (see ``marching``), so the cap is flat. A slab is closed in its
    own planes, in those ``beside`` on which its mesh depends, and in one more before, which owns
    vertices of those.
    """
    return _close(field, find_border_inside(field, *_planes_beside(field, beside)), beside)


def find_border_inside(field: FineField, first: int, last: int) -> IntArray:
    """Return the border voxels (n, 3) of some planes that are inside and have no block.

    The planes must be some whose voxels the field has.
    """
    if field.border_inside is not None:
        plane = field.border_inside[:, 0]
        return field.border_inside[(plane >= first) & (plane < last)]
    grid, found = field.placed, [np.empty((0, 3), np.int64)]
    for low, high in plane_blocks(grid.shape, first, last):
        inside = rescale(grid, field.offset, low, high) <= 0
        inner = slice(max(1 - low, 0), min(grid.shape[0] - 1, high) - low)
        inside[inner, 1:-1, 1:-1] = False
        known = field.voxel_ijk[field.rows(low, high)]
        inside[known[:, 0] - low, known[:, 1], known[:, 2]] = False
        found.append(np.argwhere(inside) + np.array([low, 0, 0]))
    return np.concatenate(found).astype(np.int32)


def _planes_beside(field: FineField, beside: int) -> tuple[int, int]:
    return max(field.planes[0] - beside - 1, 0), min(field.planes[1] + beside, field.shape[0])


def _close(field: FineField, filled: IntArray, beside: int) -> FineField:
    """Return the field with the border voxels ``filled`` inside, and outside ones beyond."""
    rows = field.rows(*_planes_beside(field, beside))
    known = field.voxel_ijk[rows]
    border = np.concatenate([known, filled])
    voxel_ijk = np.concatenate([border, outer_voxels(border, field.shape)])
    order = np.lexsort(voxel_ijk.T[::-1])
    voxel_ijk = voxel_ijk[order]

    padded = tuple(n + 2 for n in field.shape)
    parts = share_parts(neighbour_table(voxel_ijk + 1, padded))
    column_of = np.empty(len(order), np.int32)  # of each voxel before sorting
    column_of[order] = np.arange(len(order))
    known_at, solid_at, _ = np.split(column_of, [len(known), len(border)])
    blocks = np.full((len(field.blocks), len(voxel_ijk)), BARELY_OUTSIDE, np.float32)
    _set_blocks(BARELY_INSIDE, solid_at, blocks, parts, field.factor)
    _set_blocks(field.blocks[:, rows], known_at, blocks, parts, field.factor)  # last: these win
    ends = (-1, field.shape[0] + 1)  # the outer layers belong to the first slab and the last
    planes = [ends[n] if at in (0, field.shape[0]) else at for n, at in enumerate(field.planes)]
    return replace(
        field, voxel_ijk=voxel_ijk, blocks=blocks, parts=parts, planes=(planes[0], planes[1])
    )


def _set_blocks(
    values: FloatArray | np.float32,
    columns: IntArray,
    blocks: FloatArray,
    parts: SharedParts,
    factor: int,
) -> None:
    """Set the blocks of some voxels, columns of ``blocks``, and what others share with them."""
    values = np.broadcast_to(values, (len(blocks), len(columns)))
    nodes = nodes_of_part(factor)
    for part, sharing in enumerate(SHARING):
        for place in sharing:
            neighbour = parts.table[place, columns]
            there = np.flatnonzero(neighbour >= 0)
            seen = nodes[seen_from(part, place)]
            blocks[seen[:, None], neighbour[there]] = values[nodes[part][:, None], there]


def outer_voxels(voxel_ijk: IntArray, shape: tuple[int, int, int]) -> IntArray:
    """Return the neighbours (n, 3) of these voxels that lie beyond the grid."""
    last = np.array(shape, np.int32) - 1
    border = voxel_ijk[((voxel_ijk == 0) | (voxel_ijk == last)).any(1)]
    around = (border[:, None] + NEIGHBOURHOOD).reshape(-1, 3)
    beyond = around[((around < 0) | (around > last)).any(1)]
    return np.unique(beyond, axis=0).astype(np.int32)


def check_can_close(grid: SdfGrid, *, cap: bool) -> None:
    """Raise GridError if a surface is to be closed, and samples that may hide it are unknown."""
    unseen = grid.field.unseen
    if unseen is not None and cap:
        why = getattr(unseen, "refusal", lambda: "samples beside the surface are unknown")()
        raise GridError(f"{why}; {WAY_OUT}")


def check_all_seen(grid: SdfGrid, what: str) -> None:
    """Raise GridError if something cannot be done with a surface that ends at unknown samples."""
    if grid.field.unseen is not None:
        raise GridError(f"samples beside the surface are unknown, so it is open there: {what}")


def seen_octants(unseen: SampleArray, voxel_ijk: IntArray) -> NDArray[np.uint8]:
    """Return a bit for each octant of voxels (D, 3), (D,): whether no sample round it is unseen."""
    seen = np.empty(len(voxel_ijk), np.uint8)
    for first, last in plane_blocks(tuple(unseen.shape)):
        rows = slice(*np.searchsorted(voxel_ijk[:, 0], [first, last]).tolist())
        low, high = max(first - 1, 0), min(last + 1, unseen.shape[0])
        marked = np.pad(np.asarray(unseen[low:high]), 1, mode="edge")
        any_of = marked
        for axis in range(3):
            lines = np.moveaxis(any_of, axis, 0)
            any_of = np.moveaxis(lines[1:] | lines[:-1], 0, axis)
        cell = voxel_ijk[rows] - np.array([low, 0, 0], np.int32)
        octants = [any_of[tuple((cell + corner).T)] for corner in CORNERS]
        seen[rows] = np.packbits(~np.stack(octants, 1), axis=1, bitorder="little")[:, 0]
    return seen


def octant_of_cells(factor: int) -> NDArray[np.uint8]:
    """Return the octant of the voxel, 0 to 7, in which each cell of a block lies, (K^3,)."""
    low = block_ijk(factor)
    low = low[(low < factor).all(1)]
    octant: NDArray[np.uint8] = ((low >= factor // 2) @ np.array([4, 2, 1])).astype(np.uint8)
    return octant
