"""Samples between others along an axis whose spacing is coarser.

Between two samples of an axis that is resampled the values are those of a cubic polynomial
(Hermite), which obeys the two laws of distances. The gradient has length 1, so the differences
across the line tell how steep the field is along it: the slope is kept within what they allow, and
near the differences along the line, so that a linear field which is no distance is reproduced. And
two distances differ by no more than their points are apart, so the samples round a point bound its
value (McShane, Whitney): it is kept within, unless they contradict each other, as noise does.
"""

from __future__ import annotations

from itertools import product
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, Triple
from ..threads import chunks_of
from .look import Floats
from .samples import SampleArray, SamplePlanes

NEAR = 3.5  # new spacings from the surface, up to which values are kept within their bounds
ACROSS = 4  # samples across the line, from which on they do not bound a value
OFFSETS = [(j, k) for j, k in product(range(-ACROSS, ACROSS + 1), repeat=2) if j * j + k * k <= 16]
MARGIN = 2.0  # the slope is as near to the mean of the differences along the line as they are
STEEP_WALL = 0.25  # the least slope with which a field falls towards a wall and rises behind it
EXTRA = 2  # samples beyond a cell, on either side, that its slopes depend on
ON_SAMPLE = 1e-3  # spacings from a sample, up to which a new sample takes its value
MOST = 1e12  # spacings: larger values are cut off, so that squares do not overflow

Ints: TypeAlias = NDArray[np.int64]
Places: TypeAlias = tuple[NDArray[np.intp], ...]


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
        # The last one lies as near to the last sample as it can, and takes its value beyond.
        count, each = source.shape[axis], spacing[axis]
        places = np.arange(round((count - 1) * each / step) + 1) * (step / each)
        nearest = np.rint(places)
        places = np.where(np.abs(places - nearest) <= ON_SAMPLE, nearest, places)
        self.places: Floats = np.minimum(places, count - 1)
        self.on_sample: BoolArray = np.rint(self.places) == self.places
        self.shape = tuple(
            len(self.places) if other == axis else count for other, count in enumerate(source.shape)
        )

    def read(self, first: int, last: int) -> Floats:
        """Return planes ``first`` to ``last`` (exclusive)."""
        out = np.empty((max(last - first, 0), *self.shape[1:]))
        if not len(out):
            return out
        low, high, places = max(first - ACROSS, 0), last + ACROSS, self.places
        if self.axis == 0:
            places = places[first:last]
            low, high = max(int(places[0]) - EXTRA, 0), int(places[-1]) + 2 + EXTRA
            places = places - low
        block = np.moveaxis(np.asarray(self.source[low:high]), self.axis, 0)
        lines, start = np.moveaxis(out, self.axis, 0), first - low if self.axis else 0
        h, across = self.spacing[self.axis], np.delete(self.spacing, self.axis)
        for rows in chunks_of(lines.shape[1], 2 * (len(lines) + len(block)) * lines.shape[2]):
            asked = slice(rows.start + start, rows.stop + start)
            around = max(asked.start - ACROSS, 0)
            samples = block[:, around : asked.stop + ACROSS].astype(np.float64, order="C")
            np.clip(samples, self.level - MOST * h, self.level + MOST * h, out=samples)
            asked = slice(asked.start - around, asked.stop - around)
            along = Lines(samples, asked, h, (float(across[0]), float(across[1])))
            lines[:, rows] = along.values_at(places, self.level, NEAR * self.step)
        return out


class Lines:
    """Lines of samples (n, p, q), along the first axis, and the laws of distances on them.

    Only those ``asked`` of the second axis are interpolated; ``steps`` are the spacings across.
    """

    def __init__(self, samples: Floats, asked: slice, h: float, steps: tuple[float, float]) -> None:
        self.samples, self.asked, self.h, self.steps = samples, asked, h, steps
        self.around = np.pad(samples, ((0, 0), *((ACROSS, ACROSS),) * 2), constant_values=np.nan)
        own = samples[:, asked]  # continued linearly by two at both ends
        first, last = own[0] - own[1], own[-1] - own[-2]
        before, after = [own[0] + 2 * first, own[0] + first], [own[-1] + last, own[-1] + 2 * last]
        self.continued = np.concatenate([before, own, after])

    def values_at(self, places: Floats, level: float, near: float) -> Floats:
        """Return the values (m, p, q) at places, within their bounds if ``near`` the ``level``."""
        cells = np.minimum(places.astype(int), len(self.samples) - 2)
        shares = places - cells
        values = np.empty((len(places), *self.continued.shape[1:]))
        is_near = np.zeros(values.shape, bool)
        former, slopes = -2, (values[0], values[0])
        for n, (cell, share) in enumerate(zip(cells.tolist(), shares.tolist())):
            before, low, high, after = self.continued[cell + 1 : cell + 5]
            if share in (0, 1):
                values[n] = high if share else low
                continue
            if cell != former:
                first = slopes[1] if cell == former + 1 else self.slope(cell)
                former, slopes = cell, (first, self.slope(cell + 1))
            rest, (rise, rise_after) = 1 - share, (slope * self.h for slope in slopes)
            smooth = low * ((1 + 2 * share) * rest**2) + high * ((1 + 2 * rest) * share**2)
            smooth = smooth + (rise * rest - rise_after * share) * (share * rest)
            reach = near + share * self.h, near + (1 - share) * self.h
            is_near[n] = (np.abs(low - level) < reach[0]) & (np.abs(high - level) < reach[1])
            # There is a thin wall if the field falls towards the surface, rises behind it, and the
            # straight lines from both sides meet beyond it.
            side = np.sign(low - level)
            before, low, high, after = ((x - level) * side for x in (before, low, high, after))
            falling, rising = np.minimum(before - low, self.h), np.minimum(after - high, self.h)
            is_wall = (high > 0) & (np.minimum(falling, rising) > STEEP_WALL * self.h)
            is_wall &= low * rising + high * falling <= falling * rising
            wall = np.maximum(low - falling * share, high - rising * rest)
            values[n] = np.where(is_wall, wall * side + level, smooth)
        which = np.nonzero(is_near)
        values[which] = self._bounded(values[which], cells[which[0]], shares[which[0]], which[1:])
        return values

    def slope(self, i: int) -> Floats:
        """Return the slope along the lines at sample i, (p, q), as distances allow it."""
        two_before, before, middle, after, two_after = self.continued[i : i + 5]
        slope = (8 * (after - before) - (two_after - two_before)) / (12 * self.h)
        least, most = self._steepness(i)
        slope = np.sign(slope) * np.clip(np.abs(slope), least, most)
        behind, ahead = (middle - before) / self.h, (after - middle) / self.h
        mean, half = (ahead + behind) / 2, MARGIN / 2 * np.abs(ahead - behind)
        return np.asarray(np.clip(slope, mean - half, mean + half))

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

    def _bounded(self, values: Floats, cells: Ints, shares: Floats, across: Places) -> Floats:
        """Return values between samples, (n,), kept within what the samples round them allow."""
        _, rows, width = self.around.shape
        at = (cells * rows + across[0] + self.asked.start + ACROSS) * width + across[1] + ACROSS
        low, high = np.full(len(at), -np.inf), np.full(len(at), np.inf)
        for start, along in ((at, shares), (at + rows * width, 1 - shares)):
            along = (along * self.h) ** 2
            for j, k in OFFSETS:
                sample = self.around.ravel().take(start + (j * width + k))
                apart = np.sqrt(along + ((j * self.steps[0]) ** 2 + (k * self.steps[1]) ** 2))
                np.fmax(low, sample - apart, out=low)
                np.fmin(high, sample + apart, out=high)
        return np.asarray(np.where(low <= high, np.clip(values, low, high), values))
