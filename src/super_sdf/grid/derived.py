"""Distances made of others: of masks, of truncated ones, and on finer planes along an axis.

A mask only says which samples are inside. Its surface passes half-way between a sample inside and
one outside. So the distance of a sample is that to the nearest one of the other side, less half a
voxel: the Euclidean distance transform of both sides, up to ``REACH`` voxels.

Of a truncated field, a sample x with distance d and gradient n touches the surface at the foot
point x - d n. The distance of a sample that was cut off is that to the nearest foot point of the
others, and no less than where it was cut off.

Between two samples of an axis that is resampled the values are those of a cubic polynomial
(Hermite), or of a wall between them. The gradient has length 1, so the differences across the line
bound the slope along it. Two distances differ by no more than their points are apart: the samples
round a point bound its value (McShane, Whitney), unless they contradict each other.
"""

from __future__ import annotations

from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray, Triple, dot
from .look import Extremes, Floats
from .samples import MadePlanes, SampleArray, SamplePlanes, over_three

REACH = 4  # voxels; patches are clipped to 3 (``refine.band.PATCH_LIMIT``), half of one goes off

BLURS = 1, 1, 2, 2, 4  # steps of the blurs of a mask, each by (1, 2, 1) / 4 along all axes
BLURRED = sum(BLURS)  # samples to each side on which a blurred one depends
# After two, four and five blurs the kernel's deviation is 1, 5^.5 and 13^.5 samples; hence follow:
GAINS, SLOPES = np.array([[[0.809], [1.633]], [[1.732], [3.46]]], np.float32)

NO_FOOT = 2.6  # largest spacings: the distance of a sample without a foot point near it
FEET_REACH = 5  # largest spacings from a sample to others that its foot point fills in
DISC = 0.2  # finest spacings, the radius of the surface at a foot point
LEAST_SLOPE = 0.3  # of a sample whose foot point is used
WITHIN = 1 - 1e-5  # share of the limit up to which a value is not cut off

NEAR = 3.5  # new spacings from the surface, up to which values are kept within their bounds
ACROSS = 4  # samples across the line, from which on they do not bound a value
OFFSETS = [(j, k) for j, k in product(range(-ACROSS, ACROSS + 1), repeat=2) if j * j + k * k <= 16]
STEEP_WALL = 0.25  # the least slope with which a field falls towards a wall and rises behind it
EXTRA = 2  # samples beyond a cell, on either side, that its slopes depend on
ON_SAMPLE = 1e-3  # spacings from a sample, up to which a new sample takes its value
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


def wide_distances(inside: BoolArray, ijk: IntArray) -> FloatArray:
    """Return what a mask, blurred, tells of the distances of samples (n, 3): (n, 2), in voxels.

    In proportion to its width a kernel mistakes a curvature for a distance. So of two kernels a sum
    is taken in which that cancels out: the distance of a plane up to some tenths of a voxel, and
    less beyond. The first sum is of narrow kernels, the second of wide ones.
    """
    values, blurred = (~inside).astype(np.float32), list[FloatArray]()
    for step in BLURS:
        for axis in range(3):
            lines, sums = (np.moveaxis(array, axis, 0) for array in (values, values * 2))
            for before, after in ((lines, sums), (lines[::-1], sums[::-1])):
                after[step:] += before[:-step]
                after[:step] += before[:1]  # beyond the border as on it
            values = np.moveaxis(sums, 0, axis)
        values *= 1 / 64
        blurred.append(values[tuple(ijk.T)])
    _, narrow, _, middle, wide = blurred
    sums = np.stack([narrow, middle]) - 0.5 + GAINS * np.stack([narrow - middle, middle - wide])
    return np.asarray((sums * SLOPES).T, np.float32)


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
    beside = int(FEET_REACH * max(spacing) / min(spacing)) + 1
    return MadePlanes(values, partial(fill_in, spacing=spacing, limits=limits), beside)


def fill_in(values: NDArray[Any], spacing: Triple, limits: Extremes) -> Floats:
    """Return distances, (nx, ny, nz), filled in where they are cut off.

    At a foot point the surface is taken as a disc: it goes on between them.
    """
    from scipy.spatial import cKDTree

    filled, (low, high), far = values.astype(np.float64), limits, NO_FOOT * max(spacing)
    cut = (filled <= low * WITHIN) | (filled >= high * WITHIN)
    rises: Any = np.gradient(filled, *spacing)
    gradient = np.stack(rises, -1)[~cut]
    slope = np.linalg.norm(gradient, axis=1)
    steep = slope > LEAST_SLOPE
    normal = gradient[steep] / slope[steep, None]
    feet = (np.argwhere(~cut) * spacing)[steep] - filled[~cut][steep, None] * normal
    missing = np.argwhere(cut) * spacing
    apart, nearest = cKDTree(feet).query(missing, distance_upper_bound=far)
    near = np.isfinite(apart)
    height = dot(missing[near] - feet[nearest[near]], normal[nearest[near]])
    aside = np.sqrt(np.maximum(apart[near] ** 2 - height**2, 0))
    apart[near] = np.hypot(height, np.maximum(aside - DISC * min(spacing), 0))
    apart = np.float32(apart / far).astype(np.float64) * far  # alike in whatever parts are read
    least = np.where(filled[cut] > 0, high, -low)
    filled[cut] = np.copysign(np.clip(apart, least, far), filled[cut])
    return filled


# Finer planes along an axis


class Resampled(SamplePlanes):
    """Samples interpolated along one axis, from the first on, alike in whatever parts are read.

    ``level`` is the value at which the surface will be meshed. The new samples, at ``step``, lie at
    ``places``, in old spacings.
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
        lines = np.moveaxis(np.asarray(self.source[low:high], np.float64), self.axis, 0)
        values = np.moveaxis(self._along(np.ascontiguousarray(lines), places), 0, self.axis)
        return values if self.axis == 0 else values[first - low : last - low]

    def _rise_of_distances(self, lines: Floats) -> tuple[Floats, Floats]:
        """Return the least and largest rise per spacing at samples: the gradient has length 1."""
        least, most = np.zeros((2, *lines.shape))  # squared slopes across the lines
        for axis, step in enumerate(self.across, 1):
            longer = np.pad(np.moveaxis(lines, axis, 0), ((1, 1), (0, 0), (0, 0)), "edge")
            slopes = np.diff(longer, axis=0) / step
            before, after = np.abs(slopes[:-1]), np.abs(slopes[1:])
            lower = np.where(slopes[:-1] * slopes[1:] >= 0, np.minimum(before, after), 0)
            least += np.moveaxis(lower, 0, axis) ** 2
            most += np.moveaxis(np.maximum(before, after), 0, axis) ** 2
        low, high = (self.h * np.sqrt(np.maximum(1 - x, 0)) for x in (most, least))
        return low, high

    def _along(self, lines: Floats, places: Floats) -> Floats:
        """Return the values at places, (m, p, q), along lines of samples, (n, p, q)."""
        wide = np.pad(lines, ((0, 0), *((ACROSS, ACROSS),) * 2), constant_values=np.nan)
        longer = np.pad(lines, ((2, 2), (0, 0), (0, 0)), "reflect", reflect_type="odd")
        steps = np.diff(longer, axis=0)  # of sample n: n + 1 before it, n + 2 after it
        rises = (7 * (steps[1:-2] + steps[2:-1]) - steps[:-3] - steps[3:]) / 12  # of fourth order
        rises = np.sign(rises) * np.clip(np.abs(rises), *self._rise_of_distances(lines))
        values = np.empty((len(places), *lines.shape[1:]))
        for start in range(0, len(places), PLACES):
            some = slice(start, start + PLACES)
            cells = np.minimum(places[some].astype(int), len(lines) - 2)
            share = (places[some] - cells)[:, None, None]
            rest, low, high = 1 - share, lines[cells], lines[cells + 1]
            found = low * ((1 + 2 * share) * rest**2) + high * ((1 + 2 * rest) * share**2)
            found += (rises[cells] * rest - rises[cells + 1] * share) * (share * rest)
            # walls thinner than the spacing: the straight lines from both sides meet beyond 0
            side = np.sign(low - self.level)
            low, high = ((x - self.level) * side for x in (low, high))
            falling, rising = -steps[cells + 1] * side, steps[cells + 3] * side
            is_wall = (high > 0) & (np.minimum(falling, rising) > STEEP_WALL * self.h)
            is_wall &= low * rising + high * falling <= falling * rising
            wall = np.maximum(low - falling * share, high - rising * rest) * side + self.level
            found = np.where(is_wall, wall, found)
            near = np.abs(found - self.level) < NEAR * self.step
            which = np.nonzero(near & (share > 0) & (share < 1))
            at = cells[which[0]], *which[1:]
            found[which] = self._bounded(found[which], wide, at, share[which[0], 0, 0])
            values[some] = found
        return values

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
