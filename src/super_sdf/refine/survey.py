"""The band of a grid, found in one pass over its planes: all that the steps need of the input.

A sample of the band is taken as an exact distance if it contradicts no neighbour, is near the
surface, and was not cut off. If too many contradict others, the field is noisy, and none is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import CENTRE, BoolArray, FloatArray, IntArray
from ..errors import GridError, NoSurfaceError
from ..grid.samples import let_go, planes_at_once
from ..grid.sdf_grid import SdfGrid, on_samples, sampled_places
from ..threads import over_threads
from .band import (
    DECODE_LIMIT,
    HALF_BAND,
    PATCH_LIMIT,
    exact_samples,
    gather_patches,
    has_both_sides,
    is_active,
    is_filled_in,
    is_lipschitz,
    is_near,
    plane_blocks,
    rescale,
)
from .bounds import FARTHEST, TrustedSamples

MAX_NOISY_SHARE = 0.02  # of all samples; in a noisier field no sample is taken as exact
FAR = 1e30  # half voxels: no sample of the band is there
CELLS = 64  # along the longest axis, of the counts by which a large grid is cut
# Half voxels beyond an offset within which distances must not be truncated, or fill values begin: a
# surface too near would come out in loose pieces. The tolerances make the offset that the message
# suggests work: for rounding, and because no sample lies exactly where fill values begin.
CUT_OFF_MARGIN, FILL_MARGIN = HALF_BAND, 5.0
ROUNDING, UNSAMPLED = 1e-3, 0.1
# Neighbouring samples of noisy distances differ by up to twice the spacing (4 half voxels); a
# distance and a fill value differ by more. A small share of jumps is tolerated as outliers.
MIN_JUMP, MAX_JUMP_SHARE = 4.2, 0.05


@dataclass(frozen=True, eq=False)
class BandSummary:
    """What the band of a whole grid says, whichever part of the grid is worked on."""

    told: int  # voxels that tell by their samples whether the field is noisy
    noisy: int  # those of them round which samples differ by more than distances can
    low: float  # the lowest and the highest sample, in half voxels
    high: float
    leaves: bool  # whether a sample on the border of the grid is inside: the solid leaves it
    # (a, b, c), voxels of the band in cubes of ``side`` samples; of a band that is kept, none
    cells: NDArray[np.int64]
    side: int = 1

    @property
    def is_noisy(self) -> bool:
        """Whether no sample can be taken as exact."""
        return not self.told or self.noisy / self.told > MAX_NOISY_SHARE


class BandTooLargeError(Exception):
    """A band has more voxels than fit in memory."""


@dataclass(frozen=True, eq=False)
class Band:
    """The active voxels of a grid (Eq. 2), their samples, and what these can be used for."""

    grid: SdfGrid
    offset: float  # world units: at this distance is the surface
    voxel_ijk: IntArray  # (V, 3), the voxels, in C order
    patches: FloatArray  # (V, 27), the samples round each voxel, in half voxels
    lipschitz: BoolArray  # (V,), which patches can be distances
    sampled: BoolArray  # (V,), which own values are samples, not interpolated by resampling
    decoded: BoolArray  # (V,), which voxels can hold the surface, and so are decoded
    exact: BoolArray  # (V,), which own samples can be taken as exact distances
    # samples beyond the band may be exact distances if they lie between these, in half voxels
    limits: tuple[float, float]
    trusted: TrustedSamples  # the samples whose spheres can be trusted, in the band and beyond
    leaves: bool

    def count_noisy(self) -> int:
        """Count the voxels whose own samples differ from others by more than distances can."""
        return int(np.count_nonzero(~self.lipschitz & self.sampled))


class _Block(NamedTuple):
    """What is found in some planes of a grid."""

    rows: tuple[IntArray, FloatArray, BoolArray, BoolArray, BoolArray]  # as in ``Band``
    beyond: tuple[NDArray[np.int64], FloatArray]  # numbers and values of samples there
    summary: BandSummary  # of these planes
    jumps: NDArray[np.float64] | None  # with an offset, see ``_count_jumps``


def survey(
    grid: SdfGrid,
    offset: float = 0.0,
    *,
    threads: int = 1,
    whole: BandSummary | None = None,
    most: float = np.inf,
) -> Band:
    """Read a cubic grid once and return its band.

    With ``whole`` the grid is a part of another one, of which that is the summary.
    BandTooLargeError is raised as soon as there are more than ``most`` voxels.
    """
    # the samples of the field, and those beyond the band, that can be exact lie between these
    low, high = ((limit - offset) * 2 / grid.voxel_size for limit in grid.field.exact)
    limits = 0.0, 0.0  # what is interpolated beyond the band promises little
    if grid.on_sample is None:
        scale = 2 / grid.voxel_size
        ends = np.clip([grid.low - offset, grid.high - offset], -FAR / scale, FAR / scale) * scale
        lowest, highest = map(float, ends.astype(np.float32))  # where it may be cut off
        limits = max(low, lowest), min(high, highest)
    blocks, count = list[_Block](), 0
    for block in _blocks(grid, offset, threads, limits, is_checked=whole is None):
        blocks.append(block)
        count += len(block.rows[0])
        if count > most:
            raise BandTooLargeError
    if whole is None:
        _check_offset([block.jumps for block in blocks], grid, offset)
        whole = _together([block.summary for block in blocks])
    number, value = (np.concatenate(each) for each in zip(*(block.beyond for block in blocks)))
    every = zip(*(block.rows for block in blocks))
    del blocks, block
    voxel_ijk, patches, lipschitz, sampled, decoded = map(np.concatenate, every)
    sample, exact = patches[:, CENTRE], np.zeros(len(patches), bool)
    if not whole.is_noisy:
        exact = exact_samples(patches, lipschitz, (whole.low, whole.high))
        exact &= (sample > low) & (sample < high)
    if exact.any() and sees_beyond(limits):  # all trusted samples, in the order of their numbers
        number = np.append(np.ravel_multi_index(tuple(voxel_ijk[exact].T), grid.shape), number)
        order = np.argsort(number, kind="stable")
        number, value = number[order], np.append(sample[exact], value)[order]
    else:
        number, value = number[:0], value[:0]
    trusted = TrustedSamples(grid.shape, number, value)
    rows = voxel_ijk, patches, lipschitz, sampled, decoded
    return Band(grid, offset, *rows, exact, limits, trusted, whole.leaves)


def summarise(grid: SdfGrid, offset: float = 0.0, threads: int = 1) -> BandSummary:
    """Return what the band of a cubic grid says, without keeping it; the grid is read once."""
    side = -(-max(grid.shape) // CELLS)
    cells = np.zeros([-(-n // side) for n in grid.shape], np.int64)
    jumps, parts = [], []
    for block in _blocks(grid, offset, threads):
        place = np.ravel_multi_index(tuple((block.rows[0] // side).T), cells.shape)
        cells += np.bincount(place, minlength=cells.size).reshape(cells.shape)
        jumps.append(block.jumps)
        parts.append(block.summary)
    _check_offset(jumps, grid, offset)
    return replace(_together(parts), cells=cells, side=side)


def sees_beyond(limits: tuple[float, float]) -> bool:
    """Return whether samples beyond the band can be exact: the same for all parts of a grid."""
    return limits[0] < -HALF_BAND or limits[1] > HALF_BAND


def no_surface(grid: SdfGrid, offset: float) -> NoSurfaceError:
    """Return the error for a grid without a surface at an offset."""
    return NoSurfaceError(
        f"no surface at {offset:g}: the values go from {grid.low:.6g} to {grid.high:.6g}"
    )


def _together(parts: list[BandSummary]) -> BandSummary:
    """Return the summary of planes of which these are the summaries."""
    told, noisy = sum(part.told for part in parts), sum(part.noisy for part in parts)
    low, high = min(part.low for part in parts), max(part.high for part in parts)
    return BandSummary(told, noisy, low, high, any(part.leaves for part in parts), parts[0].cells)


def _blocks(
    grid: SdfGrid,
    offset: float,
    threads: int,
    limits: tuple[float, float] = (0.0, 0.0),
    *,
    is_checked: bool = True,
) -> Iterator[_Block]:
    """Yield what is found in the planes of a grid, in order.

    An offset is checked: the distances must not be cut off near it. At 0 no other one is better.
    """
    unseen, count = grid.field.unseen, grid.shape[0]
    is_spline = grid.field.network is None

    def look(planes: tuple[int, int]) -> _Block:
        first, last = planes
        low, high = max(first - 1, 0), min(last + 1, count)
        rescaled = rescale(grid, offset, low, high)
        let_go(grid.samples)
        own = slice(first - low, last - low)
        inner, active = rescaled[own], (is_near if is_spline else is_active)(rescaled)[own]
        if unseen is not None:
            hidden = np.asarray(unseen[first:last])
            inner, active = np.where(hidden, np.float32(FAR), inner), active & ~hidden
        ijk = np.argwhere(active).astype(np.int32) + np.array([own.start, 0, 0], np.int32)
        patches = np.empty((0, 27), np.float32)
        if len(ijk):
            start, stop = np.maximum(ijk.min(0) - 1, 0), ijk.max(0) + 2  # the rest is far away
            around = rescaled[tuple(map(slice, start, stop))]
            patches = gather_patches(around, ijk - start)
            if not is_spline and (filled := is_filled_in(patches)).any():
                ijk, patches = ijk[~filled], patches[~filled]
        voxel_ijk = ijk + np.array([low, 0, 0], np.int32)

        # Samples of a resampled grid are judged by samples alone: interpolated values do not tell
        # whether these are noisy. Interpolated values that contradict no others count as exact,
        # since thin parts need them (docs/guides/formats.md).
        lipschitz, sampled = is_lipschitz(patches), on_samples(grid, voxel_ijk)
        if grid.on_sample is not None:
            lipschitz[sampled] = is_lipschitz(patches[sampled], sampled_places(grid))
        if is_spline:
            decoded = np.ones(len(patches), bool)
        elif grid.field.sides_only:
            decoded = has_both_sides(patches)
        else:
            # only a patch that can be distances proves, by a sample far from the surface, that
            # the voxel holds none
            decoded = (np.abs(patches[:, CENTRE]) <= DECODE_LIMIT) | ~lipschitz

        faces = [rescaled[own, [0, -1]], rescaled[own, :, [0, -1]]]
        faces += [rescaled[0]] * (first == 0) + [rescaled[-1]] * (last == count)
        summary = BandSummary(
            int(np.count_nonzero(sampled)),
            int(np.count_nonzero(sampled & ~lipschitz)),
            float(patches[:, CENTRE].min(initial=np.inf)),
            float(patches[:, CENTRE].max(initial=-np.inf)),
            any(bool((face <= 0).any()) for face in faces),
            np.empty((0, 0, 0), np.int64),
        )
        jumps = None
        if is_checked and offset:
            centre = patches[:, CENTRE]  # never equal to all around, unless it was cut off
            cut_off = (patches == centre[:, None]).all(1)
            cut_off &= np.abs(centre) < CUT_OFF_MARGIN - ROUNDING
            if cut_off.any():
                end = offset + float(centre[cut_off][0]) * grid.voxel_size / 2
                raise _too_near(grid, offset, end, CUT_OFF_MARGIN, outwards=end > 0)
            jumps = _count_jumps(rescaled, own)
        number, value = np.zeros(0, np.int64), np.zeros(0, np.float32)
        if sees_beyond(limits):
            lowest, highest = np.clip(limits, -FARTHEST, FARTHEST).astype(np.float32)
            found = (inner > lowest) & (inner < highest) & (np.abs(inner) >= HALF_BAND)
            number, value = np.flatnonzero(found) + first * inner[0].size, inner[found]
        rows = voxel_ijk, patches, lipschitz, sampled, decoded
        return _Block(rows, (number, value), summary, jumps)

    blocks = list(plane_blocks(grid.shape, planes_at_once(grid.samples)))
    yield from over_threads(look, blocks, threads)


def _count_jumps(rescaled: FloatArray, own: slice) -> NDArray[np.float64]:
    """Return a row for the outer and the inner side of an offset, (2, 3).

    It has the number of samples near the offset from which values jump up (on the inner side down)
    to a neighbour; the number of all samples near; and the farthest with a jump, in half voxels.
    Counted are those in planes ``own``, the planes beside only show whether there is a jump.
    """
    near, found = np.abs(rescaled[own]) < PATCH_LIMIT, []
    for side in (1, -1):
        jumps = np.zeros(rescaled.shape, bool)
        for axis in range(3):
            values, marks = np.moveaxis(rescaled, axis, 0), np.moveaxis(jumps, axis, 0)
            step = side * (values[1:] - values[:-1])
            marks[:-1] |= step > MIN_JUMP
            marks[1:] |= step < -MIN_JUMP
        jump = jumps[own] & near
        end = (side * rescaled[own][jump]).max(initial=-np.inf)
        found.append((jump.sum(), near.sum(), end))
    return np.array(found, np.float64)


def _check_offset(jumps: list[NDArray[np.float64] | None], grid: SdfGrid, offset: float) -> None:
    """Raise GridError if no sample is near an offset, or fill values begin within 2.5 voxels."""
    if not offset:
        return
    every = np.array(jumps)  # (blocks, 2, 3)
    if not every[:, 0, 1].any():
        raise no_surface(grid, offset)
    for side, part in ((1, every[:, 0]), (-1, every[:, 1])):
        (count, near, _), end = part.sum(0), part[:, 2].max()
        if count > MAX_JUMP_SHARE * near and end < FILL_MARGIN - UNSAMPLED:
            end = offset + side * end * grid.voxel_size / 2
            raise _too_near(grid, offset, end, FILL_MARGIN, outwards=side > 0)


def _too_near(
    grid: SdfGrid, offset: float, end: float, needed: float, *, outwards: bool
) -> GridError:
    """Return the error for distances that end (world units) within ``needed`` half voxels."""
    room = needed / 2 * grid.voxel_size
    limit, which = (end - room, "largest") if outwards else (end + room, "smallest")
    works = f"the {which} that works is {limit:.6g}" if limit * end > 0 else "only 0 works"
    return GridError(
        f"offset {offset:g} needs distances {needed / 2:g} spacings ({room:.6g}) to either side "
        f"of it, but they end at {end:.6g}: {works}"
    )
