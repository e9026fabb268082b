"""Zarr arrays in folders and zip files, with zarr.

They are (z, y, x) unless OME metadata, names of dimensions as xarray writes them, or ``--axes`` say
otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from ..boxes import Box
from ..volume import BOX, Request, Volume
from .axes import Axes
from .choosing import choose_member
from .ome import MOST_AXES, find_image, images_of
from .stored import along, placed, unscaled, without_gaps
from .zarr_files import ZarrFiles, array_shards, array_version, counts_of


def read_zarr(request: Request) -> Volume:
    """Read ``FOLDER.zarr``, or ``FOLDER.zarr:/ARRAY`` of a group; of OME-Zarr the finest level."""
    files = ZarrFiles(request)
    arrays = files.arrays()
    if "" not in arrays:
        name = _choose(files, arrays, request)
    elif request.member is None:
        name = ""
    else:
        raise FileError(f"{request.path} is one array: give no name of another in it")
    if name not in arrays:
        raise FileError(f"{request.path} is damaged: its metadata names no array at {name!r}")
    files.check_codecs(name)
    return _volume(files, name, _open(request, name), request)


def _open(request: Request, name: str) -> Any:
    """Return an array in a folder or a zip file."""
    import zarr

    if request.path.is_dir():
        return zarr.open_array(str(request.path), path=name, mode="r")
    store = zarr.storage.ZipStore(str(request.path), mode="r")
    array = zarr.open_array(store, path=name, mode="r")
    request.files.callback(store.close)  # only now is there something to close
    return array


def _choose(files: ZarrFiles, arrays: dict[str, int], request: Request) -> str:
    """Return the name of the array to read: of an image the finest level, unless another is named.

    A name may be that of a group, such as that of one image of several.
    """
    before, asked = "", request.member
    named = (asked or "").strip("/")
    if named and any(name.startswith(f"{named}/") for name in arrays):
        before, asked = f"{named}/", None
    levels = [image.levels[0] for image in images_of(files.attributes(before.strip("/")))]
    if levels and asked is None:
        return before + levels[0].strip("/")
    names = [
        f"/{name}"
        for name, axes in sorted(arrays.items())
        if name.startswith(before) and 3 <= axes <= MOST_AXES
    ]
    return choose_member(request.named(asked), names, "3D array").strip("/")


def _volume(files: ZarrFiles, name: str, array: Any, request: Request) -> Volume:
    """Return an array as a volume, without its axes of length 1 that are not in space."""
    image = find_image(files.attributes, name) if name else None
    attributes = dict(array.attrs)
    axes = image.axes if image else _named_axes(files, name, array, request)
    if image and (not axes.are_in_space or len(axes.names) != array.ndim):
        raise GridError(
            f"an array of {array.ndim} axes has the axes {', '.join(axes.names)}: give an image "
            "of z, y, x"
        )
    space, place = placed(axes, {} if image else attributes, array.shape, request.axes)
    shape, chunks = ([sizes[axis] for axis in space] for sizes in (array.shape, array.chunks))
    stored = files.chunks_of(name, counts_of(array.shape, array_shards(array) or array.chunks))
    if array_shards(array):
        files.check_sums(list(stored.values()))
    gaps = files.absent(array, name, stored)
    whole = without_gaps(_reader(array, space), *gaps, array.fill_value)
    missing = array.fill_value if array_version(array) == 2 else None  # as xarray takes it
    read_box, dtype = unscaled(whole, array.dtype, attributes, missing)

    def read(first: int, last: int) -> NDArray[Any]:
        return read_box((slice(first, last), slice(0, shape[1]), slice(0, shape[2])))

    return Volume(
        tuple(shape),
        dtype,
        read,
        **place,
        chunks=tuple(chunks),
        read_box=read_box,
        about=_storage(array),
        packed=sum(files.sizes[key] for key in stored.values()),
    )


def _named_axes(files: ZarrFiles, name: str, array: Any, request: Request) -> Axes:
    """Return the axes of an array by the names of its dimensions, and by arrays of these names.

    xarray writes the names as an attribute in format 2, in the metadata in format 3.
    """
    stated = getattr(array.metadata, "dimension_names", None) if array_version(array) > 2 else None
    names = stated or array.attrs.get("_ARRAY_DIMENSIONS") or ()
    if len(names) != array.ndim:
        names = ("",) * array.ndim
    group = name.rpartition("/")[0]

    def coordinates(axis: int) -> tuple[NDArray[Any] | None, dict[str, Any]]:
        path = f"{group}/{names[axis]}".lstrip("/")
        if not name or not names[axis] or files.axes_of(path) != 1:
            return None, {}
        files.check_codecs(path)
        places = _open(request, path)
        is_whole = places.shape == (array.shape[axis],)
        return (np.asarray(places[:]) if is_whole else None), files.attributes(path)

    return Axes.of_coordinates([str(each or "") for each in names], array.shape, coordinates)


def _reader(array: Any, space: list[int]) -> Callable[[Box], NDArray[Any]]:
    """Return a function that reads a box of an array along its axes in space."""
    at_once = max(int(BOX // max(prod(array.chunks) * array.dtype.itemsize, 1)), 1)

    def read_box(box: Box) -> NDArray[Any]:
        with _chunks_at_once(at_once):
            return np.asarray(array[along(space, box, array.ndim)])

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
    found: dict[str, Any] = {"zarr format": array_version(array), "chunks": list(array.chunks)}
    shards = array_shards(array)
    if shards:
        found["shards"] = list(shards)
    return found
