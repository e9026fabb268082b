"""The axes of an array by what a file says of them: names, units, steps and where they begin."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arrays import Triple
from ...errors import GridError
from ...grid.placement import UNNAMED, even_steps
from ..headers import kept_axes
from ..volume import axes_direction

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
    found = next((WORDS[start] + "m" for start in WORDS if word == f"{start}m"), word)
    return METRES.get(found)


def in_one_unit(units: Sequence[str]) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """Return factors from the units of x, y and z to the first that is stated, and a note on it.

    No factors are returned if that is not possible. An axis without a unit has that of the others.
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
    """The axes of an array, in order; for each what the file says, "" or None where it does not.

    Attributes
    ----------
    names, units : tuple of str
    steps, starts : tuple of floats or None
        Distance from a sample to the next, below 0 along a falling axis, and position of the first.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    steps: tuple[float | None, ...]
    starts: tuple[float | None, ...]

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
        found: Callable[[int], tuple[NDArray[Any] | None, dict[str, Any]]],
    ) -> Axes:
        """Return the axes of an array by their coordinates.

        ``found`` returns those of an axis in space, or None, and their attributes, of which
        ``axis`` names an axis that has another name, and ``units`` states the unit.

        Raises
        ------
        GridError
            If coordinates are not evenly spaced numbers, or as in ``in_space``.
        """
        axes, called = cls.named(names), list(names)
        units, steps, starts = (list(each) for each in (axes.units, axes.steps, axes.starts))
        for axis in axes.in_space(shape):
            places, about = found(axis)
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
        """Return the axes of an array that are in space, in order; the others have length 1.

        Raises
        ------
        GridError
            If the array has fewer than three axes, or more that are longer than 1.
        """
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
        origin = None if None in starts else _triple(known * factors)
        lengths = np.abs(np.array([self.steps[axis] for axis in space], np.float64))
        return (_triple(lengths * (np.abs(direction).T @ factors)), origin, direction), notes


def _text(attributes: dict[str, Any], name: str) -> str:
    """Return an attribute as text, "" if there is none."""
    found = attributes.get(name, "")
    return found.decode() if isinstance(found, bytes) else str(found)


def _triple(numbers: Any) -> Triple:
    x, y, z = (float(number) for number in numbers)
    return x, y, z
