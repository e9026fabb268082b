"""What files say of the axes of an array, and what is made of it: its place, and its values.

Arrays in HDF5, Zarr, NetCDF, MATLAB and TIFF share this.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ...grid.samples import UNNAMED, as_triple, even_steps
from . import Index, Loading, Request, axes_direction, kept_of, of_array, stated_place, triple

SPACE = ("x", "y", "z")


class Axis(NamedTuple):
    """What a file says of an axis, "" or None where it does not."""

    name: str = ""
    unit: str = ""
    step: float | None = None  # from a sample to the next, below 0 along a falling axis
    start: float | None = None  # position of the first sample


def one_unit(units: Sequence[str]) -> tuple[bool, tuple[str, ...]]:
    """Return whether x, y and z have the same unit of length, or none; and a note that names it."""
    listed = ", ".join(dict.fromkeys(filter(None, units)))
    if ", " in listed:
        said = f"its axes have different units ({listed})"
        return False, (f"{said}: spacing and origin are not taken from it (give --spacing)",)
    return True, (f"lengths are in the unit that it states, {listed}",) * bool(listed)


def measured(name: str, count: int, scale: Any, about: Mapping[str, Any]) -> Axis:
    """Return an axis by its name and a scale, if there is one of its length, with attributes.

    The scale has the coordinates, which must be evenly spaced, or all the same, if none are known.
    By the conventions for climate and forecast data an axis may be ``positive: down``, and ``axis``
    may name it.
    """
    places = np.asarray(scale[:] if getattr(scale, "shape", ()) == (count,) else [0])
    if places[0] == places[-1]:
        return Axis(name)
    start, step = even_steps(name, places)
    unit, alias, positive = (
        said.decode() if isinstance(said, bytes) else str(said)
        for said in (about.get(key, "") for key in ("units", "axis", "positive"))
    )
    sign = -1 if positive.lower() == "down" else 1
    is_named = name.lower() in SPACE or alias.lower() not in SPACE
    return Axis(name if is_named else alias, unit, sign * step, sign * start)


def placed(
    request: Request,
    axes: Sequence[Axis],
    attributes: Mapping[str, Any],
    shape: Sequence[int],
    order: str = "",
) -> dict[str, Any]:
    """Return what a ``Volume`` says of the place of an array: which axes are kept, and where.

    Attributes replace what ``axes`` says: ``element_size_um``, of ImageJ's HDF5 plugin, has the
    order of the array's axes; ``spacing``, ``origin`` and the columns of ``direction`` are x, y, z.
    ``order`` is that of axes without names.
    """
    names = ["" if axis.name in UNNAMED else axis.name.strip().lower() for axis in axes]
    in_space = [n for n, name in enumerate(names) if name in SPACE]
    is_named = sorted(names[n] for n in in_space) == list(SPACE)
    index = request.pick(shape, in_space if is_named else None, names)
    kept, order = kept_of(index), order or request.axes
    notes = tuple[str, ...]()
    if is_named and order == "zyx":
        order = "".join(names[n] for n in kept)
    elif not is_named and any(names[n] for n in kept):
        called = ", ".join(names[n] or "?" for n in kept)
        notes = (f"its axes are named {called}: taken as {', '.join(order)}",)
    world = [axes[kept[order.index(name)]] for name in SPACE]
    is_one, told = one_unit([axis.unit for axis in world])
    spacing = origin = None
    if is_one and all(axis.step for axis in world):
        spacing = triple(abs(axes[n].step or 0) for n in kept)
        starts = [axis.start for axis in world]
        origin = None if None in starts else triple(starts)
    if "element_size_um" in attributes:
        spacing = as_triple(attributes["element_size_um"], "element_size_um")
    signs = [-1 if (axes[n].step or 0) < 0 else 1 for n in kept]
    place = {"spacing": spacing, "origin": origin, "direction": axes_direction(order) * signs}
    stated = {"place": stated_place(attributes), "notes": notes + told}
    return {**place, **stated, "index": index, "axes": order}


def stored(values: Any, attributes: Mapping[str, Any], none: Any = None) -> Loading:
    """Return how a ``Volume`` loads an array of a file.

    By the conventions for climate and forecast data a value is ``scale_factor`` times the number,
    plus ``add_offset``; ``none``, or ``_FillValue``, is no value.
    """
    dtype = np.dtype(values.dtype)
    is_packed = "scale_factor" in attributes or "add_offset" in attributes
    is_packed |= dtype.kind == "f" and "_FillValue" in attributes
    if not is_packed:
        return of_array(values)
    factor = float(np.ravel(attributes.get("scale_factor", 1))[0])
    offset = float(np.ravel(attributes.get("add_offset", 0))[0])
    missing = np.ravel(attributes.get("_FillValue", none))
    kind = np.result_type(dtype, np.float32)

    def load(index: Index) -> Any:
        numbers = np.asarray(values[index])
        unpacked = (numbers * factor + offset).astype(kind)
        unpacked[np.isin(numbers, missing)] = np.nan
        return unpacked

    return load, tuple(values.shape), kind
