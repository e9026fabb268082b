"""The band of voxels near the surface: which are decoded, and which of their samples are exact.

Everything here is in index space with values in half voxels: a voxel has side 2, a distance of
one spacing h is 2, and the band is ``abs(value) < 3`` (Eqs. 2 and 4).

A sample of the band is taken as an exact distance if it contradicts no neighbour, is near the
surface, and was not cut off. If too many contradict others, the field is noisy, and none is exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import CENTRE, NEIGHBOURHOOD, BoolArray, FloatArray, IntArray
from ..errors import GridError, NoSurfaceError
from ..grid.samples import let_go, over_three
from ..grid.sdf_grid import SdfGrid
from ..threads import over_threads, worthwhile_threads
from .bounds import FARTHEST, SampleSpheres

HALF_BAND = 3.0  # Eq. 2 after Eq. 4: 1.5 h
# Patch values are clipped to this (3 h): samples that are farther from the surface do not matter to
# it, and a field that was truncated at 3 h or beyond gives the same result as the whole one.
PATCH_LIMIT = 6.0
# A voxel whose sample is farther than its corners, sqrt(3)/2 h, cannot hold the surface of an
# exact distance. The margin, a quarter of h, is for the network's own error.
DECODE_LIMIT = 3**0.5 + 0.5
# Two distances differ by no more than their samples are apart (Lipschitz); slack for rounding.
LIPSCHITZ_SLACK = 0.1
MAX_DISTANCE = 2.8  # of exact samples: those near the band's edge, 3, may have been truncated there
MIN_SLOPE = 0.7  # towards the steepest neighbour; near 1 for a distance
MAX_NOISY_SHARE = 0.02  # of all samples; in a noisier field no sample is taken as exact
BLOCK_SAMPLES = 1 << 18  # read at a time, about, and a plane more on either side
# The largest difference between neighbours along an axis, and between a voxel's sample and that at
# each place of its patch, (27,).
MAX_STEP = 2 + LIPSCHITZ_SLACK
MAX_DIFFERENCE = (2 * np.linalg.norm(NEIGHBOURHOOD, axis=1) + LIPSCHITZ_SLACK).astype(np.float32)
FAR = 1e30  # half voxels: no sample of the band is there
CELLS = 64  # along the longest axis, of the counts by which a large grid is cut
ROUNDING = 1e-3  # so that the offset that an error suggests works


@dataclass(eq=False)
class BandSummary:
    """What the band of a whole grid says, whichever part of the grid is worked on."""

    side: int  # samples along the edge of each cube, of those into which the grid is cut
    cells: NDArray[np.int64]  # (a, b, c), voxels of the band in each cube
    count: int = 0  # voxels of the band
    noisy: int = 0  # those of them round which samples differ by more than distances can
    low: float = np.inf  # the lowest and the highest sample, in half voxels
    high: float = -np.inf
    leaves: bool = False  # whether a sample on the border is inside: the solid leaves the grid

    def add(self, found: tuple[NDArray[Any], ...]) -> None:
        """Count what ``_find`` found in some planes."""
        voxel_ijk, patches, lipschitz, *_, leaves = found
        self.count += len(voxel_ijk)
        np.add.at(self.cells, tuple((voxel_ijk // self.side).T), 1)
        self.noisy += int(np.count_nonzero(~lipschitz))
        self.low = min(self.low, float(patches[:, CENTRE].min(initial=np.inf)))
        self.high = max(self.high, float(patches[:, CENTRE].max(initial=-np.inf)))
        self.leaves |= bool(leaves.any())


@dataclass(frozen=True, eq=False)
class Band:
    """The active voxels of a grid (Eq. 2), their samples, and what these can be used for."""

    grid: SdfGrid
    offset: float  # world units: at this distance is the surface
    voxel_ijk: IntArray  # (V, 3), the voxels, in C order
    patches: FloatArray  # (V, 27), the samples round each voxel, in half voxels
    lipschitz: BoolArray  # (V,), which patches can be distances
    decoded: BoolArray  # (V,), which voxels can hold the surface, and so are decoded
    exact: BoolArray  # (V,), which own samples can be taken as exact distances
    # samples beyond the band may be exact distances if they lie between these, in half voxels
    limits: tuple[float, float]
    trusted: SampleSpheres  # of the samples that are exact, and of some beyond the band
    whole: BandSummary


def survey(
    grid: SdfGrid,
    offset: float = 0.0,
    *,
    threads: int = 1,
    whole: BandSummary | None = None,
    most: float = np.inf,
) -> Band:
    """Return the band of a cubic grid, which is read once.

    With ``whole`` the grid is a part of another one, of which that is the summary. Of a band of
    over ``most`` voxels only the summary is returned.
    """
    side = -(-max(grid.shape) // CELLS)
    summary = BandSummary(side, np.zeros([-(-n // side) for n in grid.shape], np.int64))
    parts = list[tuple[NDArray[Any], ...]]()
    ends = np.array([*grid.field.exact, grid.low, grid.high])
    ends = np.clip((ends - offset) * 2 / grid.voxel_size, -FAR, FAR).astype(np.float32)
    low, high, lowest, highest = ends.tolist()
    limits = max(low, lowest), min(high, highest)  # at its ends a field may be cut off
    step = max(BLOCK_SAMPLES // prod(grid.shape[1:]), 4, 2 * getattr(grid.samples, "beside", 0))
    blocks = [(at, min(at + step, grid.shape[0])) for at in range(0, grid.shape[0], step)]
    for found in over_threads(partial(_find, grid, offset, limits), blocks, threads):
        if offset and not whole:  # distances must not be cut off near it; at 0 none is better
            _check_offset(grid, offset, found[1])
        summary.add(found)
        parts.append(found)
        if summary.count > most:
            parts = [tuple(each[:0] for each in found)]
    if grid.is_resampled:  # beside edges, interpolated values contradict each other without noise
        summary.noisy = 0
    whole = whole or summary
    ijk, patches, lipschitz, decoded, number, value, _ = map(np.concatenate, zip(*parts))
    del parts, found
    exact, sample = _exact(patches, lipschitz, whole), patches[:, CENTRE]
    exact &= (sample > low) & (sample < high)
    own = np.ravel_multi_index(tuple(ijk[exact].T), grid.shape)
    number, value = np.append(own, number), np.append(sample[exact], value)
    # whether limits are beyond the band is the same for all parts of a grid
    is_trusted = exact.any() and (limits[0] < -HALF_BAND or limits[1] > HALF_BAND)
    order = np.argsort(number, kind="stable") if is_trusted else slice(0)
    trusted = SampleSpheres(grid.shape, number[order], value[order])
    known = ijk, patches, lipschitz, decoded, exact
    return Band(grid, offset, *known, limits, trusted, whole)


def no_surface(grid: SdfGrid, offset: float) -> NoSurfaceError:
    """Return the error for a grid without a surface at an offset."""
    ends = f"the values go from {grid.low:.6g} to {grid.high:.6g}"
    return NoSurfaceError(f"no surface at {offset:g}: {ends}")


def _find(
    grid: SdfGrid, offset: float, limits: tuple[float, float], planes: tuple[int, int]
) -> tuple[NDArray[Any], ...]:
    """Return arrays of the voxels from one plane of a grid to before another: see ``Band``.

    The last three are numbers and values of samples beyond the band that may be exact, in C order,
    and whether a sample on the border of the grid is inside.
    """
    (first, last), count = planes, grid.shape[0]
    low, is_spline = max(first - 1, 0), grid.field.network is None
    rescaled = rescale(grid, offset, low, min(last + 1, count))
    let_go(grid.samples)
    own, unseen = slice(first - low, last - low), grid.field.unseen
    known = True if unseen is None else ~np.asarray(unseen[first:last])
    active = (is_near if is_spline else is_active)(rescaled)[own] & known
    ijk = np.argwhere(active).astype(np.int32)
    patches = gather_patches(rescaled, ijk + np.array([own.start, 0, 0], np.int32))
    ijk[:, 0] += first

    lipschitz = is_lipschitz(patches)
    # Only a patch that can be distances proves, by a sample far from the surface, that the
    # voxel holds none.
    decoded: BoolArray = (np.abs(patches[:, CENTRE]) <= DECODE_LIMIT) | ~lipschitz | is_spline
    if grid.field.sides_only:
        decoded = np.asarray((patches > 0).any(1) & (patches <= 0).any(1))

    inner = rescaled[own]
    faces = [inner[:, [0, -1]], inner[:, :, [0, -1]]]
    faces += [inner[0]] * (first == 0) + [inner[-1]] * (last == count)
    leaves = np.array([any((face <= 0).any() for face in faces)])
    lowest, highest = np.clip(limits, -FARTHEST, FARTHEST).astype(np.float32)
    beyond = known & (inner > lowest) & (inner < highest) & (np.abs(inner) >= HALF_BAND)
    number, value = np.flatnonzero(beyond) + first * inner[0].size, inner[beyond]
    return ijk, patches, lipschitz, decoded, number, value, leaves


def _exact(patches: FloatArray, lipschitz: BoolArray, whole: BandSummary) -> BoolArray:
    """Return which samples of a band can be taken as exact distances, (V,): see the module.

    A truncated sample is the lowest or the highest of the ``whole`` band, and has no neighbour
    towards which the field is as steep as a distance.
    """
    sample, is_noisy = patches[:, CENTRE], whole.noisy >= MAX_NOISY_SHARE * whole.count
    exact: BoolArray = lipschitz & (np.abs(sample) < MAX_DISTANCE) & (not is_noisy)
    ends = np.where(sample > 0, np.float32(whole.high), np.float32(whole.low))
    at_limit = np.flatnonzero(exact & (sample == ends))
    slope = np.abs(patches[at_limit] - sample[at_limit, None]) / np.maximum(MAX_DIFFERENCE, 1)
    exact[at_limit] = slope.max(1) >= MIN_SLOPE
    return exact


def _check_offset(grid: SdfGrid, offset: float, patches: FloatArray) -> None:
    """Raise GridError if distances are cut off within the band of an offset.

    A sample that is cut off is equal to all round it, which a distance never is.
    """
    centre = patches[:, CENTRE]
    cut_off = (patches == centre[:, None]).all(1) & (np.abs(centre) < HALF_BAND - ROUNDING)
    if cut_off.any():
        end = offset + float(centre[cut_off][0]) * grid.voxel_size / 2
        room = HALF_BAND / 2 * grid.voxel_size
        limit = np.copysign(max(abs(end) - room, 0), end)
        raise GridError(
            f"offset {offset:g} needs distances {HALF_BAND / 2:g} spacings ({room:.6g}) to either "
            f"side of it, but they end at {end:.6g}: the farthest that works is {limit:.6g}"
        )


def rescale(
    grid: SdfGrid, offset: float = 0.0, first: int = 0, last: int | None = None
) -> FloatArray:
    """Return planes ``first`` to before ``last``, all by default, in half voxels, as float32.

    They are ``(values - offset) * 2 / h`` (Eq. 4). The surface at the distance ``offset``, in world
    units, positive outwards, becomes the zero level (Sec. 5.3).
    """
    planes, scale = grid.planes(first, grid.shape[0] if last is None else last), 2 / grid.voxel_size
    rescaled = np.empty(planes.shape, np.float32)
    limit = float(np.finfo(np.float32).max) / 4 / scale
    for plane, out in zip(planes, rescaled):  # plane by plane: in cache, and no second copy
        shifted = np.clip(plane.astype(np.float64) - offset, -limit, limit)
        np.multiply(shifted, scale, out=out, casting="same_kind")
    return rescaled


def is_active(rescaled: FloatArray) -> BoolArray:
    """Return which voxels are active, ``abs(rescaled) < 3`` (Eq. 2).

    A distance cannot jump over the band, from beyond it on one side to beyond it on the other.
    Where the input does, both voxels are added: a surface must pass between them.
    """
    above, below = rescaled >= HALF_BAND, rescaled <= -HALF_BAND
    jumps = over_three(above, np.logical_or) & over_three(below, np.logical_or)
    return np.asarray(~(above | below) | jumps)


def is_near(values: FloatArray) -> BoolArray:
    """Return which voxels a surface at 0 may pass, whatever the slope, (nx, ny, nz).

    Values there are no farther from 0 than they change to neighbours, added up over the axes, or
    some of the 26 samples round them are on the other side. Where values are constant they are not.
    """
    change = np.zeros_like(values)
    for axis in range(3):
        lines = np.moveaxis(values, axis, 0)
        steps = np.pad(np.abs(np.diff(lines, axis=0)), ((1, 1), (0, 0), (0, 0)))
        change += np.moveaxis(np.maximum(steps[1:], steps[:-1]), 0, axis)
    mixed = over_three(values > 0, np.logical_or) & over_three(values <= 0, np.logical_or)
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
    strides = np.array([padded[0].size, padded.shape[2], 1])
    around = ((voxel_ijk + 1) @ strides)[:, None] + NEIGHBOURHOOD @ strides
    return np.asarray(padded.ravel().take(around))


def neighbour_table(voxel_ijk: IntArray, shape: tuple[int, int, int], threads: int = 1) -> IntArray:
    """Return the neighbour table (V, 27) of voxels (V, 3), all different and in C order.

    It has their rows at the 27 places of ``NEIGHBOURHOOD`` round each, -1 where there is no voxel.
    As an index -1 is the last row, so append a row of zeros to the array that is gathered from.
    """
    strides = np.array([(shape[1] + 2) * (shape[2] + 2), shape[2] + 2, 1])
    keys = voxel_ijk.astype(np.int64) @ strides  # ascending; a step beyond the grid has no key
    table, steps = np.full((len(keys), 27), -1, np.int32), (NEIGHBOURHOOD @ strides).tolist()
    table[:, CENTRE] = np.arange(len(keys))

    def find(first: int) -> None:  # at a place and the next two, which are beside it along z
        at = np.searchsorted(keys, keys + steps[first])
        for place in range(first, min(first + 3, CENTRE)):
            is_there = keys.take(at) == keys + steps[place]
            row = np.flatnonzero(is_there)
            there = at.take(row)
            table[row, place], table[there, 26 - place] = there, row  # a neighbour's neighbour
            at += is_there

    list(over_threads(find, range(0, CENTRE, 3), worthwhile_threads(27 * len(keys), threads)))
    return table


def is_lipschitz(patches: FloatArray) -> BoolArray:
    """Return which patches (V, 27) can be distances, (V,) bool: those that are 1-Lipschitz.

    This fails nearly everywhere in a noisy field, and in many places of a field that is not a
    distance.
    """
    return np.asarray((np.abs(patches - patches[:, CENTRE, None]) <= MAX_DIFFERENCE).all(1))
