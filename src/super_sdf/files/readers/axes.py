"""What files say of an array: names, units, steps and starts of its axes, its place and scale.

Arrays in HDF5, Zarr, NetCDF, MATLAB and TIFF share this, and the guard for parts that are not
stored.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arrays import Triple
from ...errors import FileError, GridError
from ...grid.placement import UNNAMED, even_steps
from ..volume import Box, ReadBox, axes_direction, kept_axes, triple

SPACE = "xyz"
PREFIXES = {"k": 1e3, "": 1.0, "d": 1e-1, "c": 1e-2, "m": 1e-3, "u": 1e-6, "n": 1e-9, "p": 1e-12}
WORDS = {"kilo": "k", "deci": "d", "centi": "c", "milli": "m", "micro": "u"}
WORDS |= {"nano": "n", "pico": "p"}
METRES = {f"{prefix}m": factor for prefix, factor in PREFIXES.items()} | {
    **{"inch": 0.0254, "in": 0.0254, '"': 0.0254, "ft": 0.3048, "foot": 0.3048, "feet": 0.3048},
    **{"angstrom": 1e-10, "å": 1e-10, "mil": 2.54e-5, "thou": 2.54e-5},
}
Place = tuple[Triple | None, Triple | None, NDArray[np.float64]]


def in_metres(unit: str) -> float | None:
    """Return how many metres a unit is; None if it is no unit of length that is known here."""
    plain = re.sub("[\u00b5\u03bc]", "u", unit.strip())  # both letters are in use for micro
    if plain in METRES:
        return METRES[plain]
    word = re.sub(r"(?<=.)(?<!inche)s$|(?<=inch)es$", "", plain.lower())
    word = re.sub("met(er|re)$", "m", {"micron": "um"}.get(word, word))
    symbol = next((WORDS[start] + "m" for start in WORDS if word == f"{start}m"), word)
    return METRES.get(symbol)


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


@dataclass(frozen=True)
class Axes:
    """The axes of an array, in order; for each what the file says, "" or None where it does not."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    steps: tuple[float | None, ...]  # from a sample to the next, below 0 along a falling axis
    starts: tuple[float | None, ...]  # positions of the first sample

    @classmethod
    def named(
        cls, names: Sequence[str], units: Any = None, steps: Any = None, starts: Any = None
    ) -> Axes:
        """Return axes with these names; what is not given is not stated."""
        none = (None,) * len(names)
        plain = tuple("" if name in UNNAMED else name.strip().lower() for name in names)
        return cls(plain, units or ("",) * len(names), steps or none, starts or none)

    @classmethod
    def of_coordinates(
        cls,
        names: Sequence[str],
        shape: Sequence[int],
        coordinates: Callable[[int], tuple[NDArray[Any] | None, dict[str, Any]]],
    ) -> Axes:
        """Return the axes of an array by their coordinates, which must be evenly spaced.

        ``coordinates`` returns those of an axis in space, or None, and their attributes, of which
        ``axis`` names an axis that has another name, and ``units`` states the unit.
        """
        axes, called = cls.named(names), list(names)
        units, steps, starts = (list(each) for each in (axes.units, axes.steps, axes.starts))
        for axis in axes.in_space(shape):
            places, about = coordinates(axis)
            if places is None or len(places) < 2:
                continue
            starts[axis], steps[axis] = even_steps(names[axis], places)
            units[axis], called[axis] = _text(about, "units"), _text(about, "axis") or names[axis]
        stated = tuple(units), tuple(steps), tuple(starts)
        made = cls.named(called, *stated)
        return made if made.are_in_space and not axes.are_in_space else cls.named(names, *stated)

    @property
    def are_in_space(self) -> bool:
        """Whether x, y and z are among them."""
        return sorted(name for name in self.names if name in tuple(SPACE)) == list(SPACE)

    def in_space(self, shape: Sequence[int]) -> list[int]:
        """Return the axes of an array that are in space, in order; others must have length 1."""
        if len(shape) < len(SPACE):
            raise GridError(f"values have shape {tuple(shape)}: give three axes (x, y, z)")
        space = kept_axes(shape)
        if self.are_in_space:
            space = [axis for axis, name in enumerate(self.names) if name in tuple(SPACE)]
        space = sorted(sorted(space, key=lambda axis: (shape[axis], axis))[-len(SPACE) :])
        for axis, count in enumerate(shape):
            if axis not in space and count != 1:
                raise GridError(
                    f"its axis {self.names[axis] or axis} has {count} entries, and a grid has "
                    "three axes in space: store one of them as an array of its own"
                )
        return space

    def order(self, space: list[int], axes: str) -> str:
        """Return the names x, y, z of the axes in space: the file's unless others are given."""
        if axes != "zyx" or not self.are_in_space:
            return axes
        return "".join(self.names[axis] for axis in space)

    def place(self, space: list[int], axes: str) -> tuple[Place, tuple[str, ...]]:
        """Return spacing along the axes in space, origin and direction, and notes on them."""
        direction = axes_direction(self.order(space, axes)).copy()
        world = [space[column] for column in direction.argmax(1)]  # of x, y and z
        factors, notes = in_one_unit([self.units[axis] for axis in world])
        named = [self.names[axis] for axis in space]
        if any(named) and not self.are_in_space:
            listed = ", ".join(name or "?" for name in named)
            notes += (f"its axes are named {listed}: taken as {', '.join(axes)}",)
        steps = [self.steps[axis] for axis in space]
        direction *= [-1 if step and step < 0 else 1 for step in steps]
        missing = [SPACE[i] for i, axis in enumerate(world) if not self.steps[axis]]
        if 0 < len(missing) < 3:
            notes += (
                f"it states no spacing along {' and '.join(missing)}: none is taken from it "
                "(give --spacing)",
            )
        if factors is None or missing:
            return (None, None, direction), notes
        starts = [self.starts[axis] for axis in world]
        known = [0.0 if start is None else start for start in starts]
        origin = None if None in starts else triple(known * factors)
        lengths = np.abs(np.array([self.steps[axis] for axis in space], np.float64))
        return (triple(lengths * (np.abs(direction).T @ factors)), origin, direction), notes


def _text(attributes: dict[str, Any], name: str) -> str:
    stated = attributes.get(name, "")
    return stated.decode() if isinstance(stated, bytes) else str(stated)


def placed(
    axes: Axes, attributes: dict[str, Any], shape: tuple[int, ...], order: str
) -> tuple[list[int], dict[str, Any]]:
    """Return the axes of an array that are in space, and what a ``Volume`` says of their place.

    Attributes replace what ``axes`` says: ``element_size_um``, as the HDF5 plugin of ImageJ writes
    it, has the order of the array's axes; ``spacing`` and ``origin`` are x, y, z. The columns of
    ``direction``, nine numbers row by row, are the world directions of the axes x, y and z.
    ``order`` is that of axes that have no names.
    """
    space = axes.in_space(shape)
    (spacing, origin, direction), notes = axes.place(space, order)
    named = axes.order(space, order)
    stated = _stated_triple(attributes, "spacing")
    if "element_size_um" in attributes:
        spacing = _stated_triple(attributes, "element_size_um")
    elif stated is not None:
        spacing = triple(stated["xyz".index(name)] for name in named)
    if "direction" in attributes:
        try:
            direction = np.asarray(attributes["direction"], np.float64).reshape(3, 3) @ direction
        except (TypeError, ValueError):
            raise FileError(
                f"its attribute direction is {attributes['direction']!r}: give nine numbers"
            ) from None
    return space, {
        "spacing": spacing,
        "origin": _stated_triple(attributes, "origin") or origin,
        "direction": direction,
        "notes": notes,
        "axes": named,
    }


def _stated_triple(attributes: dict[str, Any], name: str) -> Triple | None:
    if name not in attributes:
        return None
    try:
        return triple(np.broadcast_to(np.asarray(attributes[name], np.float64).ravel(), 3))
    except (TypeError, ValueError):
        raise FileError(
            f"its attribute {name} is {attributes[name]!r}: give one number or three"
        ) from None


def along(space: list[int], box: Sequence[slice], count: int) -> tuple[Any, ...]:
    """Return the index of a box along some axes of an array, at 0 of its others."""
    where: list[Any] = [0] * count
    for axis, part in zip(space, box):
        where[axis] = part
    return tuple(where)


def without_gaps(read_box: ReadBox, absent: int, total: int, fill: Any) -> ReadBox:
    """Return ``read_box``, which refuses signed samples if parts that are not stored read as 0.

    A file leaves out parts that hold nothing but its fill value. In masks and densities 0 is the
    background, but of signed distances it is the surface. Any other fill value is as good as a
    stored one; None, if the file does not say which, is refused at once. ``absent`` of ``total``
    parts (chunks, strips) are not stored.
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
