"""A surface that runs out of the grid, closed along the grid's border."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..arrays import FloatArray, IntArray
from ..grid.sdf_grid import SdfGrid
from ..neighbourhood import NEIGHBOURHOOD
from .band import neighbour_table, plane_blocks, rescale
from .field import FineField
from .nodes import (
    BARELY_INSIDE,
    BARELY_OUTSIDE,
    SHARING,
    SharedParts,
    nodes_of_part,
    seen_from,
    share_parts,
)


def close_at_border(field: FineField, grid: SdfGrid, offset: float = 0.0) -> FineField:
    """Surround the grid by voxels that are outside, so that the surface is closed at its border.

    Added are the border voxels inside the solid that were not decoded, and next to all border
    voxels a layer of outer ones. The nodes beyond the border lie on it (see ``marching``), so
    what is added is flat. Of a slab its planes are closed, and those beside them that say whose
    vertex is whose.
    """
    first, last = max(field.planes[0] - 2, 0), min(field.planes[1] + 1, field.shape[0])
    rows = field.rows(first, last)
    known = field.voxel_ijk[rows]
    filled = _filled_border(grid, offset, first, last, known)
    border = np.concatenate([known, filled])
    voxel_ijk = np.concatenate([border, _outer_voxels(border, field.shape)])
    order = np.lexsort(voxel_ijk.T[::-1])
    voxel_ijk = voxel_ijk[order]

    padded = tuple(n + 2 for n in field.shape)
    parts = share_parts(neighbour_table(voxel_ijk + 1, padded))
    column_of = np.empty(len(order), np.int32)  # of each voxel of the border
    column_of[order] = np.arange(len(order))
    known_at, solid_at, _ = np.split(column_of, [len(known), len(border)])
    blocks = np.full((len(field.blocks), len(voxel_ijk)), BARELY_OUTSIDE, np.float32)
    spread(BARELY_INSIDE, solid_at, blocks, parts, field.factor)
    spread(field.blocks[:, rows], known_at, blocks, parts, field.factor)  # after: values stay
    ends = (-1, field.shape[0] + 1)  # the outer layers go with the first slab and the last
    planes = [ends[n] if at in (0, field.shape[0]) else at for n, at in enumerate(field.planes)]
    return replace(
        field, voxel_ijk=voxel_ijk, blocks=blocks, parts=parts, planes=(planes[0], planes[1])
    )


def spread(
    values: FloatArray | np.float32,
    columns: IntArray,
    blocks: FloatArray,
    parts: SharedParts,
    factor: int,
) -> None:
    """Set the blocks of some voxels, and what other blocks share with them.

    Parameters
    ----------
    values : (Q, n) float32, or one number
        The blocks' values.
    columns : (n,) int32
        The voxels.
    blocks : (Q, D) float32
        Changed in place.
    parts : SharedParts
        Of all D voxels.
    factor : int
        K.
    """
    values = np.broadcast_to(values, (len(blocks), len(columns)))
    nodes = nodes_of_part(factor)
    for part, sharing in enumerate(SHARING):
        for place in sharing:
            neighbour = parts.table[place, columns]
            there = np.flatnonzero(neighbour >= 0)
            seen = nodes[seen_from(part, place)]
            blocks[seen[:, None], neighbour[there]] = values[nodes[part][:, None], there]


def _filled_border(
    grid: SdfGrid, offset: float, first: int, last: int, known: IntArray
) -> IntArray:
    """Return the border voxels of some planes that are inside and not among those known."""
    found = []
    for low, high in plane_blocks(grid.shape, first, last):
        inside = rescale(grid, offset, low, high) <= 0
        inner = slice(max(1 - low, 0), min(grid.shape[0] - 1, high) - low)
        inside[inner, 1:-1, 1:-1] = False
        here = known[(known[:, 0] >= low) & (known[:, 0] < high)]
        inside[here[:, 0] - low, here[:, 1], here[:, 2]] = False
        found.append(np.argwhere(inside) + np.array([low, 0, 0]))
    return np.concatenate(found).astype(np.int32)


def _outer_voxels(voxel_ijk: IntArray, shape: tuple[int, int, int]) -> IntArray:
    """Return the neighbours of these voxels that lie one voxel outside the grid."""
    last = np.array(shape, np.int32) - 1
    border = voxel_ijk[((voxel_ijk == 0) | (voxel_ijk == last)).any(1)]
    around = (border[:, None] + NEIGHBOURHOOD).reshape(-1, 3)
    beyond = around[((around < 0) | (around > last)).any(1)]
    return np.unique(beyond, axis=0).astype(np.int32)
