"""The cubic lattice of a grid, on which the method works.

A grid with the same spacing on all axes is its own. Of others, the coarser axes are resampled to
the finest spacing, plane by plane. Masks, and fields that are meshed by their spline, need no
cubes: a solid stretched along an axis is as good a solid. They are refined as they are, and the
mesh gets its spacings at the end.

Between two neighbouring samples of a line the values are those of a cubic polynomial (Hermite). Its
slopes and its values obey the two laws of distances:

- The gradient has length 1. So the differences across the line, to both neighbours of a sample,
  tell how steep the field is along it: the slope is kept within what they allow. Near edges the two
  are different, and allow much.
- Two distances differ by no more than their points are apart. So the samples round a point bound
  its value from both sides (McShane, Whitney). It is kept within, unless they contradict each
  other, as those of a noisy field do.

The slope is also kept near the differences along the line, so that a linear field which is no
distance is reproduced. ``python -m lab figures --only kinds`` compares this with resampling by
hand.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, Triple
from ..errors import GridError
from ..arrays import NEIGHBOURHOOD
from .placement import EQUAL_SPACING
from .planes import SampleArray, SamplePlanes
from .sdf_grid import SdfGrid, with_fields

Floats = NDArray[np.float64]

NEAR = 3.5  # new spacings from the surface, up to which values are kept within their bounds
REACH = 4  # samples across the line, from which on they do not bound a value
OFFSETS = [(j, k) for j, k in product(range(-REACH, REACH + 1), repeat=2) if j * j + k * k <= 16]
MARGIN = 2.0  # the slope is as near to the mean of the differences along the line as they are
STEEP = 0.25  # the least slope with which a field falls towards a wall and rises behind it
EXTRA = 2  # samples beyond a cell, on either side, that its slopes depend on
ON_SAMPLE = 1e-3  # spacings from a sample, up to which a new sample takes its value
MOST = 1e12  # spacings: larger values are cut off, so that squares do not overflow
CHUNK = 1 << 18  # samples that are worked on at a time, about


def cubic_grid(grid: SdfGrid, offset: float = 0.0) -> SdfGrid:
    """Return a grid on the lattice that is refined: the same if it is cubic or ``on_lattice``.

    Other samples are made when they are read. Only values near the offset of the surface are as
    accurate as they can be. GridError if there is an offset, and the values are no distances.
    """
    if grid.is_cubic or grid.field.on_lattice:
        check_has_offsets(grid, offset)
        return grid
    if grid.field.unseen is not None:
        raise GridError(
            "samples beside the surface are unknown, and the spacing differs between axes: mesh "
            "the spline of the values (--field scaled)"
        )
    level = -offset if grid.positive_inside else offset
    samples, spacing = _resample(grid.samples, grid.spacing, level)
    coarser = " and ".join(
        f"{name} from {h:.6g}"
        for name, h in zip("xyz", grid.spacing)
        if h > grid.voxel_size * (1 + EQUAL_SPACING)
    )
    note = (
        f"the spacing differs between axes: the values are resampled along {coarser} to "
        f"{grid.voxel_size:.6g}, the finest, to {' x '.join(map(str, samples.shape))} samples"
    )
    known = [np.ones(count, bool) for count in samples.shape]
    part = samples
    while isinstance(part, Resampled):
        known[part.axis], part = part.on_sample, part.source
    more = {"notes": (*grid.notes, note), "on_sample": tuple(known)}
    return with_fields(grid, samples=samples, spacing=spacing, **more)


def check_has_offsets(grid: SdfGrid, offset: float) -> None:
    """Raise GridError if there is an offset, and no distances in the world to find it by."""
    if offset and grid.field.on_lattice and not grid.is_cubic:
        each = ", ".join(f"{h:g}" for h in grid.spacing)
        raise GridError(
            f"offset {offset:g}: the values are taken as {grid.field.kind}, and with the spacing "
            f"{each} they are no distances by which an offset surface could be found; mesh the "
            "solid itself (--offset 0), sample the mesh (super-sdf sample), and mesh that grid "
            "with the offset"
        )


def sampled_places(grid: SdfGrid) -> NDArray[np.intp]:
    """Return the places of ``NEIGHBOURHOOD`` that hold samples, too: across resampled axes."""
    across = np.ones(27, bool)
    for axis, known in enumerate(grid.on_sample or ()):
        if not known.all():
            across &= NEIGHBOURHOOD[:, axis] == 0
    return np.flatnonzero(across)


def on_samples(grid: SdfGrid, voxel_ijk: NDArray[np.int32]) -> BoolArray:
    """Return which values of a cubic grid, at (n, 3) indices, are samples, not interpolated."""
    known = np.ones(len(voxel_ijk), bool)
    for axis, sampled in enumerate(grid.on_sample or ()):
        known &= sampled[voxel_ijk[:, axis]]
    return known


def _resample(samples: SampleArray, spacing: Triple, level: float) -> tuple[SampleArray, Triple]:
    """Return samples at the finest spacing on all axes, and their spacing.

    The coarsest axis comes last: the finer the others are, the better they tell its slopes.
    """
    h, steps = min(spacing), list(spacing)
    for axis in np.argsort(spacing, kind="stable").tolist():
        if steps[axis] > h * (1 + EQUAL_SPACING):
            samples = Resampled(samples, (steps[0], steps[1], steps[2]), axis, h, level)
            steps[axis] = h
    return samples, (steps[0], steps[1], steps[2])


class Resampled(SamplePlanes):
    """Samples interpolated along one axis, from the first on, alike in whatever parts are read.

    ``level`` is the value at which the surface will be meshed. The new samples, at ``step``, lie at
    ``places``, in old spacings; those ``on_sample`` are old ones.
    """

    dtype = np.dtype(np.float64)
    name = "the resampled grid"

    def __init__(
        self, source: SampleArray, spacing: Triple, axis: int, step: float, level: float = 0.0
    ) -> None:
        self.source, self.spacing, self.axis = source, spacing, axis
        self.step, self.level = step, level
        self.places = new_places(source.shape[axis], spacing[axis], step)
        self.on_sample: BoolArray = np.rint(self.places) == self.places
        self.shape = tuple(
            len(self.places) if other == axis else count for other, count in enumerate(source.shape)
        )

    def read(self, first: int, last: int) -> Floats:
        """Return planes ``first`` to ``last`` (exclusive)."""
        out = np.empty((max(last - first, 0), *self.shape[1:]))
        if len(out) and self.axis == 0:
            self._read_between(first, out)
        elif len(out):
            self._read_within(first, out)
        return out

    def _read_between(self, first: int, out: Floats) -> None:
        places = self.places[first : first + len(out)]
        low = max(int(places[0]) - EXTRA, 0)
        block = np.asarray(self.source[low : int(places[-1]) + 2 + EXTRA])
        for rows in _chunks(out.shape[1], (len(out) + len(block)) * out.shape[2]):
            out[:, rows] = self._interpolate(block, rows, places - low, (1, 2))

    def _read_within(self, first: int, out: Floats) -> None:
        low = max(first - REACH, 0)
        block = np.asarray(self.source[low : first + len(out) + REACH])
        lines = np.moveaxis(block, self.axis, 0)
        for planes in _chunks(len(out), 2 * out[0].size):
            asked = slice(planes.start + first - low, planes.stop + first - low)
            values = self._interpolate(lines, asked, self.places, (0, 3 - self.axis))
            out[planes] = np.moveaxis(values, 0, self.axis)

    def _interpolate(
        self, block: NDArray[Any], asked: slice, places: Floats, across: tuple[int, int]
    ) -> Floats:
        """Return values on lines along the first axis of a block, ``asked`` of its second axis.

        ``across`` are the axes of the grid that are the second and the third of the block.
        """
        start = max(asked.start - REACH, 0)
        h = self.spacing[self.axis]
        samples = block[:, start : asked.stop + REACH].astype(np.float64, order="C")
        np.clip(samples, self.level - MOST * h, self.level + MOST * h, out=samples)
        asked = slice(asked.start - start, asked.stop - start)
        lines = Lines(samples, asked, h, (self.spacing[across[0]], self.spacing[across[1]]))
        return lines.values_at(places, self.level, NEAR * self.step)


class Lines:
    """Lines of samples (n, p, q), along the first axis, and the laws of distances on them.

    Only those ``asked`` of the second axis are interpolated; ``steps`` are the spacings across.
    """

    def __init__(self, samples: Floats, asked: slice, h: float, steps: tuple[float, float]) -> None:
        self.samples, self.asked, self.h, self.steps = samples, asked, h, steps
        self.around = np.pad(samples, ((0, 0), *((REACH, REACH),) * 2), constant_values=np.nan)

    def values_at(self, places: Floats, level: float, near: float) -> Floats:
        """Return the values (m, p, q) at places, within their bounds if ``near`` the ``level``."""
        cells = np.minimum(places.astype(int), len(self.samples) - 2)
        shares = places - cells
        values = np.empty((len(places), *self.samples[0, self.asked].shape))
        is_near = np.zeros(values.shape, bool)
        before, slopes = -2, (values[0], values[0])
        for n, (cell, share) in enumerate(zip(cells.tolist(), shares.tolist())):
            low, high = self.samples[cell, self.asked], self.samples[cell + 1, self.asked]
            if share in (0, 1):
                values[n] = high if share else low
                continue
            if cell != before:
                first = slopes[1] if cell == before + 1 else self.slope(cell)
                before, slopes = cell, (first, self.slope(cell + 1))
            rest, (rise, rise_after) = 1 - share, (slope * self.h for slope in slopes)
            smooth = low * ((1 + 2 * share) * rest**2) + high * ((1 + 2 * rest) * share**2)
            smooth = smooth + (rise * rest - rise_after * share) * (share * rest)
            values[n] = self._with_walls(cell, share, level, smooth)
            reach = near + share * self.h, near + (1 - share) * self.h
            is_near[n] = (np.abs(low - level) < reach[0]) & (np.abs(high - level) < reach[1])
        which = np.nonzero(is_near)
        values[which] = self._bounded(values[which], cells[which[0]], shares[which[0]], which[1:])
        return values

    def _with_walls(self, cell: int, share: float, level: float, smooth: Floats) -> Floats:
        """Return values (p, q) after sample ``cell``: ``smooth`` unless there is a thin wall.

        There is one if the field falls towards the surface, rises behind it, and the straight lines
        from both sides meet beyond it.
        """
        before, low, high, after = (self._sample(cell + n) - level for n in range(-1, 3))
        side = np.sign(low)
        low, high = low * side, high * side
        falling = np.minimum(before * side - low, self.h)
        rising = np.minimum(after * side - high, self.h)
        is_wall = (high > 0) & (np.minimum(falling, rising) > STEEP * self.h)
        is_wall &= low * rising + high * falling <= falling * rising  # the lines meet beyond 0
        wall = np.maximum(low - falling * share, high - rising * (1 - share))
        walled: Floats = np.where(is_wall, wall * side + level, smooth)
        return walled

    def slope(self, i: int) -> Floats:
        """Return the slope along the lines at sample i, (p, q), as distances allow it."""
        two_before, before, middle, after, two_after = (self._sample(i + n) for n in range(-2, 3))
        slope = (8 * (after - before) - (two_after - two_before)) / (12 * self.h)
        least, most = self._steepness(i)
        slope = np.sign(slope) * np.clip(np.abs(slope), least, most)
        behind, ahead = (middle - before) / self.h, (after - middle) / self.h
        mean, half = (ahead + behind) / 2, MARGIN / 2 * np.abs(ahead - behind)
        bounded: Floats = np.clip(slope, mean - half, mean + half)
        return bounded

    def _sample(self, i: int) -> Floats:
        """Return sample i of the asked lines, extrapolated linearly beyond their ends."""
        end = min(max(i, 0), len(self.samples) - 1)
        inner = end + 1 if i < 0 else end - 1
        sample: Floats = self.samples[end, self.asked]
        if i != end:
            sample = sample + abs(i - end) * (sample - self.samples[inner, self.asked])
        return sample

    def _steepness(self, i: int) -> tuple[Floats, Floats]:
        """Return the least and the largest slope along the lines at sample i, where |grad| = 1."""
        least: Any = 0.0
        most: Any = 0.0
        for axis, step in enumerate(self.steps):
            differences = np.diff(self.samples[i], axis=axis) / step
            first, last = differences.take([0], axis), differences.take([-1], axis)
            behind = np.concatenate([first, differences], axis)[self.asked]
            ahead = np.concatenate([differences, last], axis)[self.asked]
            mean, half = np.abs(behind + ahead) / 2, np.abs(behind - ahead) / 2
            least = least + np.maximum(mean - half, 0) ** 2
            most = most + (mean + half) ** 2
        return np.sqrt(np.maximum(1 - most, 0)), np.sqrt(np.maximum(1 - least, 0))

    def _bounded(
        self,
        values: Floats,
        cells: NDArray[np.int64],
        shares: Floats,
        across: tuple[NDArray[np.intp], ...],
    ) -> Floats:
        """Return values between samples, (n,), kept within what the samples round them allow."""
        _, rows, width = self.around.shape
        at = (cells * rows + across[0] + self.asked.start + REACH) * width + across[1] + REACH
        low, high = np.full(len(at), -np.inf), np.full(len(at), np.inf)
        for start, along in ((at, shares), (at + rows * width, 1 - shares)):
            along = (along * self.h) ** 2
            for j, k in OFFSETS:
                sample = self.around.ravel().take(start + (j * width + k))
                apart = np.sqrt(along + ((j * self.steps[0]) ** 2 + (k * self.steps[1]) ** 2))
                np.fmax(low, sample - apart, out=low)
                np.fmin(high, sample + apart, out=high)
        kept: Floats = np.where(low <= high, np.clip(values, low, high), values)
        return kept


def new_places(count: int, h: float, step: float) -> Floats:
    """Return where new samples lie along an axis, in old spacings.

    The last one lies as near to the last sample as it can, and takes its value if it is beyond.
    """
    places = np.arange(round((count - 1) * h / step) + 1) * (step / h)
    nearest = np.rint(places)
    places = np.where(np.abs(places - nearest) <= ON_SAMPLE, nearest, places)
    reached: Floats = np.minimum(places, count - 1)
    return reached


def _chunks(count: int, each: int) -> Iterator[slice]:
    step = max(CHUNK // max(each, 1), 1)
    for start in range(0, count, step):
        yield slice(start, min(start + step, count))
