"""Zarr arrays in folders and zip files, with zarr.

They are (z, y, x) unless OME metadata, names of dimensions as xarray writes them, or ``--axes`` say
otherwise. OME's are levels of an image, of versions 0.4 and 0.5 of OME-NGFF: see
https://ngff.openmicroscopy.org/0.5/, ``multiscales`` metadata.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from ..unpacking import BOX
from ..volume import Box, ReadBox, Request, Volume
from .axes import Axes, along, placed, unscaled, without_gaps
from .zarr_files import Document, ZarrFiles, array_shards, array_version, counts_of

MOST_AXES = 5  # time, channel, and three of space


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
    before, named = "", (request.member or "").strip("/")
    is_group = bool(named) and any(name.startswith(f"{named}/") for name in arrays)
    if is_group:
        before = f"{named}/"
    images = _multiscales(files.attributes(before.strip("/")))
    if images and (is_group or request.member is None):
        return before + _levels(images[0])[0]
    names = [
        f"/{name}"
        for name, axes in sorted(arrays.items())
        if name.startswith(before) and 3 <= axes <= MOST_AXES
    ]
    asked = replace(request, member=None) if is_group else request
    return asked.choose(names, "3D array").strip("/")


def _volume(files: ZarrFiles, name: str, array: Any, request: Request) -> Volume:
    """Return an array as a volume, without its axes of length 1 that are not in space."""
    axes = _image_axes(files, name) if name else None
    attributes = dict(array.attrs)
    if axes and (not axes.are_in_space or len(axes.names) != array.ndim):
        raise GridError(
            f"an array of {array.ndim} axes has the axes {', '.join(axes.names)}: give an image "
            "of z, y, x"
        )
    stated = {} if axes else attributes
    axes = axes or _named_axes(files, name, array, request)
    space, place = placed(axes, stated, array.shape, request.axes)
    shards, version = array_shards(array), array_version(array)
    stored = files.chunks_of(name, counts_of(array.shape, shards or array.chunks))
    if shards:
        files.check_sums(list(stored.values()))
    gaps = files.absent(array, name, stored)
    whole = without_gaps(_reader(array, space), *gaps, array.fill_value)
    missing = array.fill_value if version == 2 else None  # as xarray takes it
    read_box, dtype = unscaled(whole, array.dtype, attributes, missing)
    about = {"zarr format": version, "chunks": list(array.chunks)}
    return Volume(
        tuple(array.shape[axis] for axis in space),
        dtype,
        **place,
        chunks=tuple(array.chunks[axis] for axis in space),
        read_box=read_box,
        about=about | ({"shards": list(shards)} if shards else {}),
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

    def coordinates(axis: int) -> tuple[NDArray[Any] | None, Document]:
        path = f"{group}/{names[axis]}".lstrip("/")
        if not name or not names[axis] or files.axes_of(path) != 1:
            return None, {}
        files.check_codecs(path)
        places = _open(request, path)
        is_whole = places.shape == (array.shape[axis],)
        return (np.asarray(places[:]) if is_whole else None), files.attributes(path)

    return Axes.of_coordinates([str(each or "") for each in names], array.shape, coordinates)


def _reader(array: Any, space: list[int]) -> ReadBox:
    """Return a function that reads a box of an array along its axes in space.

    zarr 3 unpacks as few chunks at the same time as fit in a box; zarr 2 takes one by one.
    """
    import zarr

    most = max(int(BOX // max(prod(array.chunks) * array.dtype.itemsize, 1)), 1)
    config = getattr(zarr, "config", None)

    def read_box(box: Box) -> NDArray[Any]:
        limits: Any = nullcontext()
        if config is not None:
            limits = config.set({"async.concurrency": min(most, config.get("async.concurrency"))})
        with limits:
            return np.asarray(array[along(space, box, array.ndim)])

    return read_box


def _image_axes(files: ZarrFiles, name: str) -> Axes | None:
    """Return the axes of an array that is a level of an image of OME, None if it is of none.

    The metadata is that of a group on the way there.
    """
    parts = name.strip("/").split("/")
    for depth in range(len(parts)):
        for image in _multiscales(files.attributes("/".join(parts[:depth]))):
            below = "/".join(parts[depth:])
            if below in _levels(image):
                return _axes_of(image, _levels(image).index(below))
    return None


def _multiscales(attributes: Document) -> list[Document]:
    """Return the images that the attributes of a group describe, in version 0.5 under ``ome``."""
    about = attributes.get("ome", attributes)
    images = about.get("multiscales") if isinstance(about, dict) else None
    for entry in images or []:
        levels = entry.get("datasets") if isinstance(entry, dict) else None
        if not levels or not all(isinstance(level, dict) and "path" in level for level in levels):
            raise FileError("its OME metadata is damaged: multiscales names no arrays")
    return images or []


def _levels(image: Document) -> list[str]:
    """Return the arrays of an image, the finest first."""
    return [str(level["path"]).strip("/") for level in image["datasets"]]


def _axes_of(image: Document, level: int) -> Axes:
    """Return the axes of a level, placed by its transformations; the image's own come last."""
    stated = image.get("axes", ["z", "y", "x"])
    named = [axis if isinstance(axis, dict) else {"name": axis} for axis in stated]
    names = [str(axis.get("name", "")) for axis in named]
    units = tuple(str(axis.get("unit") or "") for axis in named)
    key = "coordinateTransformations"
    transformations = [*image["datasets"][level].get(key, ()), *image.get(key, ())]
    if not transformations:
        return Axes.named(names, units)
    scale, shift = np.ones(len(names)), np.zeros(len(names))
    for step in transformations:
        kind = step.get("type")
        numbers = np.asarray(step.get(str(kind), ()), np.float64)
        if kind == "identity":
            continue
        if kind not in ("scale", "translation") or numbers.shape != (len(names),):
            raise GridError(
                f"one of its coordinateTransformations has the type {kind!r} and {numbers.size} "
                "numbers: give scale or translation, with one number for each of its "
                f"{len(names)} axes"
            )
        if kind == "scale":
            scale, shift = scale * numbers, shift * numbers
        else:
            shift = shift + numbers
    return Axes.named(names, units, tuple(scale.tolist()), tuple(shift.tolist()))
