"""The band of voxels near the surface: which they are, their patches, and what these tell.

Everything here is in index space with values in half voxels: a voxel has side 2, a distance of
one spacing h is 2, and the band is ``abs(value) < 3`` (Eqs. 2 and 4).

A sample of the band is taken as an exact distance if it contradicts no neighbour, is near the
surface, and was not cut off. If too many contradict others, the field is noisy, and none is.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import CENTRE, NEIGHBOURHOOD, BoolArray, FloatArray, IntArray
from ..errors import GridError
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
# The largest difference between a voxel's sample and that at each place of its patch, (27,).
MAX_STEP = 2 + LIPSCHITZ_SLACK  # between neighbours along an axis
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
    corners = above.view(np.uint8) | below.view(np.uint8) << 1
    for axis in range(3):  # of a cell
        lines = np.moveaxis(corners, axis, 0)
        corners = np.moveaxis(lines[1:] | lines[:-1], 0, axis)
    if (corners == 3).any():
        active |= (above & _dilate(below)) | (below & _dilate(above))
    return active


def _dilate(mask: BoolArray) -> BoolArray:
    """Return a mask grown by one voxel in all 26 directions."""
    grown = mask.copy()
    for axis in range(3):
        source = np.moveaxis(grown.copy(), axis, 0)
        target = np.moveaxis(grown, axis, 0)
        target[1:] |= source[:-1]
        target[:-1] |= source[1:]
    return grown


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
    shape: tuple[int, ...], first: int = 0, last: int | None = None, least: int = BLOCK_PLANES
) -> Iterator[tuple[int, int]]:
    """Yield (start, stop) of blocks of ``BLOCK_SAMPLES`` samples or of ``least`` planes."""
    step = max(BLOCK_SAMPLES // (shape[1] * shape[2]), least)
    end = shape[0] if last is None else last
    for start in range(first, end, step):
        yield start, min(start + step, end)


def _flat_steps(voxel_ijk: IntArray, shape: tuple[int, ...]) -> tuple[NDArray[np.int64], list[int]]:
    """Return flat indices (V,) into the grid padded by one, and the 27 steps to neighbours."""
    strides = np.array([(shape[1] + 2) * (shape[2] + 2), shape[2] + 2, 1], np.int64)
    return (voxel_ijk + 1) @ strides, [int(step) for step in NEIGHBOURHOOD @ strides]


def is_lipschitz(patches: FloatArray, places: Iterable[int] = range(27)) -> BoolArray:
    """Return which patches (V, 27) can be distances, (V,) bool: those that are 1-Lipschitz.

    The distances of two points differ by no more than the points are apart. This fails nearly
    everywhere in a noisy field, and in many places of a field that is not a distance.
    ``places`` are those of a patch that are compared with its centre.
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


def can_hold_surface(patches: FloatArray, lipschitz: BoolArray) -> BoolArray:
    """Return which voxels may contain a piece of the surface, (V,) bool.

    If a patch can be distances (``lipschitz``), a sample farther from the surface than the voxel's
    corners proves that the voxel holds none. Otherwise it proves nothing.
    """
    near: BoolArray = np.abs(patches[:, CENTRE]) <= DECODE_LIMIT
    return near | ~lipschitz


def exact_samples(
    patches: FloatArray, lipschitz: BoolArray, limits: tuple[float, float]
) -> BoolArray:
    """Return which samples of a band that is not noisy can be taken as exact distances, (V,) bool.

    A truncated sample is one of the ``limits``, the lowest and the highest sample of the whole
    band, and has no neighbour towards which the field is as steep as a distance.
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


# Distances must reach far enough beyond an offset, in half voxels, where they are truncated, and
# where fill values begin: a surface too near these would come out in loose pieces. Neighbouring
# samples of noisy distances differ by up to twice the spacing (4 half voxels); a distance and a
# fill value differ by more, a jump. A small share of jumps is tolerated as outliers.
CUT_OFF_MARGIN, FILL_MARGIN = HALF_BAND, 5.0
MIN_JUMP, MAX_JUMP_SHARE = 4.2, 0.05
# Tolerances in half voxels, so that the offset that the message suggests works: for rounding, and
# because no sample lies exactly where fill values begin.
ROUNDING, UNSAMPLED = 1e-3, 0.1

Jumps: TypeAlias = tuple[int, int, float]
"""Of the samples near an offset: how many jump to a neighbour, how many there are, and the farthest
with a jump, in half voxels from the offset."""


def find_jumps(rescaled: FloatArray, own: slice) -> Jumps:
    """Return the jumps upwards in planes (n, ny, nz), in half voxels.

    Samples are counted in planes ``own``; those beside them only show whether there is a jump.
    """
    jumps = np.zeros(rescaled.shape, bool)
    for axis in range(3):
        values, found = np.moveaxis(rescaled, axis, 0), np.moveaxis(jumps, axis, 0)
        step = values[1:] - values[:-1]
        found[:-1] |= step > MIN_JUMP
        found[1:] |= step < -MIN_JUMP
    near = np.abs(rescaled[own]) < PATCH_LIMIT
    found = jumps[own] & near
    return int(found.sum()), int(near.sum()), float(rescaled[own][found].max(initial=-np.inf))


def check_not_cut_off(patches: FloatArray, offset: float, voxel_size: float) -> None:
    """Raise GridError if the distances are truncated within 1.5 voxels of an offset.

    ``patches`` (V, 27) are of the band there. A distance never equals all its neighbours.
    """
    centre = patches[:, CENTRE]
    cut_off = (patches == centre[:, None]).all(1) & (np.abs(centre) < CUT_OFF_MARGIN - ROUNDING)
    if cut_off.any():
        end = offset + float(centre[cut_off][0]) * voxel_size / 2
        raise _too_near(offset, voxel_size, end, CUT_OFF_MARGIN, outwards=end > 0)


def check_not_filled(
    up: Sequence[Jumps], down: Sequence[Jumps], offset: float, voxel_size: float
) -> None:
    """Raise GridError if fill values begin within 2.5 voxels of an offset, by all jumps."""
    for side, parts in ((1, up), (-1, down)):
        counts, near, ends = zip(*parts)
        jumps_enough = sum(counts) > MAX_JUMP_SHARE * sum(near)
        if jumps_enough and max(ends) < FILL_MARGIN - UNSAMPLED:
            end = offset + side * max(ends) * voxel_size / 2
            raise _too_near(offset, voxel_size, end, FILL_MARGIN, outwards=side > 0)


def _too_near(
    offset: float, voxel_size: float, end: float, needed: float, *, outwards: bool
) -> GridError:
    """Return the error for distances that end (world units) within ``needed`` half voxels."""
    room = needed / 2 * voxel_size
    limit, which = (end - room, "largest") if outwards else (end + room, "smallest")
    works = f"the {which} that works is {limit:.6g}" if limit * end > 0 else "only 0 works"
    return GridError(
        f"offset {offset:g} needs distances {needed / 2:g} spacings ({room:.6g}) to either side "
        f"of it, but they end at {end:.6g}: {works}"
    )
