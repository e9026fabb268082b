"""What files say of the axes of an array, and what is made of it: its place, and its values.

Arrays in HDF5, Zarr, NetCDF, MATLAB and TIFF share this.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ...errors import FileError, GridError
from ...grid.samples import UNNAMED, even_steps
from ..volume import axes_direction, kept_axes, triple

SPACE = "xyz"


class Axis(NamedTuple):
    """What a file says of an axis, "" or None where it does not."""

    name: str = ""
    unit: str = ""
    step: float | None = None  # from a sample to the next, below 0 along a falling axis
    start: float | None = None  # position of the first sample
    alias: str = ""  # another name, by an attribute of its coordinates


def one_unit(units: Sequence[str]) -> tuple[bool, tuple[str, ...]]:
    """Return whether x, y and z have the same unit of length, or none; and a note that names it."""
    stated = list(dict.fromkeys(filter(None, units)))
    if len(stated) <= 1:
        return True, tuple(f"lengths are in the unit of its axes, {unit}" for unit in stated)
    listed = ", ".join(f"{name} {unit}" for name, unit in zip(SPACE, units) if unit)
    said = f"its axes have different units ({listed}): spacing and origin are not taken from it"
    return False, (f"{said} (give --spacing)",)


def measured(name: str, places: Any, about: dict[str, Any]) -> Axis:
    """Return an axis by its coordinates, which must be evenly spaced, and their attributes."""
    if places is None or len(places) < 2:
        return Axis(name)
    start, step = even_steps(name, np.asarray(places))
    unit, alias = (
        said.decode() if isinstance(said, bytes) else str(said)
        for said in (about.get("units", ""), about.get("axis", ""))
    )
    return Axis(name, unit, step, start, alias)


def placed(
    axes: Sequence[Axis], attributes: dict[str, Any], shape: Sequence[int], order: str
) -> dict[str, Any]:
    """Return what a ``Volume`` says of the place of an array: which axes are kept, and where.

    Attributes replace what ``axes`` says: ``element_size_um``, as the HDF5 plugin of ImageJ writes
    it, has the order of the array's axes; ``spacing`` and ``origin`` are x, y, z. The columns of
    ``direction``, nine numbers row by row, are the world directions of the axes x, y and z.
    ``order`` is that of axes that have no names.
    """
    names = ["" if axis.name in UNNAMED else axis.name.strip().lower() for axis in axes]
    aliases = [(axis.alias or name).strip().lower() for axis, name in zip(axes, names)]
    names = aliases if _are_space(aliases) and not _are_space(names) else names
    kept = _kept(names, shape)
    named, notes = [names[axis] for axis in kept], []
    if order == "zyx" and _are_space(names):
        order = "".join(named)
    elif any(named) and not _are_space(names):
        listed = ", ".join(name or "?" for name in named)
        notes = [f"its axes are named {listed}: taken as {', '.join(order)}"]
    world = [axes[kept[order.index(name)]] for name in SPACE]
    is_one, told = one_unit([axis.unit for axis in world])
    missing = [name for name, axis in zip(SPACE, world) if not axis.step]
    if 0 < len(missing) < 3:
        lacking = " and ".join(missing)
        told += (f"it states no spacing along {lacking}: none is taken from it (give --spacing)",)
    steps = starts = None
    if is_one and not missing:
        steps = [abs(axis.step or 0) for axis in world]
        if None not in [axis.start for axis in world]:
            starts = triple(axis.start for axis in world)
    steps = _stated(attributes, "spacing", steps)
    spacing = None if steps is None else triple(steps[SPACE.index(name)] for name in order)
    direction = axes_direction(order) * [-1 if (axes[n].step or 0) < 0 else 1 for n in kept]
    if "direction" in attributes:
        said = np.asarray(attributes["direction"])
        if said.size != 9 or said.dtype.kind not in "fiu":
            raise FileError(f"its attribute direction is {said.tolist()!r}: give nine numbers")
        direction = said.reshape(3, 3) @ direction
    return {
        "spacing": _stated(attributes, "element_size_um", spacing),
        "origin": _stated(attributes, "origin", starts),
        **{"direction": direction, "kept": kept, "axes": order, "notes": (*notes, *told)},
    }


def _are_space(names: Sequence[str]) -> bool:
    return sorted(name for name in names if name in tuple(SPACE)) == list(SPACE)


def _kept(names: Sequence[str], shape: Sequence[int]) -> tuple[int, ...]:
    """Return the axes of an array that are in space, in order; others must have length 1."""
    if len(shape) < len(SPACE):
        raise GridError(f"values have shape {tuple(shape)}: give three axes (x, y, z)")
    kept = list(kept_axes(shape))
    if _are_space(names):
        kept = [axis for axis, name in enumerate(names) if name in tuple(SPACE)]
    kept = sorted(sorted(kept, key=lambda axis: (shape[axis], axis))[-len(SPACE) :])
    for axis, count in enumerate(shape):
        if axis not in kept and count != 1:
            raise GridError(
                f"its axis {names[axis] or axis} has {count} entries, and a grid has "
                "three axes in space: store one of them as an array of its own"
            )
    return tuple(kept)


def _stated(attributes: dict[str, Any], name: str, default: Any) -> Any:
    if name not in attributes:
        return default
    try:
        return triple(np.broadcast_to(np.asarray(attributes[name], np.float64).ravel(), 3))
    except (TypeError, ValueError):
        said = f"its attribute {name} is {attributes[name]!r}"
        raise FileError(f"{said}: give one number or three") from None


def stored(
    values: Any, attributes: dict[str, Any], none: Any = None, absent: int = 0, fill: Any = None
) -> tuple[Callable[[], Any], tuple[int, ...], np.dtype[Any]]:
    """Return how a ``Volume`` loads an array of a file, its shape, and the type of the values.

    By the conventions for climate and forecast data a value is ``scale_factor`` times the number,
    plus ``add_offset``; ``none``, or ``_FillValue``, is no value. Chunks that are not stored,
    ``absent`` in number, read as ``fill``: 0 is the background of masks and densities, but the
    surface of signed distances, which are refused.
    """
    dtype = np.dtype(values.dtype)
    is_packed = "scale_factor" in attributes or "add_offset" in attributes
    is_packed |= dtype.kind == "f" and "_FillValue" in attributes
    factor = float(np.ravel(attributes.get("scale_factor", 1))[0])
    offset = float(np.ravel(attributes.get("add_offset", 0))[0])
    missing = np.ravel(attributes.get("_FillValue", none))
    kind = np.result_type(dtype, np.float32) if is_packed else dtype

    def load() -> Any:
        numbers = np.asarray(values[...])
        if absent and not fill and dtype.kind in "fi" and (numbers < 0).any():
            raise GridError(
                f"{absent:,} of its chunks are not stored and read as 0, which is the surface: "
                "write them all, or give the array a fill value other than 0 (NaN for unknown)"
            )
        if not is_packed:
            return numbers
        unpacked = (numbers * factor + offset).astype(kind)
        unpacked[np.isin(numbers, missing)] = np.nan
        return unpacked

    return load, tuple(values.shape), kind
