"""Checks that an array can hold the samples of a grid: numeric, three-dimensional, finite."""

from __future__ import annotations

from functools import partial
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import GridError, seen
from .planes import SampleArray, SamplePlanes, in_blocks, over_planes

MASK_HINT = "a mask holds no distances; make a grid of it with make_grid or read_grid"

Extremes = tuple[float, float]
"""The smallest and the largest sample."""


def as_samples(values: ArrayLike | SamplePlanes) -> SampleArray:
    """Return samples as an array; ``SamplePlanes`` are returned as they are.

    Raises
    ------
    GridError
        If they make no array, or some are masked.
    """
    if isinstance(values, SamplePlanes):
        return values
    try:
        samples = np.asanyarray(values)
    except (TypeError, ValueError, RuntimeError):  # ragged lists, tensors on a GPU
        raise GridError(f"values are {seen(values)}: give an array of three axes") from None
    if hasattr(samples, "mask"):  # to name numpy.ma would import it, for 7 ms
        return _unmasked(samples)
    return samples


def _unmasked(samples: NDArray[Any]) -> NDArray[Any]:
    """Return the data of a masked array, if nothing in it is masked."""
    masked = np.argwhere(np.ma.getmaskarray(samples))
    if len(masked):
        first = ", ".join(map(str, masked[0]))
        raise GridError(
            f"{len(masked):,} values are masked, values[{first}] the first: every sample must be "
            "known; fill unknown far ones with a large distance of the right sign (filled())"
        )
    return np.asarray(samples.data)


def check_values(values: SampleArray) -> Extremes:
    """Return the smallest and the largest sample.

    Raises
    ------
    GridError
        If the array is not numeric and three-dimensional, or a sample is not finite.
    """
    check_kind(values.dtype, values.shape)
    if values.dtype == np.bool_:
        raise GridError(f"values are true or false: {MASK_HINT}")
    extremes = find_extremes(values)
    if extremes is None:
        raise not_finite(values)
    return extremes


def check_kind(dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
    """Raise GridError if an array of this type and shape cannot be a grid."""
    if dtype.kind not in "fiub":
        raise GridError(f"values have dtype {dtype}: give floating-point or integer numbers")
    if len(shape) != 3:
        raise GridError(f"values have shape {shape}: give three axes (x, y, z)")
    if min(shape) < 2:
        raise GridError(f"values have shape {shape}: give at least 2 samples on each axis")


def find_extremes(values: SampleArray) -> Extremes | None:
    """Return the smallest and the largest sample, None if one is NaN or infinite.

    It is read plane by plane, since the grid may be in a file. The extremes also reveal bad
    samples: the minimum of numbers and a NaN is NaN.
    """
    extremes: list[Extremes] = []
    for found in over_planes(values, _extremes_of, in_blocks(values)):
        if found is None:
            return None
        extremes.append(found)
    lows, highs = zip(*extremes)
    return min(lows), max(highs)


def _extremes_of(planes: NDArray[Any]) -> Extremes | None:
    """Return the smallest and the largest of some samples, None if one is not finite."""
    extremes = []
    for plane in planes:
        low, high = float(plane.min()), float(plane.max())
        if not (isfinite(low) and isfinite(high)):
            return None
        extremes.append((low, high))
    lows, highs = zip(*extremes)
    return min(lows), max(highs)


def not_finite(values: SampleArray) -> GridError:
    """Return the error for samples of which some are NaN or infinite, which names the first."""
    with np.errstate(over="ignore", invalid="ignore"):  # of long doubles
        bad = (np.argwhere(~np.isfinite(plane.astype(np.float64))) for plane in values)
        i, (j, k) = next((i, places[0]) for i, places in enumerate(bad) if len(places))
    return GridError(
        f"values[{i}, {j}, {k}] is {values[i][j, k]!s}: every sample must be finite; "
        "replace unknown far samples by a large distance of the right sign"
    )


def check_not_flat(values: SampleArray, extremes: Extremes) -> None:
    """Raise GridError if the values are constant or a mask."""
    check_not_constant(extremes)
    if has_two_values(values, extremes):
        raise GridError(f"the only values are {extremes[0]:.6g} and {extremes[1]:.6g}: {MASK_HINT}")


def check_not_constant(extremes: Extremes) -> None:
    """Raise GridError if all values are the same."""
    low, high = extremes
    if low == high:
        raise GridError(f"every value is {low:.6g}: a constant field has no surface")


def has_two_values(values: SampleArray, extremes: Extremes) -> bool:
    """Return whether there are only two different values; False for grids of 2 samples an axis."""
    are_two = partial(_are_extreme, extremes)
    first, rest = in_blocks(values)[:1], in_blocks(values)[1:]  # the first mostly shows it
    return min(values.shape) > 2 and all(
        all(over_planes(values, are_two, ranges)) for ranges in (first, rest)
    )


def _are_extreme(extremes: Extremes, planes: NDArray[Any]) -> bool:
    """Return whether all samples of some planes are the smallest or the largest of the grid."""
    low, high = extremes
    return all(bool(((plane == low) | (plane == high)).all()) for plane in planes)
