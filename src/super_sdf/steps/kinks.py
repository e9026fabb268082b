"""Voxels in which the field's gradient turns, near the surface: only there can an edge be.

On a fine grid almost all of a surface is smooth. Finding that out block by block, by the largest
and smallest differences along each axis, takes a tenth of the time of looking for edges.
"""

from __future__ import annotations

import numpy as np

from ..arrays import BoolArray, FloatArray
from ..machine.threads import map_chunks
from ..neighbourhood import CENTRE, STRIDES
from .field import FineField

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
