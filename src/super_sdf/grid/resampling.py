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
distance is reproduced. ``benchmarks.anisotropic`` compares this with other interpolations.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, Triple
from .planes import SampleArray, SamplePlanes

Floats = NDArray[np.float64]

NEAR = 3.5  # new spacings from the surface, up to which values are kept within their bounds
REACH = 4  # samples across the line, from which on they do not bound a value
OFFSETS = [(j, k) for j, k in product(range(-REACH, REACH + 1), repeat=2) if j * j + k * k <= 16]
MARGIN = 2.0  # the slope is as near to the mean of the differences along the line as they are
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
        samples = block[:, start : own.stop + REACH].astype(np.float64)
        np.clip(samples, self.level - MOST * h, self.level + MOST * h, out=samples)
        own = slice(own.start - start, own.stop - start)
        lines = Lines(samples, own, h, (self.spacing[across[0]], self.spacing[across[1]]))
        return lines.values_at(places, self.level, NEAR * self.step)


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

    def __init__(
        self, samples: Floats, own: slice, h: float, steps: tuple[float, float]
    ) -> None:
        self.samples, self.own, self.h, self.steps = samples, own, h, steps
        self.around = np.pad(samples, ((0, 0), *((REACH, REACH),) * 2), constant_values=np.nan)

    def values_at(self, places: Floats, level: float, near: float) -> Floats:
        """Return the values at places along all own lines, (m, p, q).

        Those within ``near`` of a ``level`` are kept within their bounds.
        """
        values = np.empty((len(places), *self.samples[0, self.own].shape))
        cells = np.minimum(places.astype(int), len(self.samples) - 2)
        before, slopes = -2, (values[0], values[0])
        for out, place, cell in zip(values, places, cells.tolist()):
            share = float(place) - cell
            low, high = self.samples[cell, self.own], self.samples[cell + 1, self.own]
            if share in (0, 1):
                out[...] = high if share else low
                continue
            if cell != before:
                first = slopes[1] if cell == before + 1 else self.slope(cell)
                before, slopes = cell, (first, self.slope(cell + 1))
            out[...] = hermite(low, high, slopes[0] * self.h, slopes[1] * self.h, share)
            ahead, behind = np.abs(low - level), np.abs(high - level)
            least = np.maximum(ahead - share * self.h, behind - (1 - share) * self.h)
            self._bound(out, cell, share, np.nonzero(least < near))
        return values

    def slope(self, i: int) -> Floats:
        """Return the slope along the lines at sample i, (p, q), as distances allow it."""
        one, two = self._pairs(i)
        ahead, behind = (np.subtract(*pair) / self.h for pair in one)
        slope = (8 * (one[0][0] - one[1][1]) - (two[0] - two[1])) / (12 * self.h)
        least, most = self._steepness(i)
        slope = np.copysign(np.clip(np.abs(slope), least, most), slope)
        mean, half = (ahead + behind) / 2, MARGIN / 2 * np.abs(ahead - behind)
        return np.clip(slope, mean - half, mean + half)

    def _pairs(self, i: int) -> tuple[Any, tuple[Floats, Floats]]:
        """Return (after, at) and (at, before) sample i; and the samples two after and before it.

        Beyond the ends of the lines, samples are extrapolated linearly.
        """
        count = len(self.samples)

        def sample(n: int) -> Floats:
            end = min(max(n, 0), count - 1)
            inner = end + 1 if n < 0 else end - 1
            found = self.samples[end, self.own]
            beyond = abs(n - end)
            return found + beyond * (found - self.samples[inner, self.own]) if beyond else found

        here, after, before = sample(i), sample(i + 1), sample(i - 1)
        return ((after, here), (here, before)), (sample(i + 2), sample(i - 2))

    def _steepness(self, i: int) -> tuple[Floats, Floats]:
        """Return the least and the largest slope along the lines at sample i that |grad| = 1 allows.

        Across the lines, the slope is between the differences to both neighbours.
        """
        least = most = 0.0
        for axis, step in enumerate(self.steps):
            differences = np.diff(self.samples[i], axis=axis) / step
            first, last = differences.take([0], axis), differences.take([-1], axis)
            behind = np.concatenate([first, differences], axis)[self.own]
            ahead = np.concatenate([differences, last], axis)[self.own]
            mean, half = np.abs(behind + ahead) / 2, np.abs(behind - ahead) / 2
            least = least + np.maximum(mean - half, 0) ** 2
            most = most + (mean + half) ** 2
        return np.sqrt(np.maximum(1 - most, 0)), np.sqrt(np.maximum(1 - least, 0))

    def _bound(
        self, values: Floats, cell: int, share: float, near: tuple[NDArray[np.intp], ...]
    ) -> None:
        """Keep some values of a plane between samples within what the samples round them allow."""
        width = self.around.shape[2]
        at = (near[0] + self.own.start + REACH) * width + near[1] + REACH
        low, high = np.full(len(at), -np.inf), np.full(len(at), np.inf)
        for n, along in ((cell, share * self.h), (cell + 1, (1 - share) * self.h)):
            plane = self.around[n].ravel()
            for j, k in OFFSETS:
                found = plane.take(at + (j * width + k))
                apart = (along**2 + (j * self.steps[0]) ** 2 + (k * self.steps[1]) ** 2) ** 0.5
                np.fmax(low, found - apart, out=low)
                np.fmin(high, found + apart, out=high)
        inner = values[near]
        values[near] = np.where(low <= high, np.clip(inner, low, high), inner)


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
    return np.minimum(places, count - 1)


def _chunks(count: int, each: int) -> Iterator[slice]:
    """Yield slices of ``count`` rows of ``each`` samples, so that they have about ``CHUNK``."""
    step = max(CHUNK // max(each, 1), 1)
    for start in range(0, count, step):
        yield slice(start, min(start + step, count))
