"""Checks that an array can hold the samples of a grid: numeric, three-dimensional."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import GridError, seen
from .planes import SampleArray, SamplePlanes


def as_samples(values: ArrayLike | SamplePlanes) -> SampleArray:
    """Return samples as an array; ``SamplePlanes`` are returned as they are.

    Raises
    ------
    GridError
        If they make no array.
    """
    if isinstance(values, SamplePlanes):
        return values
    try:
        samples = np.asanyarray(values)
    except (TypeError, ValueError, RuntimeError):  # ragged lists, tensors on a GPU
        raise GridError(f"values are {seen(values)}: give an array of three axes") from None
    return _unmasked(samples) if hasattr(samples, "mask") else samples  # to name it takes 7 ms


def _unmasked(samples: NDArray[Any]) -> NDArray[Any]:
    """Return the data of a masked array, NaN where it is masked: unknown."""
    masked = np.ma.getmaskarray(samples)
    if not masked.any() or samples.dtype.kind not in "fiu":
        return np.asarray(np.ma.filled(samples, False) if masked.any() else samples.data)
    data = np.array(samples.data, np.result_type(samples.dtype, np.float32))
    data[masked] = np.nan
    return data


def check_kind(dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
    """Raise GridError if an array of this type and shape cannot be a grid."""
    if dtype.kind not in "fiub":
        raise GridError(f"values have dtype {dtype}: give floating-point or integer numbers")
    if len(shape) != 3:
        raise GridError(f"values have shape {shape}: give three axes (x, y, z)")
    if min(shape) < 2:
        raise GridError(f"values have shape {shape}: give at least 2 samples on each axis")
