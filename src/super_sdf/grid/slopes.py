"""A field of any slope brought to distances near its surface by its local slope.

The value over the length of the gradient is the distance to first order, and 0 where the value is.
The slope is the mean over the samples around, weighted by how well it is known: at a kink the
central difference is too short.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from .planes import DerivedPlanes, SampleArray, in_spacings

AROUND = 2  # samples to either side over which slopes are averaged
TYPICAL_ERROR = 0.1  # of a slope, relative: half the weight
LEAST_WEIGHT = 1e-3
SLOPE_BYTES = 60  # per sample, measured
FLAT, STEEP = 0.25, 4.0  # local slopes over the typical one
NEARLY = 0.2  # from 1: slopes nearer to it count as 1, since dividing by them overshoots


def normalised_planes(values: SampleArray, h: float, change: float) -> DerivedPlanes:
    """Return values over their local slope, made plane by plane: distances on the lattice.

    Parameters
    ----------
    values : (nx, ny, nz) array or Planes
        Samples.
    h : float
        What a step of the lattice is in the result: the spacing.
    change : float
        The typical change of the values from sample to sample.
    """

    def make(planes: NDArray[Any]) -> FloatArray:
        scaled = in_spacings(planes, change)
        off = local_slopes(scaled) - 1
        far: FloatArray = np.sign(off) * np.maximum(np.abs(off) - NEARLY, 0)
        return np.divide(scaled, 1 + far)

    return DerivedPlanes(values, make, AROUND + 2, unit=h, each=SLOPE_BYTES)


def local_slopes(values: FloatArray) -> FloatArray:
    """Return the mean length of the gradient round each sample, (nx, ny, nz).

    ``values`` are in spacings of their typical slope, so that results are about 1.
    """
    padded = (
        np.pad(values, 2, mode="reflect", reflect_type="odd") if min(values.shape) > 2 else None
    )
    if padded is None:
        return np.ones_like(values)
    square, bend = np.zeros_like(values), np.zeros_like(values)
    for axis in range(3):
        lines = np.moveaxis(padded, axis, 0)
        a, b, c, d, e = (
            np.moveaxis(lines[step : len(lines) - 4 + step], 0, axis) for step in range(5)
        )
        inner = tuple(slice(None) if other == axis else slice(2, -2) for other in range(3))
        a, b, c, d, e = (part[inner] for part in (a, b, c, d, e))
        square += ((d - b) / 2) ** 2
        bend += np.abs(e - 4 * d + 6 * c - 4 * b + a)
    length = np.clip(np.sqrt(square), FLAT, STEEP)
    weight = 1 / (1 + (bend / (TYPICAL_ERROR * length)) ** 2) + LEAST_WEIGHT
    trust: FloatArray = np.asarray(weight, np.float32)
    total: FloatArray = np.asarray(trust * length, np.float32)
    return np.divide(box_sum(total), box_sum(trust))


def box_sum(values: FloatArray) -> FloatArray:
    """Return the sum over the samples up to ``AROUND`` away along each axis."""
    for axis in range(3):
        lines = np.moveaxis(values, axis, 0)
        total = lines.copy()
        for step in range(1, AROUND + 1):
            total[step:] += lines[:-step]
            total[:-step] += lines[step:]
        values = np.moveaxis(total, 0, axis)
    return values
