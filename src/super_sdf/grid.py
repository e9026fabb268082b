"""The coarse input: a regular grid of signed distances and where it lies in the world."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from math import isfinite
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import GridError
from .planes import PlaneFile, Samples

FloatArray: TypeAlias = NDArray[np.float32]
IntArray: TypeAlias = NDArray[np.int32]
BoolArray: TypeAlias = NDArray[np.bool_]
Triple: TypeAlias = tuple[float, float, float]

# The method works on cubes: axes whose spacing differs by less than this are taken as equal.
EQUAL_SPACING = 1e-3


@dataclass(frozen=True, eq=False, init=False)
class SdfGrid:
    """Signed distances at the points ``world = origin + spacing * (i, j, k)``.

    Parameters
    ----------
    values : (nx, ny, nz) array_like
        Signed distances in world units, negative inside; i runs along x, j along y, k along z. A
        mapped file stays one, and a ``PlaneFile``, too.
    spacing : float or three floats
        World distance between neighbouring samples; equal on all axes.
    origin : float or three floats
        World position of sample (0, 0, 0); the world's origin unless given.
    notes : tuple of str
        What was inferred rather than given, a sentence each.
    positive_inside : bool
        The values given are positive inside: read them with the other sign.

    Attributes
    ----------
    values : (nx, ny, nz) array
        All samples, negative inside. If they are in a file it is loaded when they are asked for,
        and they stay in memory; ``planes`` reads some.
    low, high : float
        The smallest and the largest of them.

    Raises
    ------
    GridError
        If the array is not three-dimensional, finite, and at least 2 samples long on each axis,
        or if the spacing is not positive and equal on all axes.
    """

    samples: Samples
    spacing: Triple
    origin: Triple
    notes: tuple[str, ...]
    positive_inside: bool
    low: float
    high: float

    def __init__(
        self,
        values: ArrayLike | PlaneFile,
        spacing: ArrayLike,
        origin: ArrayLike = 0.0,
        notes: tuple[str, ...] = (),
        *,
        positive_inside: bool = False,
        extremes: tuple[float, float] | None = None,
    ) -> None:
        samples = values if isinstance(values, PlaneFile) else np.asanyarray(values)
        low, high = extremes or check_values(samples)  # given: they were checked before
        set_ = partial(object.__setattr__, self)
        set_("samples", samples)
        set_("spacing", check_spacing(spacing))
        set_("origin", as_triple(origin, "origin"))
        set_("notes", notes)
        set_("positive_inside", positive_inside)
        set_("low", -high if positive_inside else low)
        set_("high", -low if positive_inside else high)

    @property
    def values(self) -> NDArray[Any]:
        """All samples, negative inside."""
        samples = self.samples
        whole = samples.loaded if isinstance(samples, PlaneFile) else samples
        return negated(whole) if self.positive_inside else whole

    def planes(self, first: int, last: int) -> NDArray[Any]:
        """Return the samples with i from ``first`` to before ``last``, negative inside."""
        samples = self.samples[first:last]
        return negated(samples) if self.positive_inside else samples

    @property
    def shape(self) -> tuple[int, int, int]:
        """Samples along x, y and z."""
        nx, ny, nz = self.samples.shape
        return nx, ny, nz

    @property
    def voxel_size(self) -> float:
        """The spacing h, in world units."""
        return sum(self.spacing) / 3


def negated(values: NDArray[Any]) -> NDArray[Any]:
    """Return the values with the other sign, unsigned integers among them."""
    return -values.astype(np.promote_types(values.dtype, np.float32))


def as_triple(number: ArrayLike, name: str) -> Triple:
    """Return one number or three as three finite floats."""
    try:
        triple = np.broadcast_to(np.asarray(number, np.float64).ravel(), (3,))
    except (TypeError, ValueError):
        raise GridError(f"{name} is {number!r}: give one number or three") from None
    if not np.isfinite(triple).all():
        raise GridError(f"{name} is {number!r}: it must be finite")
    return float(triple[0]), float(triple[1]), float(triple[2])


def check_spacing(spacing: ArrayLike) -> Triple:
    """Return the spacing as three floats; they must be positive and equal (within 0.1 %)."""
    triple = as_triple(spacing, "spacing")
    if min(triple) <= 0:
        raise GridError(f"spacing is {_join(triple)}: it must be greater than 0")
    if max(triple) > min(triple) * (1 + EQUAL_SPACING):
        raise GridError(
            f"spacing is {_join(triple)}: the method needs cubic voxels; "
            "resample the grid to one spacing on all axes"
        )
    return triple


def check_values(values: Samples) -> tuple[float, float]:
    """Return the smallest and largest sample of a finite, numeric, three-dimensional array."""
    check_kind(values.dtype, values.shape)
    return _find_extremes(values)


def check_kind(dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
    """Raise if an array of this type and shape holds no grid, whatever its values."""
    if dtype == np.bool_:
        raise GridError(
            "values are true or false: an occupancy grid holds no distances; "
            "make them with scipy.ndimage.distance_transform_edt"
        )
    if dtype.kind not in "fiu":
        raise GridError(f"values have dtype {dtype}: give floating-point or integer numbers")
    if len(shape) != 3:
        raise GridError(f"values have shape {shape}: give three axes (x, y, z)")
    if min(shape) < 2:
        raise GridError(f"values have shape {shape}: give at least 2 samples on each axis")


def _find_extremes(values: Samples) -> tuple[float, float]:
    """Return the smallest and the largest sample, or raise on the first NaN or infinity.

    Plane by plane, for the grid may be in a file. Extremes tell of bad samples, too: the
    smallest of numbers and a NaN is NaN.
    """
    extremes = []
    for i, plane in enumerate(values):
        low, high = float(plane.min()), float(plane.max())
        if not (isfinite(low) and isfinite(high)):
            j, k = np.argwhere(~np.isfinite(plane))[0]
            raise GridError(
                f"values[{i}, {j}, {k}] is {plane[j, k]}: every sample must be finite; "
                "replace unknown far samples by a large distance of the right sign"
            )
        extremes.append((low, high))
    lows, highs = zip(*extremes)
    return min(lows), max(highs)


def _join(triple: Triple) -> str:
    return ", ".join(f"{number:g}" for number in triple)
