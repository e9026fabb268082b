"""What arrays in HDF5, Zarr and TIFF share: place and scale by attributes, parts not stored."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arrays import Triple
from ...errors import FileError, GridError
from ..boxes import Box
from ..volume import in_array_order
from .axes import Axes

ReadBox = Callable[[Box], NDArray[Any]]


def placed(
    axes: Axes, attributes: dict[str, Any], shape: tuple[int, ...], order: str
) -> tuple[list[int], dict[str, Any]]:
    """Return the axes of an array that are in space, and what a ``Volume`` says of their place.

    Attributes replace what else is said: ``element_size_um``, as the HDF5 plugin of ImageJ writes
    it, has the order of the array's axes; ``spacing`` and ``origin`` are x, y, z. The columns of
    ``direction``, nine numbers row by row, are the world directions of the axes x, y and z.

    Parameters
    ----------
    axes : Axes
        What the file says of the array's axes.
    attributes : dict
        Those of the array.
    shape : tuple of int
        Its shape.
    order : {"zyx", "xyz"}
        The order of axes that have no names.
    """
    space = axes.in_space(shape)
    (spacing, origin, direction), notes = axes.place(space, order)
    named = axes.order(space, order)
    stated = _triple(attributes, "spacing")
    if "element_size_um" in attributes:
        spacing = _triple(attributes, "element_size_um")
    elif stated is not None:
        spacing = in_array_order(stated, named)
    found = {
        "spacing": spacing,
        "origin": _triple(attributes, "origin") or origin,
        "direction": _direction(attributes) @ direction,
        "notes": notes,
        "axes": named,
    }
    return space, found


def along(space: list[int], box: Sequence[slice], count: int) -> tuple[Any, ...]:
    """Return the index of a box along some axes of an array, at 0 of its others."""
    where: list[Any] = [0] * count
    for axis, part in zip(space, box):
        where[axis] = part
    return tuple(where)


def _direction(attributes: dict[str, Any]) -> NDArray[np.float64]:
    """Return the attribute ``direction``, the identity if there is none."""
    if "direction" not in attributes:
        return np.eye(3)
    try:
        return np.asarray(attributes["direction"], np.float64).reshape(3, 3)
    except (TypeError, ValueError):
        raise FileError(
            f"its attribute direction is {attributes['direction']!r}: give nine numbers"
        ) from None


def _triple(attributes: dict[str, Any], name: str) -> Triple | None:
    """Return an attribute of one number or three; None if there is none of this name."""
    if name not in attributes:
        return None
    try:
        x, y, z = np.broadcast_to(np.asarray(attributes[name], np.float64).ravel(), 3)
    except (TypeError, ValueError):
        raise FileError(
            f"its attribute {name} is {attributes[name]!r}: give one number or three"
        ) from None
    return float(x), float(y), float(z)


def without_gaps(read_box: ReadBox, absent: int, total: int, fill: Any) -> ReadBox:
    """Return ``read_box``, which refuses signed samples if parts that are not stored read as 0.

    A file leaves out parts that hold nothing but its fill value. In masks and densities 0 is the
    background, but of signed distances it is the surface. Any other fill value is as good as a
    stored one.

    Parameters
    ----------
    read_box : callable
        Returns a box of samples.
    absent, total : int
        How many parts (chunks, strips) of the array are not stored, of how many.
    fill : number or None
        What they read as; None if the file does not say.

    Raises
    ------
    GridError
        Now, if ``fill`` is None; else when a negative sample is read.
    """
    gaps = GridError(
        f"{absent:,} of its {total:,} chunks are not stored and read as 0, which is the surface: "
        "write them all, or give the array a fill value other than 0 (NaN for unknown)"
    )
    if absent and fill is None:
        raise gaps

    def read(box: Box) -> NDArray[Any]:
        samples = read_box(box)
        if samples.dtype.kind in "fi" and (samples < 0).any():
            raise gaps
        return samples

    return read if absent and fill == 0 else read_box


def unscaled(
    read_box: ReadBox, dtype: np.dtype[Any], attributes: dict[str, Any], missing: Any = None
) -> tuple[ReadBox, np.dtype[Any]]:
    """Return ``read_box`` for values that are stored as other numbers, and their type.

    By the conventions for climate and forecast data a value is ``scale_factor`` times the number,
    plus ``add_offset``; ``missing``, or ``_FillValue``, is no value.
    """
    names = "scale_factor", "add_offset"
    has_gaps = dtype.kind == "f" and "_FillValue" in attributes
    if not has_gaps and not any(name in attributes for name in names):
        return read_box, dtype
    numbers = (np.ravel(attributes.get(name, i)) for name, i in zip(names, (1, 0)))
    factor, offset = (float(number[0]) for number in numbers)
    none = np.ravel(attributes.get("_FillValue", missing))
    kind = np.result_type(dtype, np.float32)

    def read(box: Box) -> NDArray[Any]:
        stored = read_box(box)
        values = (stored * factor + offset).astype(kind)
        values[np.isin(stored, none)] = np.nan
        return values

    return read, kind
