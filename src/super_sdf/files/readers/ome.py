"""OME-NGFF metadata of Zarr groups, versions 0.4 and 0.5: levels, axes, units, spacing and origin.

Reference: https://ngff.openmicroscopy.org/0.5/, ``multiscales`` metadata.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arrays import Triple
from ...errors import FileError, GridError

SPACE = "xyz"
MOST_AXES = 5  # time, channel, and three of space
Place = tuple[Triple | None, Triple | None, NDArray[np.float64]]


@dataclass(frozen=True)
class Image:
    """An image at several levels of resolution; one of them is read.

    Attributes
    ----------
    axes : tuple of str
        The names of the axes of its arrays.
    units : tuple of str
        Their units, "" where none is stated.
    levels : tuple of str
        The arrays, the finest first.
    steps : tuple of dict
        The coordinate transformations of the level that is read, in order.
    is_placed : bool
        Whether the metadata states where the samples are.
    """

    axes: tuple[str, ...]
    units: tuple[str, ...]
    levels: tuple[str, ...] = ()
    steps: tuple[dict[str, Any], ...] = ()
    is_placed: bool = True

    @classmethod
    def of_array(cls, count: int, axes: str) -> Image:
        """Return what is known of an array without such metadata: space is along its last axes."""
        return cls(("",) * (count - 3) + tuple(axes), ("",) * count, is_placed=False)

    def space_of(self, shape: Sequence[int], axes: str) -> list[int]:
        """Return the axes of an array that are in space, in order; the others have length 1.

        Raises
        ------
        GridError
            If they are not three, or another axis is longer.
        """
        if len(shape) < len(SPACE):
            raise GridError(f"values have shape {tuple(shape)}: give three axes (x, y, z)")
        space = [axis for axis, name in enumerate(self.axes) if name in tuple(SPACE)]
        if len(self.axes) != len(shape) or sorted(self.axes[axis] for axis in space) != list(SPACE):
            named = ", ".join(self.axes)
            raise GridError(
                f"an array of {len(shape)} axes has the axes {named}: give an image of z, y, x"
            )
        for axis, count in enumerate(shape):
            if axis not in space and count != 1:
                name = self.axes[axis] or str(axis)
                raise GridError(
                    f"its axis {name} has {count} entries, and a grid has three axes in space: "
                    "store one of them as an array of its own"
                )
        return space

    @property
    def space_units(self) -> dict[str, str]:
        """The units of the axes in space that state one, by name, in the order x, y, z."""
        units = dict(zip(self.axes, self.units))
        return {name: units[name] for name in SPACE if units.get(name)}

    @property
    def is_one_unit(self) -> bool:
        """Whether all axes in space have the same unit, or none."""
        return len(set(self.space_units.values())) <= 1

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence on the unit of the lengths, if there is one."""
        if not self.is_one_unit:
            units = ", ".join(f"{name} {unit}" for name, unit in self.space_units.items())
            return (
                f"its axes have different units ({units}): spacing and origin are not taken from "
                "its metadata (give --spacing)",
            )
        return tuple(
            f"lengths are in the unit of its axes, {unit}"
            for unit in dict.fromkeys(self.space_units.values())
        )

    def place(self, space: list[int], axes: str) -> Place:
        """Return spacing along the axes of the array, origin (x, y, z) and direction.

        The order of the axes is that of the metadata, unless the user gave another than z, y, x.
        """
        names = [self.axes[axis] for axis in space] if axes == "zyx" else list(axes)
        direction = np.eye(3)[:, [SPACE.index(name) for name in names]]
        scale, shift = np.ones(len(self.axes)), np.zeros(len(self.axes))
        for step in self.steps:
            factor, move = _numbers_of(step, len(self.axes))
            scale, shift = scale * factor, shift * factor + move
        if not self.steps or not self.is_one_unit:
            return None, None, direction
        spacing, origin = scale[space], direction @ shift[space]
        return _triple(spacing), _triple(origin), direction


def _numbers_of(step: dict[str, Any], count: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return factors and shifts of a coordinate transformation, one for each axis."""
    kind = step.get("type")
    numbers = np.asarray(step.get(str(kind), ()), np.float64)
    if kind == "identity":
        return np.ones(count), np.zeros(count)
    if kind not in ("scale", "translation") or numbers.shape != (count,):
        raise GridError(
            f"one of its coordinateTransformations has the type {kind!r} and {numbers.size} "
            f"numbers: give scale or translation, with one number for each of its {count} axes"
        )
    return (numbers, np.zeros(count)) if kind == "scale" else (np.ones(count), numbers)


def _triple(numbers: NDArray[np.float64]) -> Triple:
    x, y, z = numbers.tolist()
    return x, y, z


def images_of(attributes: dict[str, Any]) -> list[Image]:
    """Return the images that the attributes of a group describe, each at its finest level."""
    return [_image(scales, 0) for scales in _multiscales(attributes)]


def find_image(attributes: Callable[[str], dict[str, Any]], name: str) -> Image | None:
    """Return the image in whose metadata an array is a level, None if there is none.

    Parameters
    ----------
    attributes : callable
        Returns the attributes of the group at a path.
    name : str
        Path of the array in it. The metadata is that of a group on the way there.
    """
    parts = name.strip("/").split("/")
    for depth in range(len(parts)):
        for scales in _multiscales(attributes("/".join(parts[:depth]))):
            below = "/".join(parts[depth:])
            paths = [str(level["path"]).strip("/") for level in scales["datasets"]]
            if below in paths:
                return _image(scales, paths.index(below))
    return None


def _multiscales(attributes: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the entries of ``multiscales``, in version 0.5 those under ``ome``."""
    found = attributes.get("ome", attributes)
    scales = found.get("multiscales") if isinstance(found, dict) else None
    return [entry for entry in scales or [] if _is_complete(entry)]


def _is_complete(entry: Any) -> bool:
    """Return whether an entry of ``multiscales`` names its arrays; FileError if it is damaged."""
    levels = entry.get("datasets") if isinstance(entry, dict) else None
    if not levels or not all(isinstance(level, dict) and "path" in level for level in levels):
        raise FileError("its OME metadata is damaged: multiscales names no arrays")
    return True


def _image(scales: dict[str, Any], level: int) -> Image:
    """Return an entry of ``multiscales`` at a level; its own transformations come last."""
    axes = scales.get("axes", ["z", "y", "x"])
    named = [axis if isinstance(axis, dict) else {"name": axis} for axis in axes]
    steps = [
        *scales["datasets"][level].get("coordinateTransformations", ()),
        *scales.get("coordinateTransformations", ()),
    ]
    return Image(
        tuple(str(axis.get("name", "")) for axis in named),
        tuple(str(axis.get("unit") or "") for axis in named),
        tuple(str(entry["path"]) for entry in scales["datasets"]),
        tuple(steps),
    )
