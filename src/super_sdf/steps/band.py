"""The band of voxels near the surface, their patches, and who is whose neighbour (Eqs. 2 and 4).

Everything here lives in index space with rescaled values: a voxel has side 2, so a distance of
one spacing h is 2 and the band is ``abs(value) < 3``.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..arrays import BoolArray, FloatArray, IntArray
from ..grid.sdf_grid import SdfGrid
from ..neighbourhood import CENTRE, NEIGHBOURHOOD

HALF_BAND = 3.0  # Eq. 2 after Eq. 4: 1.5 h
# Patch values are cut off here (3 h): farther samples say nothing about this voxel's surface, and
# a field that was truncated at 3 h or beyond gives the same result as the whole one.
PATCH_LIMIT = 6.0
# A voxel whose sample is farther than its corners, sqrt(3)/2 h, cannot hold the surface of an
# exact distance. The margin, a quarter of h, is for the network's own error.
DECODE_LIMIT = 3**0.5 + 0.5
# Neighbouring distances may differ by no more than the samples are apart; slack for rounding.
LIPSCHITZ_SLACK = 0.1

# Planes of about so many samples are worked on at a time, to stay small; but never fewer than so
# many planes, for a block looks at one more on either side.
BLOCK_SAMPLES = 1 << 18
BLOCK_PLANES = 4

# How far the sample in the middle and that at each place may differ.
REACH = (2 * np.linalg.norm(NEIGHBOURHOOD, axis=1) + LIPSCHITZ_SLACK).astype(np.float32)


def rescale(
    grid: SdfGrid, offset: float = 0.0, first: int = 0, last: int | None = None
) -> FloatArray:
    """Return the samples in half voxels, ``(values - offset) * 2 / h`` (Eq. 4).

    ``offset`` (world units) shifts the field, so that the surface at that distance, positive
    outwards, becomes the zero level (Sec. 5.3). The band's values then lie in [-3, 3] whatever the
    unit. Of planes ``first`` to before ``last`` only, if these are given.
    """
    planes = grid.planes(first, grid.shape[0] if last is None else last)
    rescaled = np.empty(planes.shape, np.float32)
    scale = 2.0 / grid.voxel_size
    limit = float(np.finfo(np.float32).max) / 4 / scale
    for plane, out in zip(planes, rescaled):  # plane by plane: in cache, and no second copy
        shifted = plane.astype(np.float64)
        np.clip(shifted, offset - limit, offset + limit, out=shifted)
        shifted -= offset
        np.multiply(shifted, scale, out=out, casting="same_kind")
    return rescaled


def find_band(rescaled: FloatArray) -> IntArray:
    """Return the active voxels, ``abs(rescaled) < 3`` (Eq. 2), as (V, 3) indices in C order.

    A distance cannot jump from beyond the band on one side to beyond it on the other. Where the
    input does so all the same, both voxels are taken in: a surface must pass between them.
    """
    active = np.abs(rescaled) < HALF_BAND
    outside = rescaled > 0
    above, below = outside & ~active, ~(outside | active)
    if (above & _dilate(below)).any():
        active |= (above & _dilate(below)) | (below & _dilate(above))
    return np.ascontiguousarray(np.argwhere(active), np.int32)


def _dilate(mask: BoolArray) -> BoolArray:
    """Grow a mask by one voxel in all 26 directions."""
    grown = mask.copy()
    for axis in range(3):
        source = np.moveaxis(grown.copy(), axis, 0)
        target = np.moveaxis(grown, axis, 0)
        target[1:] |= source[:-1]
        target[:-1] |= source[1:]
    return grown


def pad_by_extrapolation(rescaled: FloatArray) -> FloatArray:
    """Continue the grid by one sample on every side, linearly, and cut it off at 3 h."""
    padded = np.pad(np.clip(rescaled, -2 * PATCH_LIMIT, 2 * PATCH_LIMIT), 1)
    for axis in range(3):
        planes = np.moveaxis(padded, axis, 0)
        planes[0] = 2 * planes[1] - planes[2]
        planes[-1] = 2 * planes[-2] - planes[-3]
    return np.clip(padded, -PATCH_LIMIT, PATCH_LIMIT, out=padded)


def gather_patches(rescaled: FloatArray, voxel_ijk: IntArray) -> FloatArray:
    """Return the 27 samples round each voxel, (V, 27) in the order of ``NEIGHBOURHOOD``."""
    padded = pad_by_extrapolation(rescaled)
    centre, steps = _flat_steps(voxel_ijk, rescaled.shape)
    patches = np.empty((len(voxel_ijk), 27), np.float32)
    for column, step in enumerate(steps):
        np.take(padded.ravel(), centre + step, out=patches[:, column])
    return patches


def neighbour_table(voxel_ijk: IntArray, shape: tuple[int, ...]) -> IntArray:
    """Return who stands at each of the 27 places round each voxel.

    Parameters
    ----------
    voxel_ijk : (V, 3) int32
        The voxels, all different, in C order.
    shape : three ints
        Samples of the grid along each axis.

    Returns
    -------
    (V, 27) int32
        Row numbers into ``voxel_ijk`` in the order of ``NEIGHBOURHOOD``, -1 where there is none.
        As an index, -1 is the last row: append a row of zeros to what is gathered.
    """
    table = np.empty((len(voxel_ijk), 27), np.int32)
    for first, last in plane_blocks(shape):
        start, low, high, stop = np.searchsorted(
            voxel_ijk[:, 0], [first - 1, first, last, last + 1]
        )
        around = voxel_ijk[start:stop] - np.array([first, 0, 0], np.int32)
        at, steps = _flat_steps(around, shape)
        row_at = np.full((last - first + 2) * (shape[1] + 2) * (shape[2] + 2), -1, np.int32)
        row_at[at] = np.arange(start, stop, dtype=np.int32)
        for column, step in enumerate(steps):
            np.take(row_at, at[low - start : high - start] + step, out=table[low:high, column])
    return table


def plane_blocks(
    shape: tuple[int, ...], first: int = 0, last: int | None = None
) -> Iterator[tuple[int, int]]:
    """Yield planes in blocks of about ``BLOCK_SAMPLES``, (first, behind the last)."""
    step = max(BLOCK_SAMPLES // (shape[1] * shape[2]), BLOCK_PLANES)
    end = shape[0] if last is None else last
    for start in range(first, end, step):
        yield start, min(start + step, end)


def _flat_steps(
    voxel_ijk: IntArray, shape: tuple[int, ...]
) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], list[int]]:
    """Return flat positions in the grid padded by one, and the 27 steps to the neighbours."""
    strides = np.array([(shape[1] + 2) * (shape[2] + 2), shape[2] + 2, 1], np.int64)
    return (voxel_ijk + 1) @ strides, [int(step) for step in NEIGHBOURHOOD @ strides]


def is_lipschitz(patches: FloatArray) -> BoolArray:
    """Say of each patch, (V,) of bool, whether its samples can be distances.

    Distances of two points differ by no more than the points are apart. In a noisy field that is
    broken nearly everywhere, in one that is no distance in many places.
    """
    centre = patches[:, CENTRE]
    keeps = np.ones(len(patches), bool)
    for column in range(27):
        keeps &= np.abs(patches[:, column] - centre) <= REACH[column]
    return keeps


def can_hold_surface(patches: FloatArray, lipschitz: BoolArray) -> BoolArray:
    """Say which voxels, (V,) of bool, may contain a piece of the surface.

    If its patch is of distances (``is_lipschitz``), a voxel whose sample is farther than its corner
    holds no surface. Else the sample proves nothing, and the voxel is kept.
    """
    near: BoolArray = np.abs(patches[:, CENTRE]) <= DECODE_LIMIT
    return near | ~lipschitz
