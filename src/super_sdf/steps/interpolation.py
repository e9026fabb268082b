"""Trilinear interpolation within blocks: at any place, and from a coarse lattice to a finer one.

A place is given by its block, a column of the values (Q, D), and the position in it, 0 to 1 along
each axis. All sums are written out, so that the bits of a result do not depend on the number of
places.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..arrays import FloatArray, IntArray

CELL = np.indices((2, 2, 2)).reshape(3, 8).T


def sample_trilinear(
    blocks: FloatArray, rows: IntArray, place: FloatArray, factor: int
) -> tuple[FloatArray, FloatArray]:
    """Return the value and the gradient at places.

    Parameters
    ----------
    blocks : (Q, D + 1) float32
        The nodes' values, contiguous; the last column is for absent blocks.
    rows : (n,) int32
        Blocks; -1 reads the last column.
    place : (3, n) float32
        Positions in the blocks, 0 to 1.
    factor : int
        K, the cells along a block.

    Returns
    -------
    (n,) and (3, n) float32
        The value, in the unit of ``blocks``, and its gradient per cell.
    """
    low, (x, y, z) = find_cell(place, factor)
    side, width = factor + 1, blocks.shape[1]
    steps = (CELL @ np.array([side * side, side, 1])) * width
    first = ((low[0] * side + low[1]) * side + low[2]) * np.int64(width) + rows % width
    corner = blocks.ravel().take(first + steps[:, None])  # (8, n)
    along_z = corner[1::2] - corner[::2]
    at_z = corner[::2] + along_z * z
    along_y = at_z[1::2] - at_z[::2]
    at_yz = at_z[::2] + along_y * y
    along_x = at_yz[1] - at_yz[0]
    slope_z = along_z[::2] + (along_z[1::2] - along_z[::2]) * y
    gradient_y = along_y[0] + (along_y[1] - along_y[0]) * x
    gradient_z = slope_z[0] + (slope_z[1] - slope_z[0]) * x
    return at_yz[0] + along_x * x, np.stack([along_x, gradient_y, gradient_z])


def find_cell(place: FloatArray, cells: int) -> tuple[IntArray, FloatArray]:
    """Return the cells of places (3, n), (3, n) int32, and the positions in them, 0 to 1."""
    scaled = place * np.float32(cells)
    low = np.minimum(scaled.astype(np.int32), cells - 1)
    return low, scaled - low.astype(np.float32)


def prolong(values: FloatArray, cells: int, finer: int) -> FloatArray:
    """Interpolate values trilinearly to the nodes of a finer lattice of the same blocks.

    Parameters
    ----------
    values : ((cells + 1)^3, n) float32
        The nodes' values in n blocks.
    cells, finer : int
        Cells along a block, before and after.

    Returns
    -------
    ((finer + 1)^3, n) float32
        If the copies of shared nodes were equal before, they are equal, bit for bit.
    """
    block = values.reshape(*(cells + 1,) * 3, -1)
    for axis in range(3):
        source = np.moveaxis(block, axis, 0)
        block = np.empty((*block.shape[:axis], finer + 1, *block.shape[axis + 1 :]), np.float32)
        for plane, (low, share) in zip(np.moveaxis(block, axis, 0), finer_places(cells, finer)):
            plane[:] = source[low]
            if share:
                plane += (source[low + 1] - source[low]) * share
    return block.reshape(len(block) ** 3, -1)


@lru_cache
def finer_places(cells: int, finer: int) -> list[tuple[int, np.float32]]:
    """Return along an axis the coarse node before each finer node, and the share beyond it.

    The share is 0 for a finer node that lies on a coarse one, the last one included.
    """
    places = [divmod(number * cells, finer) for number in range(finer + 1)]
    return [(low, np.float32(rest / finer)) for low, rest in places]
