"""Arrays of xarray: axes by name, spacing and origin from the coordinates.

xarray is not imported: whoever has a ``DataArray`` has imported it.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import GridError
from ..machine.memory import check_fits
from .planes import SamplePlanes
from .samples import check_kind

AXES = ("x", "y", "z")
UNNAMED = ("dim_0", "dim_1", "dim_2")  # xarray's names of dimensions that got none
EVEN = 1e-3  # of a step: how far coordinates may be from even ones, besides their rounding


@dataclass(frozen=True)
class Placed:
    """Samples with the axes x, y, z, and what their coordinates say: None where they say nothing.

    Attributes
    ----------
    values : (nx, ny, nz) array_like
        The samples, along increasing coordinates.
    spacing, origin : three floats, optional
        Distance of neighbouring samples along each axis, and the position of sample (0, 0, 0).
    """

    values: ArrayLike | SamplePlanes
    spacing: ArrayLike | None = None
    origin: ArrayLike | None = None


def placed(
    values: ArrayLike | SamplePlanes,
    spacing: ArrayLike | None = None,
    origin: ArrayLike | None = None,
) -> Placed:
    """Return samples and their place in the world; of a ``DataArray``, from its coordinates.

    A spacing or an origin that is given replaces that of the coordinates. Anything but an array of
    xarray is returned as it is.

    Raises
    ------
    GridError
        If the dimensions are not x, y and z in any order, besides some of length 1; if their
        coordinates are not evenly spaced numbers; if ``values`` is a ``Dataset``.
    OutOfMemoryError
        If the array is one of Dask and does not fit in memory.
    """
    xarray: Any = sys.modules.get("xarray")
    if xarray is None or not isinstance(values, (xarray.DataArray, xarray.Dataset)):
        return Placed(values, spacing, origin)
    if isinstance(values, xarray.Dataset):
        names = ", ".join(map(str, values.data_vars)) or "none"
        raise GridError(f"values are a Dataset: give one of its arrays ({names})")
    array = _axes_in_order(values)
    check_kind(array.dtype, array.shape)
    return _at_coordinates(array, spacing, origin)


def _axes_in_order(array: Any) -> Any:
    """Return an array with the dimensions x, y, z, or with those that have no names."""
    if array.ndim < len(AXES):
        check_kind(array.dtype, array.shape)  # raises
    wanted = UNNAMED if set(array.dims) == set(UNNAMED) else AXES
    extra = [name for name in array.dims if name not in wanted]
    for name in extra:
        if array.sizes[name] > 1 and set(wanted) <= set(array.dims):
            raise GridError(
                f"dimension {name!r} has length {array.sizes[name]:,}: choose one, such as "
                f"array.isel({name}=0)"
            )
    if not set(wanted) <= set(array.dims):
        raise GridError(
            f"dimensions are {', '.join(map(repr, array.dims)) or 'none'}: name those of the axes "
            "'x', 'y' and 'z', with array.rename(...)"
        )
    return array.isel(dict.fromkeys(extra, 0)).transpose(*wanted)


def _at_coordinates(array: Any, spacing: ArrayLike | None, origin: ArrayLike | None) -> Placed:
    """Return an array along increasing coordinates, and the place that they give it."""
    names = [name for name in array.dims if _has_coordinates(array, name)]
    samples = _loaded(array)
    if not names:
        return Placed(samples, spacing, origin)
    if len(names) < len(AXES):
        missing = next(name for name in array.dims if name not in names)
        raise GridError(
            f"dimension {missing!r} has no coordinates, but {names[0]!r} has: give those of all "
            "axes, or of none (array.drop_vars(...))"
        )
    firsts, steps = zip(*(even_steps(name, array.coords[name].values) for name in names))
    samples = samples[tuple(slice(None, None, -1 if step < 0 else 1) for step in steps)]
    lowest = [first + min(step, 0) * (n - 1) for first, step, n in zip(firsts, steps, array.shape)]
    return Placed(
        samples,
        np.abs(steps) if spacing is None else spacing,
        lowest if origin is None else origin,
    )


def _has_coordinates(array: Any, name: str) -> bool:
    """Return whether a dimension has coordinates of its own."""
    return name in array.coords and array.coords[name].dims == (name,)


def _loaded(array: Any) -> NDArray[Any]:
    """Return the values of an array; those of a file or of Dask are loaded."""
    if array.chunks is not None:
        check_fits(array.nbytes, "the array of Dask, whole,", "save it as .npy and give its path")
    samples: NDArray[Any] = np.asanyarray(array.values)
    return samples


def even_steps(name: str, coordinates: NDArray[Any]) -> tuple[float, float]:
    """Return the first of some coordinates, and the step from one to the next.

    Raises
    ------
    GridError
        If they are not numbers, or not evenly spaced.
    """
    if coordinates.dtype.kind not in "fiu":
        raise GridError(
            f"coordinates of {name!r} have dtype {coordinates.dtype}: give numbers, in the unit of "
            "the distances"
        )
    places = coordinates.astype(np.float64)
    bad = np.flatnonzero(~np.isfinite(places))
    if len(bad):
        raise GridError(
            f"coordinate {bad[0]} of {name!r} is {places[bad[0]]}: every coordinate must be finite"
        )
    first, count = float(places[0]), len(places)
    step = float(places[-1] - first) / (count - 1)
    off = np.abs(places - (first + step * np.arange(count))).max()
    if step == 0 or off > EVEN * abs(step) + _rounding(coordinates):
        raise GridError(_uneven(name, places))
    return first, step


def _rounding(coordinates: NDArray[Any]) -> float:
    """Return how far rounding may move coordinates of their type."""
    if coordinates.dtype.kind != "f":
        return 0.0
    return float(np.finfo(coordinates.dtype).eps * np.abs(coordinates).max())


def _uneven(name: str, places: NDArray[np.float64]) -> str:
    """Return what is wrong with coordinates that are not evenly spaced, naming the worst step."""
    steps = np.diff(places)
    usual = float(np.median(steps))
    worst = int(np.abs(steps - usual).argmax())
    return (
        f"coordinates of {name!r} are not evenly spaced: {places[worst]:.6g} is followed by "
        f"{places[worst + 1]:.6g}, a step of {steps[worst]:.6g} among steps of {usual:.6g}; "
        f"resample the array (array.interp({name}=...))"
    )
