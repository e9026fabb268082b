"""Distances made of others: of masks, of truncated ones, and on finer planes along an axis.

A mask only says which samples are inside. Its surface passes half-way between a sample inside and
one outside. So the distance of a sample is that to the nearest one of the other side, less half a
voxel: the Euclidean distance transform of both sides, up to ``REACH`` voxels.

Of a truncated field, a sample x with distance d and gradient n touches the surface at the foot
point x - d n. The distance of a sample that was cut off is that to the nearest foot point of the
others, and no less than where it was cut off.

Between two samples of an axis that is resampled the values are those of a cubic polynomial
(Hermite). The gradient has length 1, so the differences across the line bound the slope along it.
And two distances differ by no more than their points are apart: the samples round a point bound its
value (McShane, Whitney), unless they contradict each other, as noise does.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, Triple
from .look import Extremes, Floats
from .samples import MadePlanes, SampleArray, SamplePlanes, in_spacings, over_three

REACH = 4  # voxels; patches are clipped to 3 (``refine.band.PATCH_LIMIT``), half of one goes off

FEET_REACH = 3  # samples from one up to which others are filled in with the help of its foot
NO_FOOT = 2.6  # voxels: the distance of a sample without a foot point near it
LEAST_SLOPE = 0.3  # of a sample whose foot point is used
DISC = 0.2  # voxels
WITHIN = 1 - 1e-5  # share of the limit up to which a value is not cut off

NEAR = 3.5  # new spacings from the surface, up to which values are kept within their bounds
ACROSS = 4  # samples across the line, from which on they do not bound a value
OFFSETS = [(j, k) for j, k in product(range(-ACROSS, ACROSS + 1), repeat=2) if j * j + k * k <= 16]
MARGIN = 2.0  # the slope is as near to the mean of the differences along the line as they are
STEEP_WALL = 0.25  # the least slope with which a field falls towards a wall and rises behind it
EXTRA = 2  # samples beyond a cell, on either side, that its slopes depend on
ON_SAMPLE = 1e-3  # spacings from a sample, up to which a new sample takes its value
MOST = 1e12  # spacings: larger values are cut off, so that squares do not overflow
PLACES = 32  # between samples that are worked on at a time


def mask_distances(inside: BoolArray) -> FloatArray:
    """Return distances to the boundary of a mask, in voxels, negative inside, of 0.5 to 3.5."""
    # of each sample, the squared distances to the nearest one outside and inside: one of them is 0
    squared = np.stack([inside, ~inside]).astype(np.uint8) * np.uint8(REACH * REACH)
    for axis in (1, 2, 3):
        before = np.moveaxis(squared, axis, 0)
        after = before.copy()
        for step in range(1, min(REACH, len(before))):
            np.minimum(after[step:], before[:-step] + np.uint8(step * step), out=after[step:])
            np.minimum(after[:-step], before[step:] + np.uint8(step * step), out=after[:-step])
        squared = np.moveaxis(after, 0, axis)
    roots = np.sqrt(np.arange(REACH * REACH + 1, dtype=np.float32)) - np.float32(0.5)
    distances: FloatArray = np.stack([roots[plane] for plane in squared.sum(0, dtype=np.uint8)])
    np.negative(distances, out=distances, where=inside)
    return distances


def extremes_of_masks(h: float) -> Extremes:
    """Return bounds of the distances of a mask."""
    return (0.5 - REACH) * h, (REACH - 0.5) * h


def without_inner_faces(values: SampleArray, inside: int, h: float) -> MadePlanes:
    """Return distances of which those inside, with none outside round them, are h at least.

    ``inside`` is their sign. Where parts of a solid touch, distances to its faces inside are less.
    """

    def make(planes: NDArray[Any]) -> Floats:
        near = over_three(planes * inside < 0, np.logical_or)
        deep = inside * np.maximum(np.abs(planes), h)
        return np.asarray(np.where(near, planes, deep), np.float64)

    return MadePlanes(values, make, 1)


# Truncated distances


def filled_planes(values: SampleArray, spacing: Triple, limits: Extremes) -> MadePlanes:
    """Return truncated distances, cut off at ``limits``, with those that are missing filled in."""
    h = min(spacing)
    low, high = (limit / h for limit in limits)
    steps = np.array(spacing) / h
    return MadePlanes(
        values,
        lambda planes: fill_in(in_spacings(planes, h), low, high, steps).astype(float) * h,
        beside=2 * (int(FEET_REACH * steps.max() / steps.min()) + 1),  # once for each round
    )


def fill_in(values: FloatArray, low: float, high: float, steps: Floats) -> FloatArray:
    """Return distances in units of the finest spacing, (nx, ny, nz), filled in where cut off.

    The second round has better gradients: central differences to what the first one filled in.
    At a foot point the surface is taken as a disc: it goes on between them.
    """
    from scipy.spatial import cKDTree

    cut = (values <= low * WITHIN) | (values >= high * WITHIN)
    known, missing = (np.argwhere(x) * steps for x in (~cut, cut))
    distances, signed, far = values[~cut], values[cut], NO_FOOT * float(steps.max())
    least = np.where(signed > 0, high, -low)
    for hidden in (cut, np.zeros_like(cut)):
        gradient = _gradient(values, steps, hidden)[~cut]
        slope = np.sqrt((gradient**2).sum(1))
        steep = slope > LEAST_SLOPE
        normal = gradient[steep] / slope[steep, None]
        feet = known[steep] - distances[steep, None] * normal
        found = np.full(len(missing), far)
        if len(feet):
            apart, which = cKDTree(feet).query(missing, distance_upper_bound=far)
            near = np.flatnonzero(np.isfinite(apart))
            height = ((missing[near] - feet[which[near]]) * normal[which[near]]).sum(1)
            aside = np.sqrt(np.maximum(apart[near] ** 2 - height**2, 0))
            found[near] = np.hypot(height, np.maximum(aside - DISC, 0))
        values = values.copy()
        values[cut] = np.copysign(np.maximum(found, least), signed)
    return values


def _gradient(values: FloatArray, steps: Floats, hidden: BoolArray) -> Floats:
    """Return central differences, (nx, ny, nz, 3); one-sided ones beside ``hidden`` samples.

    Amid two hidden ones, the larger difference is a lower bound.
    """
    gradient = np.empty((*values.shape, 3))
    for axis, step in enumerate(steps):
        (behind, ahead), numbers = _slopes_beside(values, axis, 1.0), np.arange(values.shape[axis])
        no_behind = hidden.take(np.abs(numbers - 1), axis)
        no_ahead = np.flip(np.flip(hidden, axis).take(np.abs(numbers - 1), axis), axis)
        larger = np.where(np.abs(ahead) > np.abs(behind), ahead, behind)
        one = np.where(no_ahead, np.where(no_behind, larger, behind), ahead)
        rise = np.where(no_ahead | no_behind, one, (ahead + behind) / 2)
        gradient[..., axis] = rise / step
    return gradient


def _slopes_beside(values: NDArray[Any], axis: int, step: float) -> tuple[Floats, Floats]:
    """Return the slopes along an axis before and after each sample; at an end they are equal."""
    slopes = np.diff(values, axis=axis) / step
    first, last = slopes.take([0], axis), slopes.take([-1], axis)
    return np.concatenate([first, slopes], axis), np.concatenate([slopes, last], axis)


# Finer planes along an axis


class Resampled(SamplePlanes):
    """Samples interpolated along one axis, from the first on, alike in whatever parts are read.

    ``level`` is the value at which the surface will be meshed. The new samples, at ``step``, lie at
    ``places``, in old spacings; those ``on_sample`` are old ones.
    """

    dtype = np.dtype(np.float64)
    name = "the resampled grid"
    beside = ACROSS

    def __init__(
        self, source: SampleArray, spacing: Triple, axis: int, step: float, level: float = 0.0
    ) -> None:
        self.source, self.axis, self.step, self.level = source, axis, step, level
        self.h, self.across = spacing[axis], np.delete(spacing, axis).tolist()
        # The last one lies as near to the last sample as it can, and takes its value beyond.
        count = source.shape[axis]
        places = np.arange(round((count - 1) * self.h / step) + 1) * (step / self.h)
        nearest = np.rint(places)
        places = np.where(np.abs(places - nearest) <= ON_SAMPLE, nearest, places)
        self.places: Floats = np.minimum(places, count - 1)
        self.on_sample: BoolArray = np.rint(self.places) == self.places
        shape = list(source.shape)
        shape[axis] = len(self.places)
        self.shape = tuple(shape)

    def read(self, first: int, last: int) -> Floats:
        """Return planes ``first`` to ``last`` (exclusive)."""
        if last <= first:
            return np.empty((0, *self.shape[1:]))
        low, high, places = max(first - ACROSS, 0), last + ACROSS, self.places
        if self.axis == 0:
            low, high = int(places[first]) - EXTRA, int(places[last - 1]) + 2 + EXTRA
            low = max(low, 0)
            places = places[first:last] - low
        block = np.asarray(self.source[low:high], np.float64)
        block = np.clip(block, self.level - MOST * self.h, self.level + MOST * self.h)
        lines = np.ascontiguousarray(np.moveaxis(block, self.axis, 0))
        values = np.moveaxis(self._along(lines, places), 0, self.axis)
        return values if self.axis == 0 else values[first - low : last - low]

    def _along(self, lines: Floats, places: Floats) -> Floats:
        """Return the values at places, (m, p, q), along lines of samples, (n, p, q)."""
        wide = np.pad(lines, ((0, 0), *((ACROSS, ACROSS),) * 2), constant_values=np.nan)
        values, beside = np.empty((len(places), *lines.shape[1:])), _slopes_beside(lines, 0, 1.0)
        rises = self._rises(lines, *beside)
        for start in range(0, len(places), PLACES):
            some = slice(start, start + PLACES)
            cells = np.minimum(places[some].astype(int), len(lines) - 2)
            share = (places[some] - cells)[:, None, None]
            rest, low, high = 1 - share, lines[cells], lines[cells + 1]
            smooth = low * ((1 + 2 * share) * rest**2) + high * ((1 + 2 * rest) * share**2)
            smooth = smooth + (rises[cells] * rest - rises[cells + 1] * share) * (share * rest)
            slopes = -beside[0][cells], beside[1][cells + 1]
            smooth = self._with_walls(smooth, (low, high), slopes, share)
            reach, off = NEAR * self.step, (np.abs(x - self.level) for x in (low, high))
            near = [x < reach + s * self.h for x, s in zip(off, (share, rest))]
            which = np.nonzero(near[0] & near[1] & (share > 0) & (share < 1))
            at = cells[which[0]], *which[1:]
            smooth[which] = self._bounded(smooth[which], wide, at, share[which[0], 0, 0])
            values[some] = smooth
        return values

    def _rises(self, lines: Floats, behind: Floats, ahead: Floats) -> Floats:
        """Return the slopes along the lines at samples, (n, p, q), as distances allow them.

        They are per spacing, as the differences to the samples ``behind`` and ``ahead`` are.
        """
        least, most = np.zeros((2, *lines.shape))  # squared slopes across the lines
        for axis, step in enumerate(self.across, 1):
            before, after = _slopes_beside(lines, axis, step)
            mean, half = np.abs(before + after) / 2, np.abs(before - after) / 2
            least += np.maximum(mean - half, 0) ** 2
            most += (mean + half) ** 2
        low, high = (self.h * np.sqrt(np.maximum(1 - x, 0)) for x in (most, least))
        beyond = np.concatenate([behind[:1], behind[:-1]]) + np.concatenate([ahead[1:], ahead[-1:]])
        rise = (7 * (behind + ahead) - beyond) / 12  # of fourth order
        rise = np.sign(rise) * np.clip(np.abs(rise), low, high)
        mean, half = (ahead + behind) / 2, MARGIN / 2 * np.abs(ahead - behind)
        return np.asarray(np.clip(rise, mean - half, mean + half))

    def _with_walls(
        self, smooth: Floats, ends: tuple[Floats, ...], beyond: tuple[Floats, ...], share: Floats
    ) -> Floats:
        """Return values between samples, with walls that are thinner than the spacing.

        There is a wall if the field falls towards the surface, rises behind it, and the straight
        lines from both sides meet beyond it.
        """
        side = np.sign(ends[0] - self.level)
        low, high = ((x - self.level) * side for x in ends)
        falling, rising = (np.minimum(x * side, self.h) for x in beyond)
        is_wall = (high > 0) & (np.minimum(falling, rising) > STEEP_WALL * self.h)
        is_wall &= low * rising + high * falling <= falling * rising
        wall = np.maximum(low - falling * share, high - rising * (1 - share))
        return np.where(is_wall, wall * side + self.level, smooth)

    def _bounded(
        self, values: Floats, around: Floats, at: tuple[NDArray[np.intp], ...], share: Floats
    ) -> Floats:
        """Return values between samples, (n,), kept within what the samples round them allow.

        ``around`` are the lines, and ``ACROSS`` unknown ones on every side.
        """
        cells, row, column = at
        low, high = np.full(len(values), -np.inf), np.full(len(values), np.inf)
        for cell, along in ((cells, share), (cells + 1, 1 - share)):
            for j, k in OFFSETS:
                sample = around[cell, row + ACROSS + j, column + ACROSS + k]
                aside = (j * self.across[0]) ** 2 + (k * self.across[1]) ** 2
                apart = np.sqrt((along * self.h) ** 2 + aside)
                np.fmax(low, sample - apart, out=low)
                np.fmin(high, sample + apart, out=high)
        return np.asarray(np.where(low <= high, np.clip(values, low, high), values))
