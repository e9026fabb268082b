"""The coarse input: a regular grid of signed distances and where it lies in the world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import GridError

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
        Signed distances in world units, negative inside; i runs along x, j along y, k along z.
    spacing : float or three floats
        World distance between neighbouring samples; equal on all axes.
    origin : float or three floats
        World position of sample (0, 0, 0); the world's origin unless given.
    notes : tuple of str
        What was inferred rather than given, a sentence each.

    Raises
    ------
    GridError
        If the array is not three-dimensional, finite, and at least 2 samples long on each axis,
        or if the spacing is not positive and equal on all axes.
    """

    values: NDArray[Any]
    spacing: Triple
    origin: Triple
    notes: tuple[str, ...]

    def __init__(
        self,
        values: ArrayLike,
        spacing: ArrayLike,
        origin: ArrayLike = 0.0,
        notes: tuple[str, ...] = (),
    ) -> None:
        object.__setattr__(self, "values", check_values(np.asanyarray(values)))
        object.__setattr__(self, "spacing", check_spacing(spacing))
        object.__setattr__(self, "origin", as_triple(origin, "origin"))
        object.__setattr__(self, "notes", notes)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Samples along x, y and z."""
        nx, ny, nz = self.values.shape
        return nx, ny, nz

    @property
    def voxel_size(self) -> float:
        """The spacing h, in world units."""
        return sum(self.spacing) / 3


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


def check_values(values: NDArray[Any]) -> NDArray[Any]:
    """Return the samples if they are a finite, numeric, three-dimensional array."""
    if values.dtype == np.bool_:
        raise GridError(
            "values are true or false: an occupancy grid holds no distances; "
            "make them with scipy.ndimage.distance_transform_edt"
        )
    if values.dtype.kind not in "fiu":
        raise GridError(f"values have dtype {values.dtype}: give floating-point or integer numbers")
    if values.ndim != 3:
        raise GridError(f"values have shape {values.shape}: give three axes (x, y, z)")
    if min(values.shape) < 2:
        raise GridError(f"values have shape {values.shape}: give at least 2 samples on each axis")
    if values.dtype.kind == "f":
        _check_finite(values)
    return values


def _check_finite(values: NDArray[Any]) -> None:
    """Raise on the first NaN or infinity; plane by plane, for the grid may be a mapped file."""
    for i, plane in enumerate(values):
        bad = np.argwhere(~np.isfinite(plane))
        if len(bad):
            j, k = bad[0]
            raise GridError(
                f"values[{i}, {j}, {k}] is {plane[j, k]}: every sample must be finite; "
                "replace unknown far samples by a large distance of the right sign"
            )


def _join(triple: Triple) -> str:
    return ", ".join(f"{number:g}" for number in triple)
