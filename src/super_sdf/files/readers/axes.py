"""What files say of the axes of an array, and what is made of it: its place, and its values.

Arrays in HDF5, Zarr, NetCDF, MATLAB and TIFF share this.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from math import prod
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Triple
from ...errors import FileError, GridError, seen
from ...grid.samples import UNNAMED, even_steps
from . import Index, Request, axes_direction, kept_of, triple

SPACE = ("x", "y", "z")
STATED = ("spacing", "origin", "direction", "element_size_um")
SIZES = re.compile(r"resolution|offset|voxel|pixel|extent|ext(min|max)\d|spacing|origin|size", re.I)
"""Names of attributes that may state sizes, of which only ``STATED`` are read."""


class Axis(NamedTuple):
    """What a file says of an axis, "" or None where it does not."""

    name: str = ""
    unit: str = ""
    step: float | None = None  # from a sample to the next, below 0 along a falling axis
    start: float | None = None  # position of the first sample
    alias: str = ""  # another name, by an attribute of its coordinates
    is_down: bool = False  # the file's coordinates grow downwards; step and start are those upwards


def in_unit(unit: str) -> tuple[str, ...]:
    """Return a note on the unit that a file states, if it does."""
    return (f"lengths are in the unit that it states, {unit}",) * bool(unit)


def one_unit(units: Sequence[str]) -> tuple[bool, tuple[str, ...]]:
    """Return whether x, y and z have the same unit of length, or none; and a note that names it."""
    stated = list(dict.fromkeys(filter(None, units)))
    if len(stated) <= 1:
        return True, tuple(f"lengths are in the unit of its axes, {unit}" for unit in stated)
    listed = ", ".join(f"{name} {unit}" for name, unit in zip(SPACE, units) if unit)
    said = f"its axes have different units ({listed}): spacing and origin are not taken from it"
    return False, (f"{said} (give --spacing)",)


def measured(name: str, places: Any, about: dict[str, Any]) -> Axis:
    """Return an axis by its coordinates, which must be evenly spaced, and their attributes.

    By the conventions for climate and forecast data an axis may be ``positive: down``.
    """
    if places is None or len(places) < 2:
        return Axis(name)
    start, step = even_steps(name, np.asarray(places))
    unit, alias, positive = (
        said.decode() if isinstance(said, bytes) else str(said)
        for said in (about.get(key, "") for key in ("units", "axis", "positive"))
    )
    sign = -1 if positive.lower() == "down" else 1
    return Axis(name, unit, sign * step, sign * start, alias, sign < 0)


def placed(
    request: Request,
    axes: Sequence[Axis],
    attributes: dict[str, Any],
    shape: Sequence[int],
    order: str = "",
    beside: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Return what a ``Volume`` says of the place of an array: which axes are kept, and where.

    Attributes replace what ``axes`` says: ``element_size_um``, of ImageJ's HDF5 plugin, has the
    order of the array's axes; ``spacing``, ``origin`` and the columns of ``direction`` are x, y, z.
    ``order`` is that of axes without names. With ``beside``, attributes elsewhere in the file,
    notes say what was not read.
    """
    names = ["" if axis.name in UNNAMED else axis.name.strip().lower() for axis in axes]
    aliases = [axis.alias.strip().lower() or name for axis, name in zip(axes, names)]
    names = names if _space_in(names) or not _space_in(aliases) else aliases
    index = request.pick(shape, _space_in(names), names)
    kept, order = kept_of(index), order or request.axes
    named, notes = [names[axis] for axis in kept], list[str]()
    if any(named) and not _space_in(names):
        called = ", ".join(name or "?" for name in named)
        notes = [f"its axes are named {called}: taken as {', '.join(order)}"]
    elif any(named) and order == "zyx":
        order = "".join(named)
    elif beside is not None and not any(named) and not request.axes_given:
        notes = ["its axes have no names: taken as z, y, x (--axes xyz is the other order)"]
    world = [axes[kept[order.index(name)]] for name in SPACE]
    notes += [f"its {each.name} grows downwards: turned" for each in world if each.is_down]
    is_one, told = one_unit([axis.unit for axis in world])
    lacking = " and ".join(name for name, axis in zip(SPACE, world) if not axis.step)
    if any(axis.step for axis in world) and lacking:
        told += (f"it states no spacing along {lacking}: none is taken from it (give --spacing)",)
    is_known = is_one and not lacking
    steps = _stated(attributes, "spacing", [abs(axis.step or 0) for axis in world], is_known)
    starts = [axis.start for axis in world]
    origin = _stated(attributes, "origin", starts, is_known and None not in starts)
    along = [steps[SPACE.index(name)] for name in order] if steps else None
    spacing = _stated(attributes, "element_size_um", along, bool(along))
    direction = axes_direction(order) * [-1 if (axes[n].step or 0) < 0 else 1 for n in kept]
    if "direction" in attributes:
        said = np.asarray(attributes["direction"])
        if said.size != 9 or said.dtype.kind not in "fiu":
            raise FileError(f"its attribute direction is {said.tolist()!r}: give nine numbers")
        direction = said.reshape(3, 3) @ direction
    if beside is not None and spacing is None:
        told += _unread({**beside, **attributes})
    place = {"spacing": spacing, "origin": origin, "direction": direction, "index": index}
    return {**place, "axes": order, "notes": (*notes, *told)}


def _unread(attributes: dict[str, Any]) -> tuple[str, ...]:
    """Return a note on attributes that may state sizes; letters stored one by one are a word."""
    unread = []
    for name, said in attributes.items():
        if SIZES.search(name) and name not in STATED:
            array = np.asarray(said)
            letters = array.ravel().tolist() if array.dtype.kind == "S" else None
            word = b"".join(letters).decode(errors="replace") if letters else array.tolist()
            unread.append(f"{name} {seen(word)}")
    listed = ", ".join(unread)
    return (f"it states {listed}, which is not read (give --spacing and --origin)",) * bool(listed)


def _space_in(names: Sequence[str]) -> list[int] | None:
    """Return which names are x, y and z, None unless each is there once."""
    found = [n for n, name in enumerate(names) if name in SPACE]
    return found if sorted(names[n] for n in found) == list(SPACE) else None


def _stated(attributes: dict[str, Any], name: str, default: Any, is_known: bool) -> Triple | None:
    """Return three numbers that an attribute states, or the default, if that is known."""
    if name not in attributes:
        return triple(default) if is_known else None
    try:
        return triple(np.broadcast_to(np.asarray(attributes[name], np.float64).ravel(), 3))
    except (TypeError, ValueError):
        said = f"its attribute {name} is {attributes[name]!r}"
        raise FileError(f"{said}: give one number or three") from None


def stored(
    values: Any, attributes: dict[str, Any], none: Any = None, chunks: int = 0, fill: Any = None
) -> tuple[Callable[[Index], Any], tuple[int, ...], np.dtype[Any]]:
    """Return how a ``Volume`` loads an array of a file, its shape, and the type of the values.

    By the conventions for climate and forecast data a value is ``scale_factor`` times the number,
    plus ``add_offset``; ``none``, or ``_FillValue``, is no value. If it has chunks, and fewer than
    all are stored (``chunks``), the others read as ``fill``: 0 is the background of masks and
    densities, but the surface of signed distances, which are refused.
    """
    dtype, absent = np.dtype(values.dtype), 0
    if sizes := getattr(values, "chunks", None):
        absent = prod(-(-n // of_chunk) for n, of_chunk in zip(values.shape, sizes)) - chunks
    is_packed = "scale_factor" in attributes or "add_offset" in attributes
    is_packed |= dtype.kind == "f" and "_FillValue" in attributes
    factor = float(np.ravel(attributes.get("scale_factor", 1))[0])
    offset = float(np.ravel(attributes.get("add_offset", 0))[0])
    missing = np.ravel(attributes.get("_FillValue", none))
    kind = np.result_type(dtype, np.float32) if is_packed else dtype

    def load(index: Index) -> Any:
        numbers = np.asarray(values[index])
        if absent > 0 and not fill and dtype.kind in "fi" and (numbers < 0).any():
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
