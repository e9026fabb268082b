"""Distances made of others: those of a mask, and truncated ones filled in.

A mask only says which samples are inside. Its surface passes half-way between a sample inside and
one outside, for want of better knowledge. So the distance of a sample is that to the nearest sample
of the other side, less half a voxel: the Euclidean distance transform of both sides, exact up to
``REACH`` voxels and constant beyond, since farther samples do not matter to the surface.

Of a truncated field, a sample x with distance d and gradient n touches the surface at the foot
point x - d n. The distance of a sample that was cut off is that to the nearest foot point of the
others, and no less than where it was cut off.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray, Triple
from .look import Extremes, Floats
from .samples import DerivedPlanes, SampleArray, in_spacings

REACH = 4  # voxels; patches are clipped to 3 (``steps.band.PATCH_LIMIT``), and half of one goes off

FEET_REACH = 3  # voxels from a sample up to which others are filled in with the help of its foot
FAR = 2.6  # voxels: the distance of a sample without a foot point near it
LEAST_SLOPE = 0.3  # of a sample whose foot point is used
DISC = np.float32(0.2)  # voxels
ROUNDS = 2
WITHIN = 1 - 1e-5  # share of the limit up to which a value is not cut off
CHUNK = 1 << 14  # samples that are worked on at a time, so that they stay in the cache
CUBES: Triple = (1.0, 1.0, 1.0)  # steps: spacings over the finest; the longest is a voxel


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
