"""The band of a whole grid, found plane by plane: all that the steps need of the input.

The grid is read once. The band takes 145 bytes per voxel, with the samples beyond it, so it grows
with the surface, not with the grid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from ..errors import NoSurfaceError, OutOfMemoryError
from ..grid.cubic import on_samples, sampled_places
from ..grid.field import EXACT, MASK
from ..grid.planes import (
    DerivedPlanes,
    SampleArray,
    planes_at_once,
    reading_bytes,
)
from ..grid.resampling import Resampled
from ..grid.sdf_grid import SdfGrid, negated
from ..grid.unknown import KnownPlanes
from ..machine.memory import held_memory, in_words
from ..machine.resources import ONE_THREAD, Resources
from ..machine.threads import map_threads
from ..neighbourhood import CENTRE, STRIDES
from .band import (
    BLOCK_PLANES,
    BLOCK_SAMPLES,
    can_hold_surface,
    find_band,
    gather_patches,
    is_lipschitz,
    neighbour_table,
    plane_blocks,
    rescale_planes,
)
from .beyond import NONE_BEYOND, SamplesBeyond, TrustedSamples, joined, samples_beyond
from .exact import BandSummary, exact_samples
from .offsets import Jumps, check_not_cut_off, check_not_filled, find_jumps

BYTES_PER_VOXEL = 145  # of a band, with the samples beyond it: some two for a voxel
BYTES_PER_SAMPLE = 20  # of the planes among which the band is found, measured
FAR = 1e30  # half voxels: no sample of the band is there

Found: TypeAlias = tuple[IntArray, FloatArray, SamplesBeyond]
"""The band's voxels in some planes, their patches, and the samples beyond it."""


@dataclass(frozen=True, eq=False)
class Band:
    """The active voxels of a grid (Eq. 2), their samples, and what these can be used for.

    Attributes
    ----------
    shape : three ints
        Samples of the grid along each axis.
    voxel_ijk : (V, 3) int32
        The voxels, in C order.
    patches : (V, 27) float32
        The samples round each voxel, in half voxels.
    lipschitz : (V,) bool
        Which patches can be distances.
    decoded : (V,) bool
        Which voxels can hold the surface, and so are decoded.
    exact : (V,) bool
        Which voxels' own samples can be taken as exact distances.
    limits : two floats
        Samples beyond the band may be exact distances if they lie between these, in half voxels.
    sampled : (V,) bool, optional
        Which voxels' own values are samples of a grid that was resampled, not interpolated; None if
        all are.
    leaves : bool
        Whether a sample on the border of the grid is inside: then the solid leaves the grid.
    kind : str
        What the field is, see ``grid.field``.
    smooth : array or Planes, optional
        Values whose cubic spline has the surface where they are smooth, in world units.
    has_kinks : bool
        Whether the network may refine that field where it is not smooth.
    half_voxel, level : float
        Half a spacing in world units, by which these are divided; and what is zero then.
    peak : int
        The memory of the process in bytes while the band was found, of samples that are made.
    beyond : SamplesBeyond
        The samples a few voxels farther away.
    """

    shape: tuple[int, int, int]
    voxel_ijk: IntArray
    patches: FloatArray
    lipschitz: BoolArray
    decoded: BoolArray
    exact: BoolArray
    limits: tuple[float, float] = (0.0, 0.0)
    sampled: BoolArray | None = None
    leaves: bool = False
    kind: str = EXACT
    smooth: SampleArray | None = None
    has_kinks: bool = False
    half_voxel: float = 1.0
    level: float = 0.0
    peak: int = 0
    beyond: SamplesBeyond = NONE_BEYOND

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
        return slice(0, len(self.voxel_ijk))

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
        return np.append(0, np.cumsum(self.decoded))[self.voxels_before]

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

        Parameters
        ----------
        seen : slice, optional
            Rows of the n voxels that the network sees; all by default.
        decoded : slice, optional
            Rows of which the voxels that can hold the surface are decoded; all by default.

        Returns
        -------
        (n, 27) float32, (n, 27) int32, (d,) int32
            The second and the third are row numbers within ``seen``.
        """
        seen, decoded = seen or self.all_rows, decoded or self.all_rows
        table = neighbour_table(*_crop_planes(self.voxel_ijk[seen], self.shape))
        voxels = np.flatnonzero(self.decoded[decoded]) + decoded.start - seen.start
        return self.patches[seen], table, voxels.astype(np.int32)


def _crop_planes(
    voxel_ijk: IntArray, shape: tuple[int, int, int]
) -> tuple[IntArray, tuple[int, ...]]:
    """Return voxels counted from the first plane that has any, and the shape up to the last one."""
    first, last = int(voxel_ijk[0, 0]), int(voxel_ijk[-1, 0])
    return voxel_ijk - np.array([first, 0, 0], np.int32), (last - first + 1, *shape[1:])


def survey(
    grid: SdfGrid,
    offset: float = 0.0,
    resources: Resources = ONE_THREAD,
    among: tuple[int, int] | None = None,
    whole: BandSummary | None = None,
) -> Band:
    """Read a grid once and return its band.

    Parameters
    ----------
    grid : SdfGrid
        Signed distances in world units, with the same spacing on all axes: see ``cubic_grid``.
    offset : float
        Distance of the surface in world units, positive outwards.
    resources : Resources
        The threads and memory that the run may use.
    among : two ints, optional
        Look only among planes from the first to before the second, and do not check the offset.
    whole : BandSummary, optional
        What ``look_at_band`` says of the whole grid; needed with ``among``.

    Raises
    ------
    GridError
        If the distances end too near the offset.
    OutOfMemoryError
        As soon as the part of the band read so far exceeds the memory bound.
    """
    sizes: list[int] = []
    jumps: list[tuple[Jumps, Jumps]] = []
    leaving: list[bool] = []
    held = held_memory() or 0

    def read(planes: slice) -> Found:
        found = _band_of_planes(
            grid, offset, planes.start, planes.stop, jumps if among is None else None, leaving
        )
        sizes.append(len(found[0]))
        _check_bound(sum(sizes), planes.stop, held, resources.memory)
        return found

    planes, reading = plan_reading(grid.samples, held, resources)
    first, last = among or (0, grid.shape[0])
    blocks = [slice(*block) for block in plane_blocks(grid.shape, first, last, planes)]
    parts = map_threads(read, blocks, resources.threads)
    voxel_ijk = np.concatenate([ijk for ijk, _, _ in parts])
    patches, beyond = [part for _, part, _ in parts], joined([part for _, _, part in parts])
    del parts
    if offset and among is None:
        check_jumps(jumps, grid, offset)
    band = make_band(grid.shape, voxel_ijk, _concatenate(patches), resources.threads, whole)
    if isinstance(grid.samples, Resampled):
        band = look_at_samples(band, grid, resources.threads)
    peak = held + reading + len(voxel_ijk) * BYTES_PER_VOXEL if reading else 0
    leaves = any(leaving) if whole is None else whole.leaves
    band = replace(band, leaves=leaves, peak=peak, beyond=beyond)
    return limit_to_field(band, grid, offset)


def plan_reading(samples: SampleArray, held: int, resources: Resources) -> tuple[int, int]:
    """Return how many planes to make at a time, and the bytes that this takes, beside those held.

    It is 0 for samples that are read and not made of others, since it is little.

    Raises
    ------
    OutOfMemoryError
        If they do not fit in memory even plane by plane.
    """
    if not isinstance(samples, (DerivedPlanes, KnownPlanes)):
        return BLOCK_PLANES, 0
    plane, need = samples.shape[1] * samples.shape[2], 0
    for least in (planes_at_once(samples), BLOCK_PLANES, 1):
        planes = min(max(BLOCK_SAMPLES // plane, least), len(samples))
        each = reading_bytes(samples, planes + 2) + planes * plane * BYTES_PER_SAMPLE
        need = min(resources.threads, -(-len(samples) // planes)) * each
        room = np.inf if resources.memory is None else resources.memory - held
        if need <= (room if least == 1 else room / 2):  # the band needs room, too
            return least, need
    raise OutOfMemoryError(
        f"making distances of the values needs {in_words(held + need)} of memory even plane by "
        f"plane, {in_words(resources.memory or 0)} may be used; allow more (--max-memory)"
    )


def limit_to_field(band: Band, grid: SdfGrid, offset: float) -> Band:
    """Return the band of a grid of any kind: what is exact in it, and what is decoded.

    In a mask, only the voxels round which samples lie on both sides hold the surface.
    """
    field, scale = grid.field, 2 / grid.voxel_size
    low, high = ((limit - offset) * scale for limit in field.exact)
    ends = np.clip([grid.low - offset, grid.high - offset], -FAR / scale, FAR / scale) * scale
    lowest, highest = map(float, ends.astype(np.float32))  # where it may be cut off
    if band.sampled is None:  # of a resampled grid, what is interpolated there promises little
        band = replace(band, limits=(max(low, lowest), min(high, highest)))
    if field.kind == EXACT:
        return band
    sample = band.patches[:, CENTRE]
    exact = band.exact & (sample > low) & (sample < high)
    decoded = band.decoded
    if field.kind == MASK:
        decoded = ((band.patches > 0) != (sample > 0)[:, None]).any(1)
    if field.smooth is not None:  # no distances: what they say of the voxels is not certain
        decoded = np.ones_like(band.decoded)
    band = replace(band, exact=exact, decoded=decoded, kind=field.kind, smooth=field.smooth)
    level = offset * scale
    return replace(band, has_kinks=field.has_kinks, half_voxel=1 / scale, level=level)


def _check_bound(voxels: int, planes: int, held: int, bound: int | None) -> None:
    """Raise if ``voxels`` of the band do not fit in the memory bound, beside the bytes ``held``.

    If the process held more than the bound before, only the band itself is compared with the bound.
    """
    need = voxels * BYTES_PER_VOXEL
    if bound is not None and need > (bound - held if held < bound else bound):
        raise OutOfMemoryError(
            f"the band of the first {planes:,} planes already has {voxels:,} voxels, which take "
            f"{in_words(need)} of memory, and {in_words(bound)} may be used in all; is this a "
            "distance field? If so, allow more (--max-memory)"
        )


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
    others they count as exact, since thin parts need them (docs/placement.md).
    """
    sampled, lipschitz = on_samples(grid, band.voxel_ijk), band.lipschitz.copy()
    lipschitz[sampled] = is_lipschitz(band.patches[sampled], sampled_places(grid))
    exact = exact_samples(band.patches, lipschitz, threads, sampled)
    return replace(band, lipschitz=lipschitz, exact=exact, sampled=sampled)


def _band_of_planes(
    grid: SdfGrid,
    offset: float,
    first: int,
    last: int,
    jumps: list[tuple[Jumps, Jumps]] | None,
    leaving: list[bool],
) -> Found:
    """Return what is found in planes ``first`` to before ``last``.

    One more plane is read on either side. Whether a sample on the grid's border is inside is
    appended to ``leaving``. With an offset, the distances are checked for truncation, and their
    jumps are appended to ``jumps``, if it is a list.
    """
    low, high = max(first - 1, 0), min(last + 1, grid.shape[0])
    samples = grid.samples[low:high]
    return band_of_samples(grid, offset, samples, first, last, jumps, leaving)


def band_of_samples(
    grid: SdfGrid,
    offset: float,
    samples: NDArray[Any],
    first: int,
    last: int,
    jumps: list[tuple[Jumps, Jumps]] | None,
    leaving: list[bool],
) -> Found:
    """Return the same for samples of these planes and of those beside them."""
    low, high = max(first - 1, 0), min(last + 1, grid.shape[0])
    planes = negated(samples) if grid.positive_inside else samples
    rescaled = rescale_planes(planes, grid.voxel_size, offset)
    leaving.append(_has_inside_on_border(rescaled, low == 0, high == grid.shape[0]))
    ijk = find_band(rescaled)
    own = ijk[(ijk[:, 0] >= first - low) & (ijk[:, 0] < last - low)]
    patches = gather_patches(rescaled, own)
    if offset and jumps is not None:  # at 0 there is no better offset to suggest
        check_not_cut_off(patches, offset, grid.voxel_size)
        jumps.append(find_jumps(rescaled))
    beyond = samples_beyond(rescaled[first - low : last - low], first)
    return own + np.array([low, 0, 0], np.int32), patches, beyond


def check_jumps(found: list[tuple[Jumps, Jumps]], grid: SdfGrid, offset: float) -> None:
    """Raise GridError if no sample is near an offset, or fill values begin near it."""
    if not any(up.near for up, _ in found):
        raise no_surface(grid, offset)
    check_not_filled(found, offset, grid.voxel_size)


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


def _concatenate(parts: list[FloatArray]) -> FloatArray:
    """Concatenate arrays (n, 27) and empty the list on the way, so that little is held twice."""
    joined = np.empty((sum(map(len, parts)), 27), np.float32)
    start = len(joined)
    while parts:
        part = parts.pop()
        start -= len(part)
        joined[start : start + len(part)] = part
    return joined
