"""The band of a grid, found in one pass over its planes: all that the steps need of the input."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import CENTRE, BoolArray, FloatArray, IntArray
from ..errors import NoSurfaceError
from ..grid.field import Field
from ..grid.samples import let_go, planes_at_once
from ..grid.sdf_grid import SdfGrid, on_samples, sampled_places
from ..threads import over_threads
from .band import (
    Jumps,
    can_hold_surface,
    check_not_cut_off,
    check_not_filled,
    exact_samples,
    find_jumps,
    gather_patches,
    has_both_sides,
    is_active,
    is_filled_in,
    is_lipschitz,
    neighbour_table,
    plane_blocks,
    rescale,
)
from .bounds import TrustedSamples, samples_beyond

MAX_NOISY_SHARE = 0.02  # of all samples; in a noisier field no sample is taken as exact
FAR = 1e30  # half voxels: no sample of the band is there
CELLS = 64  # along the longest axis, of the counts by which a large grid is cut


@dataclass(frozen=True, eq=False)
class BandSummary:
    """What the band of a whole grid says, whichever part of the grid is worked on."""

    told: int  # voxels that tell by their samples whether the field is noisy
    noisy: int  # those of them round which samples differ by more than distances can
    low: float  # the lowest and the highest sample, in half voxels
    high: float
    leaves: bool  # whether a sample on the border of the grid is inside
    cells: NDArray[np.int64]  # (a, b, c), voxels of the band in cubes of ``side`` samples
    side: int

    @property
    def is_noisy(self) -> bool:
        """Whether no sample can be taken as exact."""
        return not self.told or self.noisy / self.told > MAX_NOISY_SHARE


class BandTooLargeError(Exception):
    """A band has more voxels than fit in memory."""


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
    trusted: TrustedSamples  # the samples whose spheres can be trusted, in the band and beyond
    # (V,), which own values are samples of a grid that was resampled; None if all are
    sampled: BoolArray | None = None
    # whether a sample on the border of the grid is inside: then the solid leaves the grid
    leaves: bool = False
    field: Field = field(default_factory=Field)  # what the values are
    half_voxel: float = 1.0  # half a spacing in world units, by which the values are divided
    level: float = 0.0  # what is zero then

    def count_noisy(self) -> int:
        """Count the voxels whose own samples differ from others by more than distances can."""
        noisy = ~self.lipschitz if self.sampled is None else ~self.lipschitz & self.sampled
        return int(np.count_nonzero(noisy))

    def network_inputs(self) -> tuple[FloatArray, IntArray, IntArray]:
        """Return the network's inputs: patches, neighbour table, and rows of decoded voxels."""
        table = neighbour_table(self.voxel_ijk, self.shape)
        return self.patches, table, np.flatnonzero(self.decoded).astype(np.int32)


class _Block(NamedTuple):
    """What is found in some planes of a grid."""

    voxel_ijk: IntArray  # of the band
    patches: FloatArray
    number: NDArray[np.int64]  # of samples beyond the band that can be exact, in C order ...
    value: FloatArray  # ... and their values
    leaves: bool  # whether a sample on the grid's border is inside
    jumps: tuple[Jumps, Jumps] | None  # up and down, with an offset


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
    blocks, count = list[_Block](), 0
    for block in _blocks(grid, offset, threads, is_checked=whole is None):
        blocks.append(block)
        count += len(block.voxel_ijk)
        if count > most:
            raise BandTooLargeError
    if offset and whole is None:
        _check_offset([block.jumps for block in blocks if block.jumps], grid, offset)
    leaves = any(block.leaves for block in blocks) if whole is None else whole.leaves
    voxel_ijk, patches = (np.concatenate([block[n] for block in blocks]) for n in (0, 1))
    number, value = (np.concatenate([block[n] for block in blocks]) for n in (2, 3))
    del blocks, block
    lipschitz, sampled = _tell_noise(grid, voxel_ijk, patches)
    if whole is None:
        whole = _summary(patches, lipschitz if sampled is None else lipschitz[sampled], leaves)
    sample, exact = patches[:, CENTRE], np.zeros(len(patches), bool)
    if not whole.is_noisy:
        low, high = _exact_between(grid, offset)
        exact = exact_samples(patches, lipschitz, (whole.low, whole.high))
        exact &= (sample > low) & (sample < high)
    limits = limits_beyond(grid, offset)
    return Band(
        grid.shape,
        voxel_ijk,
        patches,
        lipschitz,
        _is_decoded(grid.field, patches, lipschitz),
        exact,
        limits,
        TrustedSamples.of(grid.shape, voxel_ijk[exact], sample[exact], number, value, limits),
        sampled,
        leaves,
        grid.field,
        grid.voxel_size / 2,
        offset * 2 / grid.voxel_size,
    )


def summarise(grid: SdfGrid, offset: float = 0.0, threads: int = 1) -> BandSummary:
    """Return what the band of a cubic grid says, without keeping it; the grid is read once."""
    side = -(-max(grid.shape) // CELLS)
    cells = np.zeros([-(-n // side) for n in grid.shape], np.int64)
    jumps, parts = list[tuple[Jumps, Jumps]](), list[BandSummary]()
    for block in _blocks(grid, offset, threads):
        lipschitz, sampled = _tell_noise(grid, block.voxel_ijk, block.patches)
        told = lipschitz if sampled is None else lipschitz[sampled]
        parts.append(_summary(block.patches, told, block.leaves))
        place = np.ravel_multi_index(tuple((block.voxel_ijk // side).T), cells.shape)
        cells += np.bincount(place, minlength=cells.size).reshape(cells.shape)
        jumps += [block.jumps] if block.jumps else []
    if offset:
        _check_offset(jumps, grid, offset)
    return BandSummary(
        sum(part.told for part in parts),
        sum(part.noisy for part in parts),
        min(part.low for part in parts),
        max(part.high for part in parts),
        any(part.leaves for part in parts),
        cells,
        side,
    )


def no_surface(grid: SdfGrid, offset: float) -> NoSurfaceError:
    """Return the error for a grid without a surface at an offset."""
    return NoSurfaceError(
        f"no surface at {offset:g}: the values go from {grid.low:.6g} to {grid.high:.6g}"
    )


def limits_beyond(grid: SdfGrid, offset: float) -> tuple[float, float]:
    """Return between which samples those beyond the band can be exact, see ``Band.limits``."""
    if grid.on_sample is not None:  # what is interpolated there promises little
        return 0.0, 0.0
    low, high = _exact_between(grid, offset)
    scale = 2 / grid.voxel_size
    ends = np.clip([grid.low - offset, grid.high - offset], -FAR / scale, FAR / scale) * scale
    lowest, highest = map(float, ends.astype(np.float32))  # where it may be cut off
    return max(low, lowest), min(high, highest)


def _blocks(
    grid: SdfGrid, offset: float, threads: int, *, is_checked: bool = True
) -> Iterator[_Block]:
    """Yield what is found in the planes of a grid, in order.

    An offset is checked: the distances must not be cut off near it. At 0 no other one is better.
    """
    limits = limits_beyond(grid, offset)
    is_checked = is_checked and offset != 0

    def look(planes: tuple[int, int]) -> _Block:
        first, last = planes
        low, high = max(first - 1, 0), min(last + 1, grid.shape[0])
        rescaled = rescale(grid, offset, low, high)
        own = slice(first - low, last - low)
        inner, active = rescaled[own], is_active(rescaled)[own]
        if grid.field.unseen is not None:
            hidden = np.asarray(grid.field.unseen[first:last])
            inner, active = np.where(hidden, np.float32(FAR), inner), active & ~hidden
        sides = [rescaled[own, [0, -1]], rescaled[own, :, [0, -1]]]
        sides += [rescaled[0]] * (first == 0) + [rescaled[-1]] * (last == grid.shape[0])
        beyond = samples_beyond(inner, first * grid.shape[1] * grid.shape[2], limits)
        jumps = (find_jumps(rescaled, own), find_jumps(-rescaled, own)) if is_checked else None
        voxel_ijk, patches = _patches_of(rescaled, active, first - low)
        if is_checked:
            check_not_cut_off(patches, offset, grid.voxel_size)
        voxel_ijk[:, 0] += low
        let_go(grid.samples)
        leaves = any(bool((side <= 0).any()) for side in sides)
        return _Block(voxel_ijk, patches, *beyond, leaves, jumps)

    blocks = list(plane_blocks(grid.shape, least=planes_at_once(grid.samples)))
    yield from over_threads(look, blocks, threads)


def _patches_of(
    rescaled: FloatArray, active: BoolArray, before: int
) -> tuple[IntArray, FloatArray]:
    """Return the active voxels that are not filled in, as indices of some planes, and patches.

    ``active`` leaves out the planes that come ``before`` and after.
    """
    ijk = np.argwhere(active).astype(np.int32)
    if not len(ijk):
        return ijk, np.empty((0, 27), np.float32)
    ijk[:, 0] += before
    low, high = np.maximum(ijk.min(0) - 1, 0), ijk.max(0) + 2  # most of the planes is far away
    around = rescaled[tuple(slice(a, b) for a, b in zip(low, high))]
    patches = gather_patches(around, ijk - low)
    filled = is_filled_in(patches)
    return (ijk[~filled], patches[~filled]) if filled.any() else (ijk, patches)


def _check_offset(jumps: list[tuple[Jumps, Jumps]], grid: SdfGrid, offset: float) -> None:
    """Raise GridError if no sample is near an offset, or fill values begin near it."""
    up, down = zip(*jumps)
    if not any(near for _, near, _ in up):
        raise no_surface(grid, offset)
    check_not_filled(up, down, offset, grid.voxel_size)


def _tell_noise(
    grid: SdfGrid, voxel_ijk: IntArray, patches: FloatArray
) -> tuple[BoolArray, BoolArray | None]:
    """Return which patches can be distances, and, of a resampled grid, which voxels are samples.

    There, samples are judged by samples alone: interpolated values do not tell whether the samples
    are noisy. Where they do not contradict others they count as exact, since thin parts need them
    (docs/guides/formats.md).
    """
    lipschitz = is_lipschitz(patches)
    if grid.on_sample is None:
        return lipschitz, None
    sampled = on_samples(grid, voxel_ijk)
    lipschitz[sampled] = is_lipschitz(patches[sampled], sampled_places(grid))
    return lipschitz, sampled


def _summary(patches: FloatArray, told: BoolArray, leaves: bool) -> BandSummary:
    """Return the summary of a band; ``told`` is which telling patches can be distances."""
    sample, none = patches[:, CENTRE], np.empty((0, 0, 0), np.int64)
    low, high = float(sample.min(initial=np.inf)), float(sample.max(initial=-np.inf))
    noisy = len(told) - int(np.count_nonzero(told))
    return BandSummary(len(told), noisy, low, high, leaves, none, 0)


def _is_decoded(kind: Field, patches: FloatArray, lipschitz: BoolArray) -> BoolArray:
    """Return which voxels of a field are decoded; of a mask those with samples on both sides."""
    if kind.smooth is not None:  # no distances: what they say of the voxels is not certain
        return np.ones(len(patches), bool)
    return has_both_sides(patches) if kind.kind == "mask" else can_hold_surface(patches, lipschitz)


def _exact_between(grid: SdfGrid, offset: float) -> tuple[float, float]:
    """Return the samples, in half voxels, between which those of a field can be exact."""
    low, high = ((limit - offset) * 2 / grid.voxel_size for limit in grid.field.exact)
    return low, high
