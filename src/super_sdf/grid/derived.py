"""Samples made of others (masks, truncated and resampled distances), and of functions.

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

A function is sampled in cells of 8^3 spacings first, then in their eighths. A cell is left out if
even the steepest slope seen would not bring the values at its corners down to those of ``reach``
within it (Kalra and Barr, "Guaranteed ray intersections with implicit surfaces", 1989).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import combinations, product
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import CORNERS, BoolArray, FloatArray, IntArray, Triple
from ..threads import chunks_of
from .look import Extremes, Floats
from .samples import DerivedPlanes, SampleArray, SamplePlanes, in_spacings, over_three

REACH = 4  # voxels; patches are clipped to 3 (``steps.band.PATCH_LIMIT``), and half of one goes off

FEET_REACH = 3  # voxels from a sample up to which others are filled in with the help of its foot
FAR = 2.6  # voxels: the distance of a sample without a foot point near it
LEAST_SLOPE = 0.3  # of a sample whose foot point is used
DISC = np.float32(0.2)  # voxels
ROUNDS = 2
WITHIN = 1 - 1e-5  # share of the limit up to which a value is not cut off
CHUNK = 1 << 14  # samples that are worked on at a time, so that they stay in the cache
CUBES: Triple = (1.0, 1.0, 1.0)  # steps: spacings over the finest; the longest is a voxel

NEAR = 3.5  # new spacings from the surface, up to which values are kept within their bounds
ACROSS = 4  # samples across the line, from which on they do not bound a value
OFFSETS = [(j, k) for j, k in product(range(-ACROSS, ACROSS + 1), repeat=2) if j * j + k * k <= 16]
MARGIN = 2.0  # the slope is as near to the mean of the differences along the line as they are
STEEP_WALL = 0.25  # the least slope with which a field falls towards a wall and rises behind it
EXTRA = 2  # samples beyond a cell, on either side, that its slopes depend on
ON_SAMPLE = 1e-3  # spacings from a sample, up to which a new sample takes its value
MOST = 1e12  # spacings: larger values are cut off, so that squares do not overflow

STRIDE = 8  # spacings along the largest cells of a function; a power of two
AT_ONCE = 1 << 18  # samples
STEEPER = 1.25  # than seen between samples may the function be

Ints: TypeAlias = NDArray[np.int64]
Places: TypeAlias = tuple[NDArray[np.intp], ...]
At: TypeAlias = Callable[[NDArray[Any]], NDArray[Any]]
Cells: TypeAlias = NDArray[np.int32]  # (n, 3) the lowest sample of each


def mask_distances(inside: BoolArray) -> FloatArray:
    """Return distances to the boundary of a mask, in voxels, negative inside, of 0.5 to 3.5."""
    roots = np.sqrt(np.arange(REACH * REACH + 1, dtype=np.float32)) - np.float32(0.5)
    squared = _squared_distances(inside)
    np.copyto(squared, _squared_distances(~inside), where=inside)
    distances = np.empty(inside.shape, np.float32)
    for plane, numbers in zip(distances, squared):  # one by one, to save memory
        plane[...] = roots[numbers]
    return np.negative(distances, out=distances, where=inside)


def _squared_distances(marked: BoolArray) -> NDArray[np.uint8]:
    """Return the squared distance of each sample to the nearest marked one, at most ``REACH``^2."""
    squared = np.full(marked.shape, REACH * REACH, np.uint8)
    squared[marked] = 0
    for axis in range(3):
        before = np.moveaxis(squared, axis, 0)
        after = before.copy()
        for step in range(1, min(REACH, len(before))):
            np.minimum(after[step:], before[:-step] + np.uint8(step * step), out=after[step:])
            np.minimum(after[:-step], before[step:] + np.uint8(step * step), out=after[:-step])
        squared = np.moveaxis(after, 0, axis)
    return squared


def mask_planes(inside: SampleArray, h: float) -> DerivedPlanes:
    """Return the distances of a mask in world units; ``h`` is the spacing."""
    return DerivedPlanes(inside, lambda planes: _times(mask_distances(planes), h), REACH)


def extremes_of_masks(h: float) -> Extremes:
    """Return bounds of the distances of a mask."""
    return (0.5 - REACH) * h, (REACH - 0.5) * h


def filled_planes(values: SampleArray, spacing: Triple, limits: Extremes) -> DerivedPlanes:
    """Return truncated distances, cut off at ``limits``, with those that are missing filled in."""
    h = min(spacing)
    low, high = (limit / h for limit in limits)
    steps = (spacing[0] / h, spacing[1] / h, spacing[2] / h)
    beside = ROUNDS * (max(_reach(steps)[:2]) + 1)

    def make(planes: NDArray[Any]) -> Floats:
        return _times(fill_in(in_spacings(planes, h), low, high, steps), h)

    return DerivedPlanes(values, make, beside)


def without_inner_faces(values: SampleArray, inside: int, h: float) -> DerivedPlanes:
    """Return distances of which those inside, with none outside round them, are h at least.

    ``inside`` is their sign. Where parts of a solid touch, distances to its faces inside are less.
    """

    def make(planes: NDArray[Any]) -> Floats:
        near = over_three(planes * inside < 0, np.logical_or)
        deep = inside * np.maximum(np.abs(planes), h)
        return np.asarray(np.where(near, planes, deep), np.float64)

    return DerivedPlanes(values, make, 1)


def _times(values: FloatArray, h: float) -> Floats:
    return np.multiply(values, h, dtype=np.float64)


def _reach(steps: Triple) -> list[int]:
    return [int(FEET_REACH * max(steps) / step) for step in steps]


def fill_in(values: FloatArray, low: float, high: float, steps: Triple = CUBES) -> FloatArray:
    """Return distances in units of the finest spacing, (nx, ny, nz), filled in where cut off.

    The second round has better gradients: central differences to what the first one filled in.
    """
    cut = (values <= low * WITHIN) | (values >= high * WITHIN)
    known = np.argwhere(~cut).astype(np.int32)
    gradient = _gradient(values, known, steps, cut)
    for _ in range(ROUNDS):
        least = np.abs(np.where(values > 0, np.float32(high), np.float32(low)))
        distance = np.maximum(_distance_to_feet(values, known, gradient, cut, steps), least)
        values = np.where(cut, np.copysign(distance, values), values)
        gradient = _gradient(values, known, steps)
    return values


def _distance_to_feet(
    values: FloatArray, known: IntArray, gradient: FloatArray, cut: BoolArray, steps: Triple
) -> FloatArray:
    """Return the distance of each sample to the nearest foot point of the ``known``, (n, 3).

    It is ``FAR`` voxels at most. At a foot point the surface is taken as a disc: it goes on
    between them. Of equally near ones the lower disc counts, so that the order is no matter.
    """
    far, reach = np.float32(FAR * max(steps)), _reach(steps)
    margin = [(n, n) for n in reach]
    nearest = np.pad(np.where(cut, far, np.float32(0)), margin)
    discs = np.pad(np.full(cut.shape, far, np.float32), margin)
    flat, flat_discs = nearest.reshape(-1), discs.reshape(-1)
    strides = np.array([nearest.shape[1] * nearest.shape[2], nearest.shape[2], 1])
    box = np.indices([2 * n + 1 for n in reach]).reshape(3, -1).T - np.array(reach)
    apart = np.sqrt(((box * np.array(steps)) ** 2).sum(1)) / max(steps)
    offsets = box[(apart > 0) & (apart**2 <= (FEET_REACH + 0.3) ** 2)].astype(np.int32)
    slope = np.sqrt((gradient**2).sum(1, dtype=np.float32))
    steep = np.flatnonzero(slope > LEAST_SLOPE)
    for start in range(0, len(steep), CHUNK):
        rows = steep[start : start + CHUNK]
        normal = gradient[rows] / slope[rows, None]
        foot = np.ascontiguousarray((-values[tuple(known[rows].T)][:, None] * normal).T)
        at = np.ravel_multi_index(tuple((known[rows] + np.array(reach, np.int32)).T), nearest.shape)
        for offset in offsets:
            step, place = (offset * np.array(steps)).astype(np.float32), at + int(offset @ strides)
            x, y, z = step[:, None] - foot
            apart = np.sqrt(x * x + y * y + z * z)
            closer = np.flatnonzero(apart <= flat[place])
            x, y, z, apart, where = x[closer], y[closer], z[closer], apart[closer], place[closer]
            a, b, c = normal.T[:, closer]
            height = x * a + y * b + z * c
            aside = np.sqrt(np.maximum(apart**2 - height**2, 0))
            disc = np.hypot(height, np.maximum(aside - DISC, 0))
            lower = np.minimum(disc, flat_discs[where])
            flat_discs[where] = np.where(apart == flat[where], lower, disc)
            flat[where] = apart
    inner = tuple(slice(n, n + size) for n, size in zip(reach, cut.shape))
    return discs[inner]


def _gradient(
    values: FloatArray, at: IntArray, steps: Triple, cut: BoolArray | None = None
) -> FloatArray:
    """Return central differences at samples, (n, 3); one-sided ones at ends, and beside ``cut``.

    Amid two cut ones, the larger difference is a lower bound.
    """
    gradient = np.empty((len(at), 3), np.float32)
    centre = values[tuple(at.T)]
    for axis, step in enumerate(steps):
        before, after = list(at.T), list(at.T)
        before[axis] = np.maximum(at[:, axis] - 1, 0)
        after[axis] = np.minimum(at[:, axis] + 1, values.shape[axis] - 1)
        low, high = tuple(before), tuple(after)
        if cut is None:
            apart = (high[axis] - low[axis]) * np.float32(step)
            gradient[:, axis] = (values[high] - values[low]) / np.maximum(apart, np.float32(step))
            continue
        ahead, back = values[high] - centre, centre - values[low]
        no_ahead = cut[high] | (high[axis] == at[:, axis])
        no_back = cut[low] | (low[axis] == at[:, axis])
        larger = np.where(np.abs(ahead) > np.abs(back), ahead, back)
        one = np.where(no_ahead, np.where(no_back, larger, back), ahead)
        along = np.where(~no_ahead & ~no_back, (ahead + back) / 2, one)
        gradient[:, axis] = along / np.float32(step)
    return gradient


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


def sample_near(
    at: At, shape: tuple[int, ...], step: NDArray[Any], reach: float
) -> tuple[FloatArray, float]:
    """Return the samples of a function near its surface, and its value at ``reach`` from there.

    What was left out is infinite, with its sign.

    Parameters
    ----------
    at : callable
        Takes indices of samples, (n, 3), and returns the values there, (n,).
    shape : three int
        Samples along each axis.
    step : array, (3,)
        World distance between neighbouring samples along each axis.
    reach : float
        World distance from the surface; infinite for all samples.
    """
    samples = np.full(shape, np.nan, np.float32)
    last = np.array(shape, np.int32) - 1
    cells = (STRIDE * np.argwhere(np.ones(-(-last // STRIDE), bool))).astype(np.int32)
    stride, steepest = STRIDE, _steepest_at(samples, at, cells, step)
    while len(cells):
        sizes = np.minimum(stride, last - cells)  # on the border cells are smaller
        _evaluate(samples, at, (cells + sizes * corner for corner in CORNERS))
        if stride == 1:
            break
        corners = [cells + sizes * corner for corner in CORNERS]
        values = np.stack([samples[tuple(corner.T)] for corner in corners], 1)
        steepest = max(steepest, _steepest(values, sizes * step))
        least = STEEPER * steepest * (reach + stride / 2 * float(np.linalg.norm(step)))
        far = np.abs(values).min(1) > least  # not where a value is unknown
        for offset in np.ndindex((stride + 1,) * 3):  # what is far from the surface gets its side
            places = np.minimum(cells[far] + np.array(offset, np.int32), last)
            new = np.isnan(samples[tuple(places.T)])
            samples[tuple(places[new].T)] = np.copysign(np.inf, values[far, 0])[new]
        stride //= 2
        cells = (cells[~far, None] + stride * CORNERS).reshape(-1, 3)
        cells = cells[(cells < last).all(1)]
    return samples, steepest * reach if steepest else np.inf


def _steepest_at(samples: FloatArray, at: At, cells: Cells, step: NDArray[Any]) -> float:
    """Return the largest slope at the lowest samples of cells, by their neighbours on either side.

    Of the two slopes of a sample the lesser counts: beside a kink the other one is too large.
    """
    last, axes = np.array(samples.shape, np.int32) - 1, np.eye(3, dtype=np.int32)
    sides = [[np.clip(cells + side * axis, 0, last) for axis in axes] for side in (-1, 1)]
    _evaluate(samples, at, [cells, *sides[0], *sides[1]])
    rises = [[samples[tuple(c.T)] - samples[tuple(cells.T)] for c in side] for side in sides]
    with np.errstate(invalid="ignore"):
        slopes = [np.linalg.norm(np.stack(rise, 1) / step, axis=1) for rise in rises]
    on_border = ((cells == 0) | (cells == last)).any(1)  # has no neighbour on one side
    slope = np.where(on_border, np.maximum(*slopes), np.minimum(*slopes))
    return float(slope[np.isfinite(slope)].max(initial=0))


def _evaluate(samples: FloatArray, at: At, corners: Iterable[NDArray[Any]]) -> None:
    """Fill in the samples at corners that are not known yet."""
    wanted = np.zeros(samples.shape, bool)
    for corner in corners:
        wanted[tuple(corner.T)] = True
    places = np.flatnonzero(wanted & np.isnan(samples))
    for first in range(0, len(places), AT_ONCE):
        some = places[first : first + AT_ONCE]
        samples.reshape(-1)[some] = at(np.stack(np.unravel_index(some, samples.shape), 1))


def _steepest(values: NDArray[Any], sizes: NDArray[Any]) -> float:
    """Return the largest slope between two corners of a cell, from values (n, 8), sizes (n, 3)."""
    steepest = 0.0
    for one, other in combinations(range(8), 2):
        length = np.linalg.norm((CORNERS[one] - CORNERS[other]) * sizes, axis=1)
        with np.errstate(invalid="ignore"):  # between corners that were left out
            slopes = np.abs(values[:, one] - values[:, other]) / length
        steepest = max(steepest, float(slopes[np.isfinite(slopes)].max(initial=0)))
    return steepest
