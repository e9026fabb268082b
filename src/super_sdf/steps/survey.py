"""The band of a whole grid, found plane by plane: all that the steps need of the input.

The grid is read once, in blocks of planes, and a block is worked on in windows, so that little is
held beside the band. This takes 135 bytes per voxel, and 12 per sample beyond it, so it grows with
the surface, not with the grid. ``look_at_band`` reads a grid whose band is not kept: it is worked
on in bricks, or too large.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain, pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from ..errors import NoSurfaceError, OutOfMemoryError
from ..grid.cubic import Resampled, on_samples, sampled_places
from ..grid.planes import (
    SampleArray,
    over_planes,
    planes_at_once,
    planes_too_large,
    reading_bytes,
    unpacked_bytes,
)
from ..grid.sdf_grid import SdfGrid, negated, without_samples
from ..machine.memory import held_memory, in_words
from ..machine.resources import ONE_THREAD, Resources, chunks_of, over_threads
from ..neighbourhood import CENTRE, NEIGHBOURHOOD, STRIDES
from ..options import EXACT, MASK
from .band import (
    BLOCK_PLANES,
    BLOCK_SAMPLES,
    BandSummary,
    Jumps,
    can_hold_surface,
    check_not_cut_off,
    check_not_filled,
    exact_samples,
    find_jumps,
    has_both_sides,
    is_active,
    is_filled_in,
    is_lipschitz,
    neighbour_table,
    pad_by_extrapolation,
    plane_blocks,
    rescale_planes,
    summarise,
    take_patches,
)
from .bounds import NONE_BEYOND, SamplesBeyond, TrustedSamples, samples_beyond

# Of a band: patches, indices and flags; what is made of them on the way; and of samples beyond it.
BYTES_PER_VOXEL, BYTES_BEYOND = 135, 12
BYTES_PER_SAMPLE = 20  # of the planes among which the band is found, measured
WINDOW_SAMPLES = 1 << 21  # among which the band is found at a time
APPENDED = 1 << 16  # rows at a time: fewer would be moved too often
FAR = 1e30  # half voxels: no sample of the band is there

BandPart: TypeAlias = tuple[IntArray, FloatArray, NDArray[np.int64], FloatArray]
"""Some of the band's voxels and their patches; numbers and values of samples beyond it."""

NONE_ACTIVE: tuple[IntArray, FloatArray] = np.empty((0, 3), np.int32), np.empty((0, 27), np.float32)


class BandTooLargeError(OutOfMemoryError):
    """The band of a grid does not fit in memory."""


@dataclass(frozen=True, eq=False)
class Band:
    """The active voxels of a grid (Eq. 2), their samples, and what these can be used for."""

    shape: tuple[int, int, int]  # samples of the grid along each axis
    voxel_ijk: IntArray  # (V, 3), the voxels, in C order
    patches: FloatArray  # (V, 27), the samples round each voxel, in half voxels
    # lipschitz, decoded, exact: (V,), which patches can be distances; which voxels can hold the
    # surface, and so are decoded; which own samples can be taken as exact distances
    lipschitz: BoolArray
    decoded: BoolArray
    exact: BoolArray
    # samples beyond the band may be exact distances if they lie between these, in half voxels
    limits: tuple[float, float] = (0.0, 0.0)
    # (V,), which own values are samples of a grid that was resampled; None if all are
    sampled: BoolArray | None = None
    # whether a sample on the border of the grid is inside: then the solid leaves the grid
    leaves: bool = False
    kind: str = EXACT  # what the field is, see ``grid.field``
    # smooth, is_uneven, has_kinks: the field that is meshed by its cubic spline, in world units;
    # whether it is interpolated linearly where it jumps; and whether the network may refine it
    # where it is not smooth
    smooth: SampleArray | None = None
    is_uneven: bool = False
    has_kinks: bool = False
    # half_voxel, level: half a spacing in world units, by which these are divided; and what is zero
    # then
    half_voxel: float = 1.0
    level: float = 0.0
    # peak, unpacked: the memory of the process in bytes while the band was found; those of a
    # temporary file
    peak: int = 0
    unpacked: int = 0
    beyond: SamplesBeyond = NONE_BEYOND  # the samples a few voxels farther away
    unseen: SampleArray | None = None  # the samples at which the surface ends, see ``Field``

    @cached_property
    def trusted(self) -> TrustedSamples:
        """The samples whose spheres can be trusted, in the band and beyond."""
        sample = self.patches[:, CENTRE]
        return TrustedSamples(
            self.shape, self.voxel_ijk, sample, self.exact, self.beyond, self.limits
        )

    @property
    def noisy_voxels(self) -> int:
        """The number of voxels whose own samples differ from others by more than distances can."""
        return self.count_noisy(self.all_rows)

    def count_noisy(self, rows: slice) -> int:
        """Return the number of noisy voxels among some rows."""
        noisy = ~self.lipschitz if self.sampled is None else ~self.lipschitz & self.sampled
        return int(np.count_nonzero(noisy[rows]))

    @property
    def all_rows(self) -> slice:
        """The rows of all voxels."""
        return slice(0, int(self.voxels_before[-1]))

    def rows(self, first: int, last: int) -> slice:
        """Return the rows of the voxels in planes ``first`` to before ``last``."""
        low, high = max(first, 0), min(last, self.shape[0])
        return slice(int(self.voxels_before[low]), int(self.voxels_before[high]))

    @cached_property
    def voxels_before(self) -> NDArray[np.int64]:
        """The number of voxels before each plane, and that of all voxels, (nx + 1,)."""
        return np.searchsorted(self.voxel_ijk[:, 0], np.arange(self.shape[0] + 1))

    @cached_property
    def decoded_before(self) -> NDArray[np.int64]:
        """The number of decoded voxels before each plane, and that of all, (nx + 1,)."""
        counts = [self.decoded[a:b].sum() for a, b in pairwise(self.voxels_before)]
        return np.append(0, np.cumsum(counts, dtype=np.int64))

    def count_decoded(self, rows: slice) -> int:
        """Return the number of decoded voxels among ``rows``, which must be whole planes."""
        first, last = np.searchsorted(self.voxels_before, [rows.start, rows.stop])
        return int(self.decoded_before[last] - self.decoded_before[first])

    def count_crossings(self) -> int:
        """Count the pairs of samples next to each other along an axis with the surface between."""
        inside = self.patches[:, CENTRE] <= 0
        return sum(
            int(np.count_nonzero(inside != (self.patches[:, CENTRE + step] <= 0)))
            for step in STRIDES
        )

    def network_inputs(
        self, seen: slice | None = None, decoded: slice | None = None
    ) -> tuple[FloatArray, IntArray, IntArray]:
        """Return the network's inputs: patches, neighbour table, and the voxels to decode.

        They are those of the rows that the network sees, all by default, and of those that are
        decoded: (n, 27) float32, (n, 27) int32, (d,) int32, row numbers within ``seen``.
        """
        seen, decoded = seen or self.all_rows, decoded or self.all_rows
        voxel_ijk = self.voxel_ijk[seen]
        first, last = int(voxel_ijk[0, 0]), int(voxel_ijk[-1, 0])  # the others have none
        within = voxel_ijk - np.array([first, 0, 0], np.int32)
        table = neighbour_table(within, (last - first + 1, *self.shape[1:]))
        voxels = np.flatnonzero(self.decoded[decoded]) + decoded.start - seen.start
        return self.patches[seen], table, voxels.astype(np.int32)


def survey(
    grid: SdfGrid,
    offset: float = 0.0,
    resources: Resources = ONE_THREAD,
    among: tuple[int, int] | None = None,
    whole: BandSummary | None = None,
) -> Band:
    """Read a grid once and return its band; BandTooLargeError as soon as it exceeds the memory.

    With ``among``, only these planes are looked at, the offset is not checked, and ``whole`` is
    what ``look_at_band`` says of the whole grid.
    """
    sizes: list[int] = []
    jumps: list[tuple[Jumps, Jumps]] = []
    leaving: list[bool] = []
    held = held_memory() or 0
    planes, reading = plan_reading(grid.samples, held, resources)

    def read(block: tuple[int, int]) -> list[BandPart]:
        seen = jumps if among is None else None
        around = slice(max(block[0] - 1, 0), block[1] + 1)
        parts = list(band_of_samples(grid, offset, grid.samples[around], block, seen, leaving))
        sizes.append(sum(band_bytes(len(ijk), len(value)) for ijk, _, _, value in parts))
        if sum(sizes) + reading > _room(resources.memory, held):
            raise BandTooLargeError(
                f"the band of the first {block[1]:,} planes already takes "
                f"{in_words(sum(sizes) + reading)} of memory, and "
                f"{in_words(resources.memory or 0)} may be used in all; is this a distance field? "
                "If so, allow more (--max-memory)"
            )
        return parts

    first, last = among or (0, grid.shape[0])
    blocks = list(plane_blocks(grid.shape, first, last, planes))
    voxel_ijk, patches, number, value = _put_together(over_threads(read, blocks, resources.threads))
    if offset and among is None:
        check_jumps(jumps, grid, offset)
    band = make_band(grid.shape, voxel_ijk, patches, resources.threads, whole)
    if isinstance(grid.samples, Resampled):
        band = look_at_samples(band, grid, resources.threads)
    leaves = any(leaving) if whole is None else whole.leaves
    beyond = SamplesBeyond(number, value)
    peak, unpacked = held + reading + sum(sizes), unpacked_bytes(grid.samples)
    band = replace(band, leaves=leaves, peak=peak, unpacked=unpacked, beyond=beyond)
    return limit_to_field(band, grid, offset)


def band_bytes(voxels: int, beyond: int) -> int:
    """Return the bytes of a band of ``voxels`` voxels and ``beyond`` samples beyond it."""
    return voxels * BYTES_PER_VOXEL + beyond * BYTES_BEYOND


def _put_together(blocks: Iterable[list[BandPart]]) -> BandPart:
    """Return what was found in all blocks, as one.

    The arrays grow, and each part is freed when it was taken, so that nothing is held twice.
    """
    voxel_ijk, patches = NONE_ACTIVE
    number, value = NONE_BEYOND.number, NONE_BEYOND.value
    whole: BandPart = (voxel_ijk.copy(), patches.copy(), number.copy(), value.copy())
    waiting: list[BandPart] = []
    for parts in blocks:
        while parts:
            waiting.append(parts.pop(0))
            if sum(len(part[0]) + len(part[2]) for part in waiting) > APPENDED:
                _append(whole, waiting)
    _append(whole, waiting)
    return whole


def _append(whole: BandPart, parts: list[BandPart]) -> None:
    """Append parts to what was found, and empty the list."""
    arrays: tuple[NDArray[Any], ...] = whole
    for array, rows in zip(arrays, zip(*parts)):
        count = len(array)
        array.resize((count + sum(map(len, rows)), *array.shape[1:]), refcheck=False)
        np.concatenate(rows, out=array[count:])
    parts.clear()


def plan_reading(samples: SampleArray, held: int, resources: Resources) -> tuple[int, int]:
    """Return how many planes to read at a time, and the bytes that this takes, beside those held.

    OutOfMemoryError if they do not fit in memory even plane by plane.
    """
    plane, need = samples.shape[1] * samples.shape[2], 0
    for least in (planes_at_once(samples), BLOCK_PLANES, 1):
        planes = min(max(BLOCK_SAMPLES // plane, least), len(samples))
        around = (planes + 2) * plane
        copies = around * (samples.dtype.itemsize + 4)  # with another sign, and in half voxels
        windows = min(around, WINDOW_SAMPLES) * BYTES_PER_SAMPLE
        each = reading_bytes(samples, planes + 2) + copies + windows
        need = min(resources.threads, -(-len(samples) // planes)) * each
        room = _room(resources.memory, held)
        if need <= (room if least == 1 else room / 2):  # the band needs room, too
            return least, need
    raise planes_too_large(samples, held + need, resources.memory or 0)


def limit_to_field(band: Band, grid: SdfGrid, offset: float) -> Band:
    """Return the band of a grid of any kind: what is exact in it, and what is decoded.

    In a mask, only the voxels round which samples lie on both sides hold the surface.
    """
    field, scale = grid.field, 2 / grid.voxel_size
    level = offset * scale
    band = replace(band, limits=limits_beyond(grid, offset), unseen=field.unseen)
    if field.kind == EXACT:
        return band
    sample = band.patches[:, CENTRE]
    low, high = _exact_between(grid, offset)
    decoded = band.decoded
    if field.kind == MASK:
        decoded = has_both_sides(band.patches)
    if field.smooth is not None:  # no distances: what they say of the voxels is not certain
        decoded = np.ones_like(band.decoded)
    return replace(
        band,
        exact=band.exact & (sample > low) & (sample < high),
        decoded=decoded,
        kind=field.kind,
        smooth=field.smooth,
        has_kinks=field.has_kinks,
        is_uneven=field.is_uneven,
        half_voxel=1 / scale,
        level=level,
    )


def _exact_between(grid: SdfGrid, offset: float) -> tuple[float, float]:
    """Return the samples, in half voxels, between which those of a field can be exact."""
    scale = 2 / grid.voxel_size
    low, high = ((limit - offset) * scale for limit in grid.field.exact)
    return low, high


def limits_beyond(grid: SdfGrid, offset: float) -> tuple[float, float]:
    """Return between which samples those beyond the band can be exact, see ``Band.limits``."""
    if isinstance(grid.samples, Resampled):  # what is interpolated there promises little
        return 0.0, 0.0
    low, high = _exact_between(grid, offset)
    scale = 2 / grid.voxel_size
    ends = np.clip([grid.low - offset, grid.high - offset], -FAR / scale, FAR / scale) * scale
    lowest, highest = map(float, ends.astype(np.float32))  # where it may be cut off
    return max(low, lowest), min(high, highest)


def _room(bound: int | None, held: int) -> float:
    """Return how many bytes a bound leaves; if the process holds more than it, all of the bound."""
    if bound is None:
        return np.inf
    return bound - held if held < bound else bound


def outline(
    grid: SdfGrid, offset: float, threads: int, voxels: list[int], decoded: list[int]
) -> Band:
    """Return a band without its voxels, of which there are some in each plane, for a plan."""
    none = np.zeros(0, bool)
    band = limit_to_field(Band(grid.shape, *NONE_ACTIVE, none, none, none), grid, offset)
    _, reading = plan_reading(grid.samples, 0, Resources(threads))
    band = replace(
        band,
        exact=np.ones(1, bool),  # perhaps some are
        peak=(held_memory() or 0) + reading,
        unpacked=unpacked_bytes(grid.samples),
    )
    known = {"voxels_before": voxels, "decoded_before": decoded}
    vars(band).update({name: np.append(0, np.cumsum(counts)) for name, counts in known.items()})
    return band


def make_band(
    shape: tuple[int, int, int],
    voxel_ijk: IntArray,
    patches: FloatArray,
    threads: int = 1,
    whole: BandSummary | None = None,
) -> Band:
    """Return the band of voxels (V, 3) with patches (V, 27), in half voxels.

    ``whole`` is of the band of the whole grid, if this is a part of it.
    """
    lipschitz = is_lipschitz(patches)
    decoded = can_hold_surface(patches, lipschitz)
    exact = exact_samples(patches, lipschitz, threads, whole=whole)
    return Band(shape, voxel_ijk, patches, lipschitz, decoded, exact)


def look_at_samples(band: Band, grid: SdfGrid, threads: int = 1) -> Band:
    """Return the band of a resampled grid, in which samples are trusted by samples alone.

    Interpolated values do not tell whether the samples are noisy. Where they do not contradict
    others they count as exact, since thin parts need them (docs/guides/formats.md).
    """
    sampled, lipschitz = on_samples(grid, band.voxel_ijk), band.lipschitz.copy()
    lipschitz[sampled] = is_lipschitz(band.patches[sampled], sampled_places(grid))
    exact = exact_samples(band.patches, lipschitz, threads, sampled)
    return replace(band, lipschitz=lipschitz, exact=exact, sampled=sampled)


def band_of_samples(
    grid: SdfGrid,
    offset: float,
    samples: NDArray[Any],
    planes: tuple[int, int],
    jumps: list[tuple[Jumps, Jumps]] | None,
    leaving: list[bool],
) -> Iterator[BandPart]:
    """Yield what is found in some planes, in C order, given their samples and those beside them.

    Whether a sample on the grid's border is inside is appended to ``leaving``. With an offset, the
    distances are checked for truncation, and their jumps are appended to ``jumps``, if it is a
    list.
    """
    low, high = max(planes[0] - 1, 0), min(planes[1] + 1, grid.shape[0])
    samples = negated(samples) if grid.positive_inside else samples
    rescaled = rescale_planes(samples, grid.voxel_size, offset)
    del samples
    leaving.append(_has_inside_on_border(rescaled, low == 0, high == grid.shape[0]))
    limits, start = limits_beyond(grid, offset), np.array([low, 0, 0], np.int64)
    unseen = None if grid.field.unseen is None else np.asarray(grid.field.unseen[low:high])
    for block, rows in _windows(rescaled.shape, slice(planes[0] - low, planes[1] - low)):
        corner = np.array([max(block.start - 1, 0), max(rows.start - 1, 0), 0], np.int64)
        window = rescaled[corner[0] : block.stop + 1, corner[1] : rows.stop + 1]
        inner = _shifted(block, corner[0]), _shifted(rows, corner[1])
        if offset and jumps is not None:  # at 0 there is no better offset to suggest
            jumps.append(find_jumps(window, inner))
        number = ((low + block.start) * grid.shape[1] + rows.start) * grid.shape[2]
        mine = window[inner]
        hidden = None
        if unseen is not None:
            hidden = unseen[corner[0] :, corner[1] :][inner]
            mine = np.where(hidden, np.float32(FAR), mine)
        beyond = samples_beyond(mine, number, limits)
        yield *NONE_ACTIVE, beyond.number, beyond.value
        for ijk, patches in _patches_of(window, inner, hidden):
            if offset and jumps is not None:
                check_not_cut_off(patches, offset, grid.voxel_size)
            ijk += start + corner
            yield ijk.astype(np.int32), patches, NONE_BEYOND.number, NONE_BEYOND.value


def _shifted(range_: slice, start: int) -> slice:
    """Return a slice counted from ``start``."""
    return slice(range_.start - start, range_.stop - start)


def _windows(shape: tuple[int, ...], inner: slice) -> Iterator[tuple[slice, slice]]:
    """Yield the planes and rows of a block that are worked on at a time, in C order.

    They are the ``inner`` planes of it, of large ones some rows of each.
    """
    if np.prod(shape, dtype=float) <= WINDOW_SAMPLES:
        yield inner, slice(0, shape[1])
        return
    step = max(WINDOW_SAMPLES // (3 * shape[2]) - 2, 1)
    for i in range(inner.start, inner.stop):
        for first in range(0, shape[1], step):
            yield slice(i, i + 1), slice(first, min(first + step, shape[1]))


def _patches_of(
    window: FloatArray, inner: tuple[slice, slice], hidden: BoolArray | None = None
) -> Iterator[tuple[NDArray[np.int64], FloatArray]]:
    """Yield active voxels among some planes and rows of a window, and the samples round them.

    Those that are ``hidden``, of these planes and rows, and values that were filled in are left
    out.
    """
    active = is_active(window)[inner]
    if hidden is not None:
        active &= ~hidden
    voxels = np.flatnonzero(active)
    if not len(voxels):
        return
    first = np.array([inner[0].start, inner[1].start, 0])
    spans = [np.flatnonzero(active.any(axes)) for axes in ((1, 2), (0, 2), (0, 1))]
    low = np.maximum([span[0] for span in spans] + first - 1, 0)  # most of it is far from them
    high = [span[-1] for span in spans] + first + 2
    padded = pad_by_extrapolation(window[tuple(map(slice, low, high))])
    for rows in chunks_of(len(voxels), len(NEIGHBOURHOOD)):
        ijk = np.stack(np.unravel_index(voxels[rows], active.shape), 1) + first
        patches = take_patches(padded, ijk - low)
        kept = ~is_filled_in(patches)
        yield ijk[kept], patches[kept]


def check_jumps(jumps: list[tuple[Jumps, Jumps]], grid: SdfGrid, offset: float) -> None:
    """Raise GridError if no sample is near an offset, or fill values begin near it."""
    if not any(up.near for up, _ in jumps):
        raise no_surface(grid, offset)
    check_not_filled(jumps, offset, grid.voxel_size)


def _has_inside_on_border(rescaled: FloatArray, first: bool, last: bool) -> bool:
    """Return whether a sample on the border is inside, in planes with the first or last or not."""
    sides = [rescaled[:, [0, -1]], rescaled[:, :, [0, -1]]]
    ends = [rescaled[0]] * first + [rescaled[-1]] * last
    return any(bool((side <= 0).any()) for side in (*sides, *ends))


def no_surface(grid: SdfGrid, offset: float) -> NoSurfaceError:
    """Return the error for a grid without a surface at an offset."""
    return NoSurfaceError(
        f"no surface at {offset:g}: the values go from {grid.low:.6g} to {grid.high:.6g}"
    )


class Glance(NamedTuple):
    """What is seen of the band in some planes, without keeping it.

    Of each plane the voxels, and those that are decoded; the samples beyond the band that can be
    exact; see ``Band.count_crossings``; and, with an offset, the jumps.
    """

    summary: BandSummary
    voxels: list[int]
    decoded: list[int]
    beyond: int
    crossings: int
    jumps: list[tuple[Jumps, Jumps]]


def look_at_band(grid: SdfGrid, offset: float, planes: int = 0) -> Glance:
    """Return what the band of a grid says without keeping it, as if ``survey`` had read it.

    The planes are read where the samples are, see ``planes.over_planes``; by default at least as
    many at a time as are best.
    """
    count, samples = grid.shape[0], grid.samples
    planes = planes or max(planes_at_once(samples), BLOCK_PLANES)
    ranges = [
        (max(first - 1, 0), min(last + 1, count), (first, last))
        for first, last in plane_blocks(grid.shape, least=planes)
    ]
    # resampled ones are made here, and say so
    known = grid if isinstance(samples, Resampled) else without_samples(grid)
    look = partial(_glance, known, offset)
    parts = zip(*over_planes(samples, look, ranges))
    summaries, voxels, decoded, beyond, crossings, jumps = map(list, parts)
    all_jumps = list(chain(*jumps))
    if offset:
        check_jumps(all_jumps, grid, offset)
    counts = list(chain(*voxels)), list(chain(*decoded)), sum(beyond), sum(crossings)
    return Glance(_of_all(summaries), *counts, all_jumps)


def _of_all(summaries: list[BandSummary]) -> BandSummary:
    return BandSummary(
        sum(part.voxels for part in summaries),
        sum(part.noisy for part in summaries),
        min(part.low for part in summaries),
        max(part.high for part in summaries),
        any(part.leaves for part in summaries),
    )


def _glance(grid: SdfGrid, offset: float, planes: NDArray[Any], inner: tuple[int, int]) -> Glance:
    """Return what is seen in the planes ``inner``, given with those beside them."""
    jumps: list[tuple[Jumps, Jumps]] = []
    leaving: list[bool] = []
    first, last = inner
    voxels, decoded = np.zeros((2, last - first), np.int64)
    beyond = crossings = 0
    summaries: list[BandSummary] = []
    for ijk, patches, _, value in band_of_samples(grid, offset, planes, inner, jumps, leaving):
        lipschitz = is_lipschitz(patches)
        held = can_hold_surface(patches, lipschitz)
        band = limit_to_field(
            Band(grid.shape, ijk, patches, lipschitz, held, lipschitz), grid, offset
        )
        plane = ijk[:, 0] - first
        voxels += np.bincount(plane, minlength=last - first)
        decoded += np.bincount(plane[band.decoded], minlength=last - first)
        beyond, crossings = beyond + len(value), crossings + band.count_crossings()
        summaries.append(summarise(patches[:, CENTRE], lipschitz, leaving[0]))
    summary = _of_all(summaries)
    return Glance(summary, voxels.tolist(), decoded.tolist(), beyond, crossings, jumps)
