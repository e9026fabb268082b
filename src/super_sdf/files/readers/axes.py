"""What files say of the axes of an array: names, units, steps and starts; its place and scale.

Arrays in HDF5, Zarr, NetCDF, MATLAB and TIFF share this, and the guard for parts that are not
stored.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from ...grid.samples import UNNAMED, even_steps
from ..volume import axes_direction, kept_axes, triple

SPACE = "xyz"
PREFIXES = {"k": 1e3, "": 1.0, "d": 1e-1, "c": 1e-2, "m": 1e-3, "u": 1e-6, "n": 1e-9, "p": 1e-12}
WORDS = ("kilo", "", "deci", "centi", "milli", "micro", "nano", "pico")  # in the same order
METRES = {f"{prefix}m": factor for prefix, factor in PREFIXES.items()} | {
    **{f"{word}m": factor for word, factor in zip(WORDS, PREFIXES.values())},
    **{"inch": 0.0254, "in": 0.0254, '"': 0.0254, "ft": 0.3048, "foot": 0.3048, "feet": 0.3048},
    **{"angstrom": 1e-10, "å": 1e-10, "mil": 2.54e-5, "thou": 2.54e-5},
}


class Axis(NamedTuple):
    """What a file says of an axis, "" or None where it does not."""

    name: str = ""
    unit: str = ""
    step: float | None = None  # from a sample to the next, below 0 along a falling axis
    start: float | None = None  # position of the first sample
    alias: str = ""  # another name, by an attribute of its coordinates


def in_metres(unit: str) -> float | None:
    """Return how many metres a unit is; None if it is no unit of length that is known here."""
    plain = re.sub("[\u00b5\u03bc]", "u", unit.strip())  # both letters are in use for micro
    if plain in METRES:
        return METRES[plain]
    word = re.sub(r"(?<=.)(?<!inche)s$|(?<=inch)es$", "", plain.lower())
    word = re.sub("met(er|re)$", "m", {"micron": "um"}.get(word, word))
    return METRES.get(word)


def in_one_unit(units: Sequence[str]) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """Return factors from the units of x, y and z to the first, None if unknown, and a note.

    An axis without a unit has that of the others.
    """
    stated = list(dict.fromkeys(filter(None, units)))
    if len(stated) <= 1:
        return np.ones(3), tuple(f"lengths are in the unit of its axes, {u}" for u in stated)
    listed = ", ".join(f"{name} {unit}" for name, unit in zip(SPACE, units) if unit)
    note = f"its axes have different units ({listed}): "
    metres = [in_metres(unit or stated[0]) for unit in units]
    if None in metres:
        asked = "spacing and origin are not taken from its metadata (give --spacing)"
        return None, (note + asked,)
    factors = np.array(metres, np.float64) / (in_metres(stated[0]) or 1)
    return factors, (f"{note}lengths are in {stated[0]}",)


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
    named = [names[axis] for axis in kept]
    is_named = order == "zyx" and _are_space(names)
    order = "".join(named) if is_named else order
    notes: tuple[str, ...] = ()
    world = [axes[kept[order.index(name)]] for name in SPACE]
    factors, told = in_one_unit([axis.unit for axis in world])
    notes += told
    if any(named) and not _are_space(names):
        listed = ", ".join(name or "?" for name in named)
        notes += (f"its axes are named {listed}: taken as {', '.join(order)}",)
    missing = [name for name, axis in zip(SPACE, world) if not axis.step]
    if 0 < len(missing) < 3:
        lacking = " and ".join(missing)
        notes += (
            f"it states no spacing along {lacking}: none is taken from it (give --spacing)",
        )
    direction = axes_direction(order).copy()
    direction *= [-1 if (axes[axis].step or 0) < 0 else 1 for axis in kept]
    steps = starts = None
    if factors is not None and not missing:
        steps = [abs(axis.step or 0) * factor for axis, factor in zip(world, factors)]
        if None not in [axis.start for axis in world]:
            starts = triple((axis.start or 0) * factor for axis, factor in zip(world, factors))
    steps = _stated(attributes, "spacing", steps)
    spacing = None if steps is None else triple(steps[SPACE.index(name)] for name in order)
    spacing = _stated(attributes, "element_size_um", spacing)
    if "direction" in attributes:
        said = np.asarray(attributes["direction"])
        if said.size != 9 or said.dtype.kind not in "fiu":
            raise FileError(f"its attribute direction is {said.tolist()!r}: give nine numbers")
        direction = said.reshape(3, 3) @ direction
    origin = _stated(attributes, "origin", starts)
    return {
        **{"spacing": spacing, "origin": origin, "direction": direction},
        **{"kept": kept, "notes": notes, "axes": order},
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
        raise FileError(
            f"its attribute {name} is {attributes[name]!r}: give one number or three"
        ) from None


def values_of(
    dtype: np.dtype[Any],
    attributes: dict[str, Any],
    missing: Any = None,
    absent: int = 0,
    total: int = 0,
    fill: Any = None,
) -> dict[str, Any]:
    """Return what a ``Volume`` says of values that are stored as other numbers, or not at all.

    By the conventions for climate and forecast data a value is ``scale_factor`` times the number,
    plus ``add_offset``; ``missing``, or ``_FillValue``, is no value.

    A file leaves out parts (chunks, strips) that hold nothing but its ``fill`` value: ``absent`` of
    ``total``. In masks and densities 0 is the background, but of signed distances it is the
    surface: those are refused. Any other fill value is as good as a stored one.
    """
    gaps = GridError(
        f"{absent:,} of its {total:,} chunks are not stored and read as 0, which is the surface: "
        "write them all, or give the array a fill value other than 0 (NaN for unknown)"
    )
    if absent and fill is None:
        raise gaps
    is_packed = "scale_factor" in attributes or "add_offset" in attributes
    is_packed |= dtype.kind == "f" and "_FillValue" in attributes
    factor = float(np.ravel(attributes.get("scale_factor", 1))[0])
    offset = float(np.ravel(attributes.get("add_offset", 0))[0])
    none = np.ravel(attributes.get("_FillValue", missing))
    kind = np.result_type(dtype, np.float32) if is_packed else dtype

    def convert(stored: NDArray[Any]) -> NDArray[Any]:
        if absent and fill == 0 and dtype.kind in "fi" and (stored < 0).any():
            raise gaps
        if not is_packed:
            return stored
        values: NDArray[Any] = (stored * factor + offset).astype(kind)
        values[np.isin(stored, none)] = np.nan
        return values

    return {"convert": convert, "converted": kind}
