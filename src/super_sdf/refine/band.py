"""The band of voxels near the surface: which they are, their patches, and what these tell.

Everything here is in index space with values in half voxels: a voxel has side 2, a distance of
one spacing h is 2, and the band is ``abs(value) < 3`` (Eqs. 2 and 4).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from ..arrays import CENTRE, NEIGHBOURHOOD, BoolArray, FloatArray, IntArray
from ..grid.sdf_grid import SdfGrid
from ..threads import chunks_of

HALF_BAND = 3.0  # Eq. 2 after Eq. 4: 1.5 h
# Patch values are clipped to this (3 h): samples that are farther from the surface do not matter to
# it, and a field that was truncated at 3 h or beyond gives the same result as the whole one.
PATCH_LIMIT = 6.0
# A voxel whose sample is farther than its corners, sqrt(3)/2 h, cannot hold the surface of an
# exact distance. The margin, a quarter of h, is for the network's own error.
DECODE_LIMIT = 3**0.5 + 0.5
# Two distances differ by no more than their samples are apart (Lipschitz); slack for rounding.
LIPSCHITZ_SLACK = 0.1
JUMP = 0.2  # by which values differ more than noise makes distances differ
MAX_DISTANCE = 2.8  # of exact samples: those near the band's edge, 3, may have been truncated there
MIN_SLOPE = 0.7  # towards the steepest neighbour; near 1 for a distance
# Planes are worked on in blocks of about this many samples, but of a few planes at least, since a
# block also reads one plane more on either side.
BLOCK_SAMPLES, BLOCK_PLANES = 1 << 18, 4
# The largest difference between neighbours along an axis, and between a voxel's sample and that at
# each place of its patch, (27,).
MAX_STEP = 2 + LIPSCHITZ_SLACK
MAX_DIFFERENCE = (2 * np.linalg.norm(NEIGHBOURHOOD, axis=1) + LIPSCHITZ_SLACK).astype(np.float32)


def rescale(
    grid: SdfGrid, offset: float = 0.0, first: int = 0, last: int | None = None
) -> FloatArray:
    """Return the samples in half voxels, ``(values - offset) * 2 / h`` (Eq. 4), as float32.

    Values in the band then lie in [-3, 3], whatever the unit of the grid. ``offset`` is the
    distance in world units, positive outwards, of the surface that becomes the zero level (Sec.
    5.3). Read are planes ``first`` to before ``last``, all by default.
    """
    planes = grid.planes(first, grid.shape[0] if last is None else last)
    rescaled = np.empty(planes.shape, np.float32)
    scale = 2.0 / grid.voxel_size
    limit = float(np.finfo(np.float32).max) / 4 / scale
    is_huge = grid.low < offset - limit or grid.high > offset + limit
    for plane, out in zip(planes, rescaled):  # plane by plane: in cache, and no second copy
        shifted = plane.astype(np.float64)
        if is_huge:
            np.clip(shifted, offset - limit, offset + limit, out=shifted)
        if offset:
            shifted -= offset
        np.multiply(shifted, scale, out=out, casting="same_kind")
    return rescaled


def find_band(rescaled: FloatArray) -> IntArray:
    """Return the active voxels as (V, 3) int32 in C order: see ``is_active``."""
    return np.ascontiguousarray(np.argwhere(is_active(rescaled)), np.int32)


def is_active(rescaled: FloatArray) -> BoolArray:
    """Return which voxels are active, ``abs(rescaled) < 3`` (Eq. 2).

    A distance cannot jump over the band, from beyond it on one side to beyond it on the other.
    Where the input does, both voxels are added: a surface must pass between them.
    """
    above, below = rescaled >= HALF_BAND, rescaled <= -HALF_BAND
    active = ~(above | below)
    sides = above.view(np.uint8) | below.view(np.uint8) << 1  # of samples, then of edges ... cells
    for axis in range(3):
        lines = np.moveaxis(sides, axis, 0)
        sides = np.moveaxis(lines[1:] | lines[:-1], 0, axis)
    if (sides == 3).any():
        for own, other in ((above, below), (below, above)):
            near = other.copy()  # grown by one voxel in all 26 directions
            for axis in range(3):
                source, grown = (np.moveaxis(mask, axis, 0) for mask in (near.copy(), near))
                grown[1:] |= source[:-1]
                grown[:-1] |= source[1:]
            active |= own & near
    return active


def is_near(values: FloatArray) -> BoolArray:
    """Return which voxels a surface at 0 may pass, whatever the slope, (nx, ny, nz).

    Values there are no farther from 0 than they change to neighbours, added up over the axes, or
    some of the 26 samples round them are on the other side. Where values are constant they are not.
    """
    change = np.zeros_like(values)
    sides: NDArray[np.uint8] = 1 + (values > 0).view(np.uint8)  # of samples, then of ... cells
    for axis in range(3):
        lines, cells = np.moveaxis(values, axis, 0), np.moveaxis(sides, axis, 0)
        sides = np.moveaxis(np.bitwise_or(cells[1:], cells[:-1]), 0, axis)
        steps = np.abs(lines[1:] - lines[:-1])
        largest = np.concatenate([steps[:1], np.maximum(steps[1:], steps[:-1]), steps[-1:]])
        change += np.moveaxis(largest, 0, axis)
    mixed = sides == 3
    for axis in range(3):
        mixed = np.pad(mixed, [(int(n == axis),) * 2 for n in range(3)])
        both = np.moveaxis(mixed, axis, 0)
        mixed = np.moveaxis(both[1:] | both[:-1], 0, axis)
    return np.asarray((np.abs(values) < change) | mixed)


def gather_patches(rescaled: FloatArray, voxel_ijk: IntArray) -> FloatArray:
    """Return the 27 samples round each voxel (V, 3), in the order of ``NEIGHBOURHOOD``, (V, 27).

    The grid is extrapolated linearly by one sample, but at jumps, and clipped to 3 h.
    """
    padded = np.pad(np.clip(rescaled, -2 * PATCH_LIMIT, 2 * PATCH_LIMIT), 1)
    for axis in range(3):
        planes = np.moveaxis(padded, axis, 0)
        for outer, border, inner in ((0, 1, 2), (-1, -2, -3)):
            planes[outer] = 2 * planes[border] - planes[inner]
            steep = np.abs(planes[border] - planes[inner]) > MAX_STEP
            planes[outer][steep] = planes[border][steep]
    np.clip(padded, -PATCH_LIMIT, PATCH_LIMIT, out=padded)
    centre, steps = _flat_steps(voxel_ijk, rescaled.shape)
    patches = np.empty((len(voxel_ijk), 27), np.float32)
    for rows in chunks_of(len(voxel_ijk), 27):
        for column, step in enumerate(steps):
            patches[rows, column] = padded.ravel().take(centre[rows] + step)
    return patches


def neighbour_table(voxel_ijk: IntArray, shape: tuple[int, ...]) -> IntArray:
    """Return the neighbour table (V, 27) of voxels (V, 3), all different and in C order.

    It has their rows at the 27 places of ``NEIGHBOURHOOD`` round each, -1 where there is no voxel.
    As an index -1 is the last row, so append a row of zeros to the array that is gathered from.
    """
    table = np.empty((len(voxel_ijk), 27), np.int32)
    for first, last in plane_blocks(shape):
        ends = [first - 1, first, last, last + 1]
        start, low, high, stop = np.searchsorted(voxel_ijk[:, 0], ends)
        around = voxel_ijk[start:stop] - np.array([first, 0, 0], np.int32)
        at, steps = _flat_steps(around, shape)
        row_at = np.full((last - first + 2) * (shape[1] + 2) * (shape[2] + 2), -1, np.int32)
        row_at[at] = np.arange(start, stop, dtype=np.int32)
        for column, step in enumerate(steps):
            np.take(row_at, at[low - start : high - start] + step, out=table[low:high, column])
    return table


def plane_blocks(shape: tuple[int, ...], least: int = BLOCK_PLANES) -> Iterator[tuple[int, int]]:
    """Yield (start, stop) of blocks of ``BLOCK_SAMPLES`` samples or of ``least`` planes."""
    step = max(BLOCK_SAMPLES // (shape[1] * shape[2]), least)
    for start in range(0, shape[0], step):
        yield start, min(start + step, shape[0])


def _flat_steps(voxel_ijk: IntArray, shape: tuple[int, ...]) -> tuple[NDArray[np.int64], list[int]]:
    """Return flat indices (V,) into the grid padded by one, and the 27 steps to neighbours."""
    strides = np.array([(shape[1] + 2) * (shape[2] + 2), shape[2] + 2, 1], np.int64)
    return (voxel_ijk + 1) @ strides, [int(step) for step in NEIGHBOURHOOD @ strides]


def is_lipschitz(patches: FloatArray, places: Iterable[int] = range(27)) -> BoolArray:
    """Return which patches (V, 27) can be distances, (V,) bool: those that are 1-Lipschitz.

    This fails nearly everywhere in a noisy field, and in many places of a field that is not a
    distance. ``places`` are those of a patch that are compared with its centre.
    """
    keeps = np.ones(len(patches), bool)
    for rows in chunks_of(len(patches), 4 * 27):  # in cache
        centre = patches[rows, CENTRE]
        for column in places:
            keeps[rows] &= np.abs(patches[rows, column] - centre) <= MAX_DIFFERENCE[column]
    return keeps


def has_both_sides(patches: FloatArray) -> BoolArray:
    """Return in which patches (V, 27) samples lie on both sides of 0, (V,)."""
    outside = patches[:, CENTRE] > 0
    found = np.zeros(len(patches), bool)
    for column in range(27):
        found |= (patches[:, column] > 0) != outside
    return found


def is_filled_in(patches: FloatArray) -> BoolArray:
    """Return which samples were filled in, as by padding with a constant, (V,) bool.

    They are small, so that the surface should be near, but the field falls to none of the samples
    around, and rises to one by more than distances and noise do.
    """
    found = np.zeros(len(patches), bool)
    for rows in chunks_of(len(patches), 27):
        size = np.abs(patches[rows])
        size -= size[:, CENTRE, None].copy()
        at = np.flatnonzero((size > MAX_DIFFERENCE + JUMP).any(1))
        if len(at):
            some = (size[at] > -JUMP / 2).all(1) & ~has_both_sides(patches[rows][at])
            found[rows.start + at] = some
    return found


def exact_samples(
    patches: FloatArray, lipschitz: BoolArray, limits: tuple[float, float]
) -> BoolArray:
    """Return which samples of a band that is not noisy can be taken as exact distances, (V,) bool.

    They contradict no neighbour, are near the surface, and were not cut off: a truncated sample is
    one of the ``limits``, the lowest and the highest sample of the whole band, and has no neighbour
    towards which the field is as steep as a distance.
    """
    sample = patches[:, CENTRE]
    exact: BoolArray = lipschitz & (np.abs(sample) < MAX_DISTANCE)
    low, high = map(np.float32, limits)
    at_limit = np.flatnonzero(exact & (sample == np.where(sample > 0, high, low)))
    for rows in chunks_of(len(at_limit), 27):
        some = at_limit[rows]
        slope = np.abs(patches[some] - sample[some, None]) / np.maximum(MAX_DIFFERENCE, 1)
        exact[some] = slope.max(1) >= MIN_SLOPE
    return exact
