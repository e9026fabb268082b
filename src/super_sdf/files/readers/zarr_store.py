"""Zarr arrays in folders, with zarr: (z, y, x) unless ``--axes`` or OME metadata say otherwise."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from ..volume import Request, Volume
from .choosing import choose_member
from .stored import place_of


def read_zarr(request: Request) -> Volume:
    """Read ``FOLDER.zarr``, or ``FOLDER.zarr:/ARRAY`` of a group; of OME-Zarr the finest level."""
    import zarr

    found = zarr.open(str(request.path), mode="r")
    attributes: dict[str, Any] = {}
    if isinstance(found, zarr.Group):
        level = _finest(dict(found.attrs)) if request.member is None else None
        if level:
            name, attributes = level
        else:
            name = choose_member(request, _names(found), "3D array")
        found = found[name.strip("/")]
    elif request.member is not None:
        raise FileError(f"{request.path} is one array: give no name of another in it")
    values: Any = found

    def read(first: int, last: int) -> NDArray[Any]:
        return np.asarray(values[first:last])

    place = place_of(dict(values.attrs) | attributes, request.axes)
    return Volume(tuple(values.shape), values.dtype, read, *place, values.chunks[0])


def _names(group: Any, before: str = "") -> list[str]:
    """Return the names of all arrays of three axes in a group and those below it."""
    names = [f"{before}/{name}" for name, array in group.arrays() if array.ndim == 3]
    for name, below in group.groups():
        names += _names(below, f"{before}/{name}")
    return sorted(names)


def _finest(attributes: dict[str, Any]) -> tuple[str, dict[str, Any]] | None:
    """Return the name of the finest level of an OME-Zarr group, its spacing and its origin."""
    scales = attributes.get("ome", attributes).get("multiscales")
    if not scales:
        return None
    level = scales[0]["datasets"][0]
    axes = [a["name"] if isinstance(a, dict) else a for a in scales[0].get("axes", ["z", "y", "x"])]
    if axes != ["z", "y", "x"]:
        raise GridError(f"its axes are {', '.join(map(str, axes))}: give an image of z, y, x")
    place: dict[str, Any] = {}
    for step in level.get("coordinateTransformations", ()):
        if step["type"] == "scale":
            place["spacing"] = step["scale"][::-1]
        elif step["type"] == "translation":
            place["origin"] = step["translation"][::-1]
    return level["path"], place
