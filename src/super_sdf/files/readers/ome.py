"""OME-NGFF metadata of Zarr groups, versions 0.4 and 0.5: levels, axes, units, spacing and origin.

Reference: https://ngff.openmicroscopy.org/0.5/, ``multiscales`` metadata.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from .axes import Axes

MOST_AXES = 5  # time, channel, and three of space


@dataclass(frozen=True)
class Image:
    """An image at several levels of resolution; one of them is read.

    Attributes
    ----------
    axes : Axes
        Those of its arrays, as the coordinate transformations of the level that is read say.
    levels : tuple of str
        The arrays, the finest first.
    """

    axes: Axes
    levels: tuple[str, ...]


def _axes(named: Sequence[dict[str, Any]], transformations: Sequence[Any]) -> Axes:
    """Return the axes of an array, placed by the coordinate transformations, in order."""
    names = [str(axis.get("name", "")) for axis in named]
    units = tuple(str(axis.get("unit") or "") for axis in named)
    scale, shift = np.ones(len(names)), np.zeros(len(names))
    for step in transformations:
        factor, move = _numbers_of(step, len(names))
        scale, shift = scale * factor, shift * factor + move
    if not transformations:
        return Axes.named(names, units)
    return Axes.named(names, units, tuple(scale.tolist()), tuple(shift.tolist()))


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
    levels = tuple(str(entry["path"]) for entry in scales["datasets"])
    return Image(_axes(named, steps), levels)
