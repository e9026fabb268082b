"""The band of a whole grid, found plane by plane: all that the steps need of the input.

The grid is read once, in blocks of planes, and a block is worked on in windows, so that little is
held beside the band. This takes 135 bytes per voxel, and 12 per sample beyond it, so it grows with
the surface, not with the grid. ``look_at_band`` reads a grid whose band is not kept: it is worked
on in bricks, or too large.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import chain, pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from ..errors import NoSurfaceError, OutOfMemoryError
from ..grid.cubic import Resampled, on_samples, sampled_places
from ..grid.field import Field
from ..grid.planes import (SampleArray, over_planes, planes_at_once, planes_too_large, reading_bytes, unpacked_bytes)
from ..grid.sdf_grid import SdfGrid, negated, without_samples
from ..machine.memory import held_memory, in_words
from ..threads import ONE_THREAD, Resources, chunks_of, over_threads
from ..network.neighbourhood import CENTRE, NEIGHBOURHOOD, STRIDES
from ..options import MASK
from .band import (BLOCK_PLANES, BLOCK_SAMPLES, BandSummary, Jumps, can_hold_surface, check_not_cut_off, check_not_filled, exact_samples, find_jumps, has_both_sides, is_active, is_filled_in, is_lipschitz, neighbour_table, pad_by_extrapolation, plane_blocks, rescale_planes, summarise, take_patches)
from .bounds import NONE_BEYOND, SamplesBeyond, TrustedSamples, samples_beyond

# Of a band: patches, indices and flags; what is made of them on the way; and of samples beyond it.
BYTES_PER_VOXEL, BYTES_BEYOND = 135, 12
BYTES_PER_SAMPLE = 20  # of the planes among which the band is found, measured
WINDOW_SAMPLES = 1 << 21  # among which the band is found at a time
APPENDED = 1 << 16  # rows at a time: fewer would be moved too often
FAR = 1e30  # half voxels: no sample of the band is there

BandPart: TypeAlias = tuple[IntArray, FloatArray, NDArray[np.int64], FloatArray]
"""Some of the band's voxels and their patches; numbers and values of samples beyond it."""

NO_VOXELS: tuple[IntArray, FloatArray] = np.empty((0, 3), np.int32), np.empty((0, 27), np.float32)


class BandTooLargeError(OutOfMemoryError):
    """The band of a grid does not fit in memory."""


@dataclass(frozen=True, eq=False)
class Band:
    """The active voxels of a grid (Eq. 2), their samples, and what these can be used for."""

    shape: tuple[int, int, int]  # samples of the grid along each axis
    voxel_ijk: IntArray  # (V, 3), the voxels, in C order
    patches: FloatArray  # (V, 27), the samples round each voxel, in half voxels
    lipschitz: BoolArray  # (V,), which patches can be distances
    decoded: BoolArray  # (V,), which voxels can hold the surface, and so are decoded
    exact: BoolArray  # (V,), which own samples can be taken as exact distances
    # samples beyond the band may be exact distances if they lie between these, in half voxels
    limits: tuple[float, float]
    # (V,), which own values are samples of a grid that was resampled; None if all are
    sampled: BoolArray | None = None
    # whether a sample on the border of the grid is inside: then the solid leaves the grid
    leaves: bool = False
    field: Field = field(default_factory=Field)  # what the values are
    half_voxel: float = 1.0  # half a spacing in world units, by which the values are divided
    level: float = 0.0  # what is zero then
    peak: int = 0  # the memory of the process in bytes while the band was found
    unpacked: int = 0  # bytes of a temporary file
    beyond: SamplesBeyond = NONE_BEYOND  # the samples a few voxels farther away

    @cached_property
    def trusted(self) -> TrustedSamples:
        """The samples whose spheres can be trusted, in the band and beyond."""
        sample = self.patches[:, CENTRE]
        return TrustedSamples(
            self.shape, self.voxel_ijk, sample, self.exact, self.beyond, self.limits
        )

    def count_noisy(self, rows: slice = slice(None)) -> int:
        """Count the voxels whose own samples differ from others by more than distances can."""
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
    held = held_memory() or 0
    planes, reading = plan_reading(grid.samples, held, resources)

    def read(block: tuple[int, int]) -> Block:
        around = grid.samples[max(block[0] - 1, 0) : block[1] + 1]
        found = look_at_block(grid, offset, around, block, is_checked=among is None)
        return found._replace(parts=list(found.parts))

    first, last = among or (0, grid.shape[0])
    blocks = list(plane_blocks(grid.shape, first, last, planes))
    jumps: list[tuple[Jumps, Jumps]] = []
    gathered, leaves, size = _Gathered(), False, reading
    for (_, end), found in zip(blocks, over_threads(read, blocks, resources.threads)):
        leaves, jumps = leaves or found.leaves, jumps + found.jumps
        size += sum(band_bytes(len(ijk), len(value)) for ijk, _, _, value in found.parts)
        if size > _room(resources.memory, held):
            raise BandTooLargeError(
                f"the band of the first {end:,} planes already takes {in_words(size)} of memory, "
                f"and {in_words(resources.memory or 0)} may be used in all; is this a distance "
                "field? If so, allow more (--max-memory)"
            )
        gathered.add(found.parts)
    if offset and among is None:
        check_jumps(jumps, grid, offset)
    band = make_band(grid, offset, gathered.all(), whole)
    vars(band).update(peak=held + size, leaves=leaves if whole is None else whole.leaves)
    return band


def band_bytes(voxels: int, beyond: int) -> int:
    """Return the bytes of a band of ``voxels`` voxels and ``beyond`` samples beyond it."""
    return voxels * BYTES_PER_VOXEL + beyond * BYTES_BEYOND


class _Gathered:
    """The parts of a band put together; each is freed when it was taken, so none is held twice."""

    def __init__(self) -> None:
        nothing = (*NO_VOXELS, NONE_BEYOND.number, NONE_BEYOND.value)
        self.arrays: list[NDArray[Any]] = [array.copy() for array in nothing]
        self.waiting: list[BandPart] = []

    def add(self, parts: list[BandPart]) -> None:
        """Take parts out of a list."""
        while parts:
            self.waiting.append(parts.pop(0))
            if sum(len(part[0]) + len(part[2]) for part in self.waiting) > APPENDED:
                self.all()

    def all(self) -> list[NDArray[Any]]:
        """Return the arrays of all parts."""
        for array, rows in zip(self.arrays, zip(*self.waiting)):
            count = len(array)
            array.resize((count + sum(map(len, rows)), *array.shape[1:]), refcheck=False)
            np.concatenate(rows, out=array[count:])
        self.waiting.clear()
        return self.arrays


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


def _room(bound: int | None, held: int) -> float:
    """Return how many bytes a bound leaves; if the process holds more than it, all of the bound."""
    if bound is None:
        return np.inf
    return bound - held if held < bound else bound


def make_band(
    grid: SdfGrid, offset: float, found: list[NDArray[Any]], whole: BandSummary | None = None
) -> Band:
    """Return the band of a grid: what is exact in it, and what is decoded.

    ``found`` are the arrays of a ``BandPart``; ``whole`` is of the band of the whole grid, if these
    are a part of it. In a resampled grid samples are trusted by samples alone: interpolated values
    do not tell whether the samples are noisy. Where they do not contradict others they count as
    exact, since thin parts need them (docs/guides/formats.md).
    """
    voxel_ijk, patches, number, value = found
    sample, lipschitz, sampled = patches[:, CENTRE], is_lipschitz(patches), None
    decoded = _is_decoded(grid.field, patches, lipschitz)
    if isinstance(grid.samples, Resampled):
        sampled, whole = on_samples(grid, voxel_ijk), None
        lipschitz[sampled] = is_lipschitz(patches[sampled], sampled_places(grid))
    whole = whole or summarise(sample, lipschitz if sampled is None else lipschitz[sampled])
    exact = exact_samples(patches, lipschitz, whole)
    low, high = _exact_between(grid, offset)
    return Band(
        grid.shape,
        voxel_ijk,
        patches,
        lipschitz,
        decoded,
        exact & (sample > low) & (sample < high),
        limits_beyond(grid, offset),
        sampled,
        field=grid.field,
        half_voxel=grid.voxel_size / 2,
        level=offset * 2 / grid.voxel_size,
        unpacked=unpacked_bytes(grid.samples),
        beyond=SamplesBeyond(number, value),
    )


def _is_decoded(kind: Field, patches: FloatArray, lipschitz: BoolArray) -> BoolArray:
    """Return which voxels of a field are decoded; of a mask those with samples on both sides."""
    if kind.smooth is not None:  # no distances: what they say of the voxels is not certain
        return np.ones(len(patches), bool)
    return has_both_sides(patches) if kind.kind == MASK else can_hold_surface(patches, lipschitz)


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


def outline(
    grid: SdfGrid, offset: float, threads: int, voxels: list[int], decoded: list[int]
) -> Band:
    """Return a band without its voxels, of which there are some in each plane, for a plan."""
    nothing: list[NDArray[Any]] = [*NO_VOXELS, NONE_BEYOND.number, NONE_BEYOND.value]
    band = make_band(grid, offset, nothing)
    _, reading = plan_reading(grid.samples, 0, Resources(threads))
    known = {"voxels_before": voxels, "decoded_before": decoded}
    vars(band).update({name: np.append(0, np.cumsum(counts)) for name, counts in known.items()})
    vars(band).update(exact=np.ones(1, bool), peak=(held_memory() or 0) + reading)  # some may be
    return band


class Block(NamedTuple):
    """What is found in a block of planes."""

    leaves: bool  # whether a sample on the grid's border is inside
    jumps: list[tuple[Jumps, Jumps]]  # with an offset
    parts: Any  # a list or an iterator of ``BandPart``, in C order


def look_at_block(
    grid: SdfGrid,
    offset: float,
    samples: NDArray[Any],
    planes: tuple[int, int],
    is_checked: bool = True,
) -> Block:
    """Return what is found in some planes, given their samples and those beside them.

    With an offset, the distances are checked for truncation, and their jumps are found, if it
    ``is_checked``.
    """
    low, high = max(planes[0] - 1, 0), min(planes[1] + 1, grid.shape[0])
    rescaled = rescale_planes(negated(samples) if grid.positive_inside else samples, grid, offset)
    unseen = None if grid.field.unseen is None else np.asarray(grid.field.unseen[low:high])
    sides = [rescaled[:, [0, -1]], rescaled[:, :, [0, -1]]]
    sides += [rescaled[0]] * (low == 0) + [rescaled[-1]] * (high == grid.shape[0])
    windows = list(_windows(rescaled.shape, slice(planes[0] - low, planes[1] - low)))
    is_checked = is_checked and offset != 0  # at 0 there is no better offset to suggest
    limits = limits_beyond(grid, offset)

    def parts() -> Iterator[BandPart]:
        for around, inner in windows:
            window = rescaled[around]
            own, hidden = window[inner], None if unseen is None else unseen[around][inner]
            if hidden is not None:
                own = np.where(hidden, np.float32(FAR), own)
            corner = np.array([low + around[0].start, around[1].start, 0])
            own_corner = corner + np.array([inner[0].start, inner[1].start, 0])
            first = int(np.ravel_multi_index(own_corner.tolist(), grid.shape))
            beyond = samples_beyond(own, first, limits)
            yield *NO_VOXELS, beyond.number, beyond.value
            for ijk, patches in _patches_of(window, inner, hidden):
                if is_checked:
                    check_not_cut_off(patches, offset, grid.voxel_size)
                voxel_ijk = (ijk + corner).astype(np.int32)
                yield voxel_ijk, patches, NONE_BEYOND.number, NONE_BEYOND.value

    return Block(
        any(bool((side <= 0).any()) for side in sides),
        [find_jumps(rescaled[around], inner) for around, inner in windows if is_checked],
        parts(),
    )


Window: TypeAlias = tuple[slice, slice]
"""Some planes, and some rows of each."""


def _windows(shape: tuple[int, ...], own: slice) -> Iterator[tuple[Window, Window]]:
    """Yield what is worked on at a time in the ``own`` planes of a block, in C order.

    It is all of them, or, of large ones, some rows of each: the window with the samples beside
    them, and where they are in it.
    """
    blocks, step = [own], shape[1]
    if np.prod(shape, dtype=float) > WINDOW_SAMPLES:
        blocks = [slice(i, i + 1) for i in range(own.start, own.stop)]
        step = max(WINDOW_SAMPLES // (3 * shape[2]) - 2, 1)
    for planes in blocks:
        for start in range(0, shape[1], step):
            stop, low = min(start + step, shape[1]), max(start - 1, 0)
            before = max(planes.start - 1, 0)
            inner = slice(planes.start - before, planes.stop - before)
            around = slice(before, planes.stop + 1), slice(low, stop + 1)
            yield around, (inner, slice(start - low, stop - low))


def _patches_of(
    window: FloatArray, inner: Window, hidden: BoolArray | None = None
) -> Iterator[tuple[NDArray[np.int64], FloatArray]]:
    """Yield active voxels of a window that are not ``hidden``, nor filled in, and their patches."""
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


def no_surface(grid: SdfGrid, offset: float) -> NoSurfaceError:
    """Return the error for a grid without a surface at an offset."""
    return NoSurfaceError(
        f"no surface at {offset:g}: the values go from {grid.low:.6g} to {grid.high:.6g}"
    )


def count_crossings(patches: FloatArray) -> int:
    """Count the pairs of samples next to each other along an axis with the surface between."""
    inside = patches[:, CENTRE] <= 0
    return sum(
        int(np.count_nonzero(inside != (patches[:, CENTRE + step] <= 0))) for step in STRIDES
    )


def check_jumps(jumps: list[tuple[Jumps, Jumps]], grid: SdfGrid, offset: float) -> None:
    """Raise GridError if no sample is near an offset, or fill values begin near it."""
    if not any(up.near for up, _ in jumps):
        raise no_surface(grid, offset)
    check_not_filled(jumps, offset, grid.voxel_size)


class Glance(NamedTuple):
    """What is seen of the band in some planes, without keeping it."""

    summary: BandSummary
    voxels: list[int]  # of each plane
    decoded: list[int]  # of each plane
    beyond: int  # samples beyond the band that can be exact
    crossings: int  # see ``count_crossings``
    jumps: list[tuple[Jumps, Jumps]]  # with an offset


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
    parts = list(over_planes(samples, partial(_glance, known, offset), ranges))
    summaries, voxels, decoded, beyond, crossings, jumps = zip(*parts)
    all_jumps = list(chain(*jumps))
    if offset:
        check_jumps(all_jumps, grid, offset)
    counts = list(chain(*voxels)), list(chain(*decoded)), sum(beyond), sum(crossings)
    return Glance(_of_all(summaries), *counts, all_jumps)


def _of_all(summaries: Sequence[BandSummary]) -> BandSummary:
    return BandSummary(
        sum(part.voxels for part in summaries),
        sum(part.noisy for part in summaries),
        min(part.low for part in summaries),
        max(part.high for part in summaries),
        any(part.leaves for part in summaries),
    )


def _glance(grid: SdfGrid, offset: float, planes: NDArray[Any], inner: tuple[int, int]) -> Glance:
    """Return what is seen in the planes ``inner``, given with those beside them."""
    block = look_at_block(grid, offset, planes, inner)
    voxels, decoded = np.zeros((2, inner[1] - inner[0]), np.int64)
    beyond = crossings = 0
    summaries: list[BandSummary] = []
    for ijk, patches, _, value in block.parts:
        lipschitz, plane = is_lipschitz(patches), ijk[:, 0] - inner[0]
        is_decoded = _is_decoded(grid.field, patches, lipschitz)
        voxels += np.bincount(plane, minlength=len(voxels))
        decoded += np.bincount(plane[is_decoded], minlength=len(voxels))
        beyond, crossings = beyond + len(value), crossings + count_crossings(patches)
        summaries.append(summarise(patches[:, CENTRE], lipschitz, block.leaves))
    summary = _of_all(summaries)
    return Glance(summary, voxels.tolist(), decoded.tolist(), beyond, crossings, block.jumps)
