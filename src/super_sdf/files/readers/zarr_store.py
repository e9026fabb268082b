"""Zarr arrays in folders and zip files, with zarr.

They are (z, y, x) unless ``--axes`` or OME metadata say otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError
from ..boxes import Box
from ..volume import BOX, Request, Volume
from .choosing import choose_member
from .ome import MOST_AXES, Image, find_image, images_of
from .stored import place_of


def read_zarr(request: Request) -> Volume:
    """Read ``FOLDER.zarr``, or ``FOLDER.zarr:/ARRAY`` of a group; of OME-Zarr the finest level."""
    import zarr

    found = _opened(request, zarr)
    if not isinstance(found, zarr.Group):
        if request.member is not None:
            raise FileError(f"{request.path} is one array: give no name of another in it")
        return _volume(found, None, request)
    name = _choose(found, request, zarr)
    return _volume(found[name], find_image(found, name, zarr.Group), request)


def _opened(request: Request, zarr: Any) -> Any:
    """Return the array or group in a folder or a zip file."""
    if request.path.is_dir():
        return zarr.open(str(request.path), mode="r")
    store = zarr.storage.ZipStore(str(request.path), mode="r")
    found = zarr.open(store, mode="r")
    request.files.callback(store.close)  # only now is there something to close
    return found


def _choose(group: Any, request: Request, zarr: Any) -> str:
    """Return the name of the array to read: of an image the finest level, unless another is named.

    A name may be that of a group, such as that of one image of several.
    """
    before, asked = "", request.member
    if asked is not None and isinstance(group.get(asked.strip("/")), zarr.Group):
        before, asked = asked.strip("/") + "/", None
        group = group[before.strip("/")]
    levels = [image.levels[0] for image in images_of(dict(group.attrs))]
    if levels and asked is None:
        return before + levels[0].strip("/")
    names = [f"/{before}{name}" for name in _names(group)]
    return choose_member(request.named(asked), names, "3D array").strip("/")


def _names(group: Any, before: str = "") -> list[str]:
    """Return the names of all arrays in a group and below it that can be of three axes."""
    names = [f"{before}{name}" for name, array in group.arrays() if 3 <= array.ndim <= MOST_AXES]
    for name, below in group.groups():
        names += _names(below, f"{before}{name}/")
    return sorted(names)


def _volume(array: Any, image: Image | None, request: Request) -> Volume:
    """Return an array as a volume, without its axes of length 1 that are not in space."""
    image = image or Image.of_array(array.ndim, request.axes)
    space = image.space_of(array.shape, request.axes)
    shape, chunks = ([sizes[axis] for axis in space] for sizes in (array.shape, array.chunks))
    if image.is_placed:
        place = image.place(space, request.axes)
    else:
        place = place_of(dict(array.attrs), request.axes)
    read_box = _reader(array, space)

    def read(first: int, last: int) -> NDArray[Any]:
        return read_box((slice(first, last), slice(0, shape[1]), slice(0, shape[2])))

    return Volume(
        tuple(shape),
        array.dtype,
        read,
        *place,
        chunks=tuple(chunks),
        read_box=read_box,
        notes=image.notes,
        about=_storage(array),
    )


def _reader(array: Any, space: list[int]) -> Callable[[Box], NDArray[Any]]:
    """Return a function that reads a box of an array along its axes in space."""
    at_once = max(int(BOX // max(prod(array.chunks) * array.dtype.itemsize, 1)), 1)

    def read_box(box: Box) -> NDArray[Any]:
        where: list[Any] = [0] * array.ndim
        for axis, part in zip(space, box):
            where[axis] = part
        with _chunks_at_once(at_once):
            return np.asarray(array[tuple(where)])

    return read_box


def _chunks_at_once(most: int) -> Any:
    """Limit how many chunks zarr unpacks at the same time; zarr 2 takes one by one."""
    import zarr

    config = getattr(zarr, "config", None)
    if config is None:
        return nullcontext()
    return config.set({"async.concurrency": min(most, config.get("async.concurrency"))})


def _storage(array: Any) -> dict[str, Any]:
    """Return how an array is stored, as ``info`` prints it."""
    version = getattr(array.metadata, "zarr_format", 2) if hasattr(array, "metadata") else 2
    found: dict[str, Any] = {"zarr format": version, "chunks": list(array.chunks)}
    shards = getattr(array, "shards", None)
    if shards:
        found["shards"] = list(shards)
    return found
