"""Resampling along one axis, by what is known of distances.

Between two neighbouring samples of a line the values are those of a cubic polynomial (Hermite). Its
slopes and its values obey the two laws of distances:

- The gradient has length 1. So the differences across the line, to both neighbours of a sample,
  tell how steep the field is along it: the slope is kept within what they allow. Near edges the two
  are different, and allow much.
- Two distances differ by no more than their points are apart. So the samples round a point bound
  its value from both sides (McShane, Whitney). It is kept within, unless they contradict each
  other, as those of a noisy field do.

The slope is also kept near the differences along the line, so that a linear field which is no
distance is reproduced. The experiment ``fields`` of ``super-sdf evaluate`` compares this with
resampling by hand.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, Triple
from .placement import EQUAL_SPACING
from .planes import SampleArray, SamplePlanes

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


class Resampled(SamplePlanes):
    """Samples interpolated along one axis, from the first sample on; made when they are read.

    A value depends on the samples round it alone, so it is the same in whatever parts it is read.

    Parameters
    ----------
    source : (nx, ny, nz) array or SamplePlanes
        Signed distances in world units.
    spacing : three floats
        World distance between neighbouring samples along each axis.
    axis : int
        The axis.
    step : float
        The new spacing along it.
    level : float
        The value at which the surface will be meshed.

    Attributes
    ----------
    places : (n,) float64
        The places of the new samples along the axis, in old spacings from the first sample.
    on_sample : (n,) bool
        Which of them are those of old samples, whose value they have.
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
        """Return planes ``first`` to ``last`` (exclusive), (last - first, ny, nz) float64."""
        out = np.empty((max(last - first, 0), *self.shape[1:]))
        if len(out) and self.axis == 0:
            self._read_between(first, out)
        elif len(out):
            self._read_within(first, out)
        return out

    def _read_between(self, first: int, out: Floats) -> None:
        """Fill planes from the planes of samples before and after them, some rows at a time."""
        places = self.places[first : first + len(out)]
        low = max(int(places[0]) - EXTRA, 0)
        block = np.asarray(self.source[low : int(places[-1]) + 2 + EXTRA])
        for rows in _chunks(out.shape[1], (len(out) + len(block)) * out.shape[2]):
            out[:, rows] = self._interpolate(block, rows, places - low, (1, 2))

    def _read_within(self, first: int, out: Floats) -> None:
        """Fill planes from the samples in them and in those beside them, some planes at a time."""
        low = max(first - REACH, 0)
        block = np.asarray(self.source[low : first + len(out) + REACH])
        lines = np.moveaxis(block, self.axis, 0)
        for planes in _chunks(len(out), 2 * out[0].size):
            own = slice(planes.start + first - low, planes.stop + first - low)
            found = self._interpolate(lines, own, self.places, (0, 3 - self.axis))
            out[planes] = np.moveaxis(found, 0, self.axis)

    def _interpolate(
        self, block: NDArray[Any], own: slice, places: Floats, across: tuple[int, int]
    ) -> Floats:
        """Return the values at places on the lines of a block, whose first axis they run along.

        ``own`` are the lines along the second axis, ``across`` the axes of the grid that are the
        second and the third of the block.
        """
        start = max(own.start - REACH, 0)
        h = self.spacing[self.axis]
        samples = block[:, start : own.stop + REACH].astype(np.float64, order="C")
        np.clip(samples, self.level - MOST * h, self.level + MOST * h, out=samples)
        own = slice(own.start - start, own.stop - start)
        lines = Lines(samples, own, h, (self.spacing[across[0]], self.spacing[across[1]]))
        return lines.values_at(places, self.level, NEAR * self.step)


def resample(
    samples: SampleArray, spacing: Triple, level: float = 0.0
) -> tuple[SampleArray, Triple]:
    """Return samples at the finest spacing on all axes, and their spacing.

    Axes whose spacing is the finest up to 0.1 % are left as they are. The coarsest axis comes last,
    since the finer the others are, the better they tell its slopes.
    """
    h, steps = min(spacing), list(spacing)
    for axis in np.argsort(spacing, kind="stable").tolist():
        if steps[axis] > h * (1 + EQUAL_SPACING):
            samples = Resampled(samples, (steps[0], steps[1], steps[2]), axis, h, level)
            steps[axis] = h
    return samples, (steps[0], steps[1], steps[2])


class Lines:
    """Lines of samples, and the laws of distances on them.

    Parameters
    ----------
    samples : (n, p, q) float64
        The samples; the lines run along the first axis.
    own : slice
        Which of the lines, along the second axis, values are asked of. The others are beside them.
    h : float
        Spacing along the lines.
    steps : two floats
        Spacings across the lines.
    """

    def __init__(self, samples: Floats, own: slice, h: float, steps: tuple[float, float]) -> None:
        self.samples, self.own, self.h, self.steps = samples, own, h, steps
        self.around = np.pad(samples, ((0, 0), *((REACH, REACH),) * 2), constant_values=np.nan)

    def values_at(self, places: Floats, level: float, near: float) -> Floats:
        """Return the values at places along all own lines, (m, p, q).

        Those within ``near`` of a ``level`` are kept within their bounds.
        """
        cells = np.minimum(places.astype(int), len(self.samples) - 2)
        shares = places - cells
        values = np.empty((len(places), *self.samples[0, self.own].shape))
        is_near = np.zeros(values.shape, bool)
        before, slopes = -2, (values[0], values[0])
        for n, (cell, share) in enumerate(zip(cells.tolist(), shares.tolist())):
            low, high = self.samples[cell, self.own], self.samples[cell + 1, self.own]
            if share in (0, 1):
                values[n] = high if share else low
                continue
            if cell != before:
                first = slopes[1] if cell == before + 1 else self.slope(cell)
                before, slopes = cell, (first, self.slope(cell + 1))
            smooth = hermite(low, high, slopes[0] * self.h, slopes[1] * self.h, share)
            values[n] = self._with_walls(cell, share, level, smooth)
            reach = near + share * self.h, near + (1 - share) * self.h
            is_near[n] = (np.abs(low - level) < reach[0]) & (np.abs(high - level) < reach[1])
        which = np.nonzero(is_near)
        values[which] = self._bounded(values[which], cells[which[0]], shares[which[0]], which[1:])
        return values

    def _with_walls(self, cell: int, share: float, level: float, smooth: Floats) -> Floats:
        """Return values between samples ``cell`` and the next, (p, q), through thin walls, too.

        If the field falls towards the surface, rises behind it, and neither sample is within, the
        straight lines from both sides meet beyond the surface: there is a wall. ``smooth`` is the
        value elsewhere.
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
        two_before, before, here, after, two_after = (self._sample(i + n) for n in range(-2, 3))
        slope = (8 * (after - before) - (two_after - two_before)) / (12 * self.h)
        least, most = self._steepness(i)
        slope = np.sign(slope) * np.clip(np.abs(slope), least, most)
        behind, ahead = (here - before) / self.h, (after - here) / self.h
        mean, half = (ahead + behind) / 2, MARGIN / 2 * np.abs(ahead - behind)
        bounded: Floats = np.clip(slope, mean - half, mean + half)
        return bounded

    def _sample(self, i: int) -> Floats:
        """Return sample i of the own lines; beyond their ends, it is extrapolated linearly."""
        end = min(max(i, 0), len(self.samples) - 1)
        inner = end + 1 if i < 0 else end - 1
        found: Floats = self.samples[end, self.own]
        if i != end:
            found = found + abs(i - end) * (found - self.samples[inner, self.own])
        return found

    def _steepness(self, i: int) -> tuple[Floats, Floats]:
        """Return the least and the largest slope along the lines at sample i, where |grad| = 1.

        Across the lines, the slope is between the differences to both neighbours.
        """
        least: Any = 0.0
        most: Any = 0.0
        for axis, step in enumerate(self.steps):
            differences = np.diff(self.samples[i], axis=axis) / step
            first, last = differences.take([0], axis), differences.take([-1], axis)
            behind = np.concatenate([first, differences], axis)[self.own]
            ahead = np.concatenate([differences, last], axis)[self.own]
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
        at = (cells * rows + across[0] + self.own.start + REACH) * width + across[1] + REACH
        low, high = np.full(len(at), -np.inf), np.full(len(at), np.inf)
        for start, along in ((at, shares), (at + rows * width, 1 - shares)):
            along = (along * self.h) ** 2
            for j, k in OFFSETS:
                found = self.around.ravel().take(start + (j * width + k))
                apart = np.sqrt(along + ((j * self.steps[0]) ** 2 + (k * self.steps[1]) ** 2))
                np.fmax(low, found - apart, out=low)
                np.fmin(high, found + apart, out=high)
        kept: Floats = np.where(low <= high, np.clip(values, low, high), values)
        return kept


def hermite(low: Floats, high: Floats, rise: Floats, rise_after: Floats, share: float) -> Floats:
    """Return the cubic polynomial with two values and two slopes, at a share of the way."""
    rest = 1 - share
    ends = low * ((1 + 2 * share) * rest**2) + high * ((1 + 2 * rest) * share**2)
    curve: Floats = ends + (rise * rest - rise_after * share) * (share * rest)
    return curve


def new_places(count: int, h: float, step: float) -> Floats:
    """Return where new samples lie along an axis, in spacings from the first of ``count`` samples.

    The last one lies as near to the last sample as it can, and takes its value if it is beyond.
    """
    places = np.arange(round((count - 1) * h / step) + 1) * (step / h)
    nearest = np.rint(places)
    places = np.where(np.abs(places - nearest) <= ON_SAMPLE, nearest, places)
    reached: Floats = np.minimum(places, count - 1)
    return reached


def _chunks(count: int, each: int) -> Iterator[slice]:
    """Yield slices of ``count`` rows of ``each`` samples, so that they have about ``CHUNK``."""
    step = max(CHUNK // max(each, 1), 1)
    for start in range(0, count, step):
        yield slice(start, min(start + step, count))
