"""Distances that were cut off near the surface: the missing ones are filled in.

A sample x with distance d and gradient n touches the surface at the foot point x - d n. The
distance of a sample that was cut off is that to the nearest foot point of the others, and no less
than where it was cut off.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray, Triple
from .census import Extremes
from .planes import DerivedPlanes, SampleArray, in_spacings

REACH = 3  # voxels from a sample up to which others are filled in with the help of its foot point
FAR = 2.6  # voxels: the distance of a sample without a foot point near it
LEAST_SLOPE = 0.3  # of a sample whose foot point is used
DISC = np.float32(0.2)  # voxels
ROUNDS = 2
RINGS = 2  # of samples amid a plateau that are raised, so that they lie beyond the band
WITHIN = 1 - 1e-5  # share of the limit up to which a value is not cut off
FILL_BYTES = 40  # per sample, measured
CHUNK = 1 << 14  # samples that are worked on at a time, so that they stay in the cache
CUBES: Triple = (
    1.0,
    1.0,
    1.0,
)  # steps: spacings over the finest; a voxel is as long as the longest


def filled_planes(values: SampleArray, spacing: Triple, limits: Extremes) -> DerivedPlanes:
    """Return truncated distances with those that are missing filled in, made plane by plane.

    ``values`` and ``spacing`` are in world units, ``limits`` the lowest and the highest value,
    where they were cut off.
    """
    h = min(spacing)
    low, high = (limit / h for limit in limits)
    steps = (spacing[0] / h, spacing[1] / h, spacing[2] / h)

    def make(planes: NDArray[Any]) -> FloatArray:
        return fill_in(in_spacings(planes, h), low, high, steps)

    beside = ROUNDS * (max(_reach(steps)[:2]) + 1)
    return DerivedPlanes(values, make, beside, unit=h, each=FILL_BYTES)


def _reach(steps: Triple) -> list[int]:
    """Return how many samples along each axis the farthest offset is."""
    return [int(REACH * max(steps) / step) for step in steps]


def without_plateaus(values: SampleArray, limits: Extremes, h: float) -> DerivedPlanes:
    """Return truncated distances, larger where all samples round one were cut off alike.

    They are too far from the surface to matter, however near it they were cut off. From sample to
    sample they change by no more than the spacing h, as distances do.
    """

    def make(planes: NDArray[Any]) -> NDArray[np.float64]:
        raised = planes.astype(np.float64)
        for limit in limits:
            amid = planes == limit
            for _ in range(RINGS):
                amid = _all_around(amid)
                raised[amid] += np.sign(limit) * h
        return raised

    return DerivedPlanes(values, make, RINGS)


def _all_around(marked: BoolArray) -> BoolArray:
    """Return which samples and the up to 26 round them are all marked."""
    for axis in range(3):
        lines = np.moveaxis(marked, axis, 0)
        among = lines.copy()
        among[1:] &= lines[:-1]
        among[:-1] &= lines[1:]
        marked = np.moveaxis(among, 0, axis)
    return marked


def fill_in(values: FloatArray, low: float, high: float, steps: Triple = CUBES) -> FloatArray:
    """Return distances in units of the finest spacing, (nx, ny, nz), filled in where cut off.

    The second round has better gradients: central differences to what the first one filled in.
    """
    cut = (values <= low * WITHIN) | (values >= high * WITHIN)
    known = np.argwhere(~cut).astype(np.int32)
    gradient = _gradient_within(values, cut, known, steps)
    for _ in range(ROUNDS):
        least = np.abs(np.where(values > 0, np.float32(high), np.float32(low)))
        distance = np.maximum(_distance_to_feet(values, known, gradient, cut, steps), least)
        values = np.where(cut, np.copysign(distance, values), values)
        gradient = _gradient_at(values, known, steps)
    return values


def _distance_to_feet(
    values: FloatArray, known: IntArray, gradient: FloatArray, cut: BoolArray, steps: Triple
) -> FloatArray:
    """Return the distance of each sample that was ``cut`` off to the nearest foot point of another.

    It is ``FAR`` voxels at most. At a foot point the surface is taken as a disc of radius ``DISC``:
    it goes on between them. ``known`` (n, 3) are the others, ``gradient`` (n, 3) is theirs.
    """
    far, reach = np.float32(FAR * max(steps)), _reach(steps)
    margin = [(n, n) for n in reach]
    nearest = np.pad(np.where(cut, far, np.float32(0)), margin)
    discs = np.pad(np.full(cut.shape, far, np.float32), margin)
    box = np.indices([2 * n + 1 for n in reach]).reshape(3, -1).T - np.array(reach)
    apart = np.sqrt(((box * np.array(steps)) ** 2).sum(1)) / max(steps)
    offsets = box[(apart > 0) & (apart**2 <= (REACH + 0.3) ** 2)].astype(np.int32)
    slope = np.sqrt((gradient**2).sum(1, dtype=np.float32))
    steep = np.flatnonzero(slope > LEAST_SLOPE)
    for start in range(0, len(steep), CHUNK):
        rows = steep[start : start + CHUNK]
        normal = gradient[rows] / slope[rows, None]
        foot = np.ascontiguousarray((-values[tuple(known[rows].T)][:, None] * normal).T)
        at = np.ravel_multi_index(tuple((known[rows] + np.array(reach, np.int32)).T), nearest.shape)
        for offset in offsets:
            step = (offset * np.array(steps)).astype(np.float32)
            _approach(nearest, discs, at, offset, step[:, None] - foot, normal.T)
    inner = tuple(slice(n, n + size) for n, size in zip(reach, cut.shape))
    return discs[inner]


def _approach(
    nearest: FloatArray,
    discs: FloatArray,
    at: NDArray[np.intp],
    offset: IntArray,
    way: FloatArray,
    normal: FloatArray,
) -> None:
    """Take the samples at an offset from some nearer to the surface by the foot points of these.

    ``nearest`` and ``discs`` have the distance to the nearest foot point so far, and to its disc;
    they are changed in place. ``at`` says where the samples are in these, ``way`` (3, n) is from
    their foot points to the samples at the offset, ``normal`` (3, n) their gradient's direction.
    """
    flat, flat_discs = nearest.reshape(-1), discs.reshape(-1)
    strides = np.array([nearest.shape[1] * nearest.shape[2], nearest.shape[2], 1])
    place = at + int(offset @ strides)
    x, y, z = way
    apart = np.sqrt(x * x + y * y + z * z)
    closer = np.flatnonzero(apart <= flat[place])
    x, y, z, apart = x[closer], y[closer], z[closer], apart[closer]
    a, b, c = normal[:, closer]
    height = x * a + y * b + z * c
    aside = np.sqrt(np.maximum(apart**2 - height**2, 0))
    disc, where = np.hypot(height, np.maximum(aside - DISC, 0)), place[closer]
    alike = apart == flat[where]  # the lower disc, so that the order is no matter
    flat_discs[where] = np.where(alike, np.minimum(disc, flat_discs[where]), disc)
    flat[where] = apart


def _gradient_at(values: FloatArray, at: IntArray, steps: Triple) -> FloatArray:
    """Return central differences at some samples, (n, 3); one-sided ones at the ends."""
    gradient = np.empty((len(at), 3), np.float32)
    for axis, step in enumerate(steps):
        low, high = _ends(at, axis, values.shape[axis])
        apart = (high[axis] - low[axis]) * np.float32(step)
        gradient[:, axis] = (values[high] - values[low]) / np.maximum(apart, np.float32(step))
    return gradient


def _gradient_within(values: FloatArray, cut: BoolArray, at: IntArray, steps: Triple) -> FloatArray:
    """Return gradients at some samples, (n, 3), by differences to neighbours that were not cut off.

    Where both were, the larger difference is a lower bound.
    """
    gradient = np.empty((len(at), 3), np.float32)
    centre = values[tuple(at.T)]
    for axis, step in enumerate(steps):
        low, high = _ends(at, axis, values.shape[axis])
        ahead, back = values[high] - centre, centre - values[low]
        no_ahead = cut[high] | (high[axis] == at[:, axis])
        no_back = cut[low] | (low[axis] == at[:, axis])
        larger = np.where(np.abs(ahead) > np.abs(back), ahead, back)
        one = np.where(no_ahead, np.where(no_back, larger, back), ahead)
        along = np.where(~no_ahead & ~no_back, (ahead + back) / 2, one)
        gradient[:, axis] = along / np.float32(step)
    return gradient


def _ends(at: IntArray, axis: int, count: int) -> list[tuple[NDArray[Any], ...]]:
    """Return the indices of the samples before and after some along an axis of ``count``."""
    low, high = list(at.T), list(at.T)
    low[axis], high[axis] = np.maximum(at[:, axis] - 1, 0), np.minimum(at[:, axis] + 1, count - 1)
    return [tuple(low), tuple(high)]
