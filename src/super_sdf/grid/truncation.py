"""Distances that were cut off near the surface: the missing ones are filled in.

A sample x with distance d and gradient n touches the surface at the foot point x - d n. The
distance of a sample that was cut off is that to the nearest foot point of the others, and no less
than where it was cut off.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from .planes import DerivedPlanes, SampleArray, in_spacings
from .samples import Extremes

REACH = 3  # voxels from a sample up to which others are filled in with the help of its foot point
FAR = 2.6  # voxels: the distance of a sample without a foot point near it
LEAST_SLOPE = 0.3  # of a sample whose foot point is used
DISC = np.float32(0.2)  # voxels
ROUNDS = 2
WITHIN = 1 - 1e-5  # share of the limit up to which a value is not cut off

OFFSETS: IntArray = np.indices((2 * REACH + 1,) * 3).reshape(3, -1).T.astype(np.int32) - REACH
OFFSETS = OFFSETS[(OFFSETS**2).sum(1) <= (REACH + 0.3) ** 2]


def filled_planes(values: SampleArray, h: float, limits: Extremes) -> DerivedPlanes:
    """Return truncated distances with those that are missing filled in, made plane by plane.

    Parameters
    ----------
    values : (nx, ny, nz) array or Planes
        Distances in world units.
    h : float
        The spacing.
    limits : two floats
        Where they were cut off: the lowest and the highest value.
    """
    low, high = (limit / h for limit in limits)

    def make(planes: NDArray[Any]) -> NDArray[np.float64]:
        return fill_in(in_spacings(planes, h), low, high).astype(np.float64) * h

    return DerivedPlanes(values, make, ROUNDS * (REACH + 1))


def fill_in(values: FloatArray, low: float, high: float) -> FloatArray:
    """Return distances in voxels, (nx, ny, nz), filled in where they were cut off.

    The second round has better gradients: central differences to what the first one filled in.
    """
    cut = (values <= low * WITHIN) | (values >= high * WITHIN)
    least = np.abs(np.where(values > 0, high, low)).astype(np.float32)
    gradient = gradient_within(values, cut)
    for _ in range(ROUNDS):
        distance = np.maximum(distance_to_feet(values, gradient, cut), least)
        values = np.where(cut, np.copysign(distance, values), values)
        parts = [np.asarray(part, np.float32) for part in np.gradient(values)]
        gradient = np.stack(parts, -1)
    return values


def distance_to_feet(values: FloatArray, gradient: FloatArray, cut: BoolArray) -> FloatArray:
    """Return the distance of each sample to the surface at its nearest foot point, ``FAR`` at most.

    At a foot point the surface is taken as a disc of radius ``DISC``: it goes on between them.
    """
    slope = np.sqrt((gradient**2).sum(-1, dtype=np.float32))
    ijk = np.argwhere(~cut & (slope > LEAST_SLOPE))
    at = tuple(ijk.T)
    normal = gradient[at] / slope[at][:, None]
    foot = -values[at][:, None] * normal
    nearest = np.pad(np.full(values.shape, FAR, np.float32), REACH, constant_values=FAR)
    found = nearest.copy()
    for offset in OFFSETS:
        place = tuple((ijk + offset + REACH).T)
        step = offset.astype(np.float32) - foot
        square = step[:, 0] ** 2 + step[:, 1] ** 2 + step[:, 2] ** 2
        closer = square < nearest[place] ** 2
        where = tuple(axis[closer] for axis in place)
        step, square, facing = step[closer], square[closer], normal[closer]
        height = step[:, 0] * facing[:, 0] + step[:, 1] * facing[:, 1] + step[:, 2] * facing[:, 2]
        aside = np.sqrt(np.maximum(square - height**2, 0))
        nearest[where] = np.sqrt(square)
        found[where] = np.hypot(height, np.maximum(aside - DISC, 0))
    return found[REACH:-REACH, REACH:-REACH, REACH:-REACH]


def gradient_within(values: FloatArray, cut: BoolArray) -> FloatArray:
    """Return gradients, (nx, ny, nz, 3), by differences to neighbours that were not cut off.

    Where both were, the larger difference is a lower bound.
    """
    gradient = np.zeros((*values.shape, 3), np.float32)
    for axis in range(3):
        lines, missing = np.moveaxis(values, axis, 0), np.moveaxis(cut, axis, 0)
        change = np.diff(lines, axis=0)
        edge = np.zeros((1, *lines.shape[1:]), np.float32)
        ahead, back = np.concatenate([change, edge]), np.concatenate([edge, change])
        beyond = np.ones((1, *lines.shape[1:]), bool)
        no_ahead = np.concatenate([missing[1:], beyond])
        no_back = np.concatenate([beyond, missing[:-1]])
        larger = np.where(np.abs(ahead) > np.abs(back), ahead, back)
        one = np.where(no_ahead, np.where(no_back, larger, back), ahead)
        both = ~no_ahead & ~no_back
        along = np.where(both, (ahead + back) / 2, one)
        np.moveaxis(gradient[..., axis], axis, 0)[:] = along
    return gradient
