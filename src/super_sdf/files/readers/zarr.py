"""Zarr arrays in folders and zip files, with zarr.

They are (z, y, x) unless OME metadata, names of dimensions as xarray writes them, or ``--axes`` say
otherwise. OME's are levels of an image, of versions 0.4 and 0.5 of OME-NGFF: see
https://ngff.openmicroscopy.org/0.5/, ``multiscales`` metadata. zarr makes the codecs that the
metadata names when it opens an array: they are checked before.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import FileError, GridError, seen
from ..regular import check_beside, check_regular_file
from ..volume import Request, Volume
from .axes import Axis, measured, placed, values_of

MOST_AXES = 5  # time, channel, and three of space
ARRAY_2, ATTRIBUTES_2, NODE_3 = ".zarray", ".zattrs", "zarr.json"
# None of these runs what the store names, and all return numbers.
CODECS = {
    *("bytes", "endian", "transpose", "sharding_indexed", "crc32c"),
    *("blosc", "bz2", "gzip", "lz4", "lzma", "pcodec", "zfpy", "zlib", "zstd"),
    *("adler32", "crc32", "fletcher32", "jenkins_lookup3"),
    *("astype", "bitround", "delta", "fixedscaleoffset", "packbits", "quantize", "shuffle"),
}

Document = dict[str, Any]


def read_zarr(request: Request) -> Volume:
    """Read ``FOLDER.zarr``, or ``FOLDER.zarr:/ARRAY`` of a group; of OME-Zarr the finest level."""
    store = _Store(request)
    name = ""
    if "" not in store.arrays:
        name = _choose(store, request)
    elif request.member is not None:
        raise FileError(f"{request.path} is one array: give no name of another in it")
    array, axes = store.open(name), _image_axes(store, name)
    stated = dict(array.attrs)
    if axes and ({*"xyz"} - {axis.name for axis in axes} or len(axes) != array.ndim):
        listed = ", ".join(axis.name for axis in axes)
        raise GridError(
            f"an array of {array.ndim} axes has the axes {listed}: give an image of z, y, x"
        )
    place = placed(
        axes or _named_axes(store, name, array), {} if axes else stated, array.shape, request.axes
    )
    version = getattr(getattr(array, "metadata", None), "zarr_format", 2)
    total = prod(-(-size // chunk) for size, chunk in zip(array.shape, array.chunks))
    said = values_of(
        array.dtype,
        stated,
        missing=array.fill_value if version == 2 else None,  # as xarray takes it
        absent=max(total - array.nchunks_initialized, 0),
        total=total,
        fill=array.fill_value,
    )
    shards = getattr(array, "shards", None)
    about = {"chunks": list(array.chunks), "zarr format": version}
    about |= {"shards": list(shards)} if shards else {}
    return Volume(array, **place, **said, about=about)


class _Store:
    """The arrays of a store in a folder or zip file, which may not lead out of it, by their path.

    Metadata is read here without zarr.
    """

    def __init__(self, request: Request) -> None:
        self.path, self.files = request.path, request.files
        self.zip: zipfile.ZipFile | None = None
        if self.path.is_dir():
            self.keys = set(self._listed(self.path))
        else:
            self.zip = request.files.enter_context(zipfile.ZipFile(self.path))
            self.keys = set(self.zip.namelist())
        self.arrays: dict[str, int] = {}  # the number of axes of each
        for key in self.keys:
            path, _, name = key.rpartition("/")
            if name in (ARRAY_2, NODE_3):
                about = self.document(path, name)
                if name == ARRAY_2 or about.get("node_type") == "array":
                    self.arrays[path] = len(about.get("shape", ()))

    def _listed(self, folder: Path) -> Iterator[str]:
        for at, folders, names in os.walk(folder):
            for name in (*folders, *names):
                path = Path(at, name)
                key = path.relative_to(folder).as_posix()
                if path.is_symlink():
                    check_beside(folder, key)
                elif name in names and not path.is_file():
                    check_regular_file(path)
                yield key

    def document(self, path: str, name: str) -> Document:
        """Return the metadata of an array or a group, empty if the store has none of this name."""
        key = f"{path}/{name}" if path else name
        if key not in self.keys:
            return {}
        content = json.loads(self.zip.read(key) if self.zip else (self.path / key).read_bytes())
        if not isinstance(content, dict):
            raise FileError(f"{self.path} is damaged: {key} is no JSON object")
        return content

    def attributes(self, path: str) -> Document:
        stated = self.document(path, NODE_3).get("attributes") or {}
        return {**self.document(path, ATTRIBUTES_2), **stated}

    def open(self, path: str) -> Any:
        """Return an array, whose codecs must be in the list."""
        import zarr

        if path not in self.arrays:
            raise FileError(f"{self.path} is damaged: its metadata names no array at {path!r}")
        for name in (ARRAY_2, NODE_3):
            for codec in _codecs_of(self.document(path, name)):
                if codec not in CODECS:
                    raise FileError(
                        f"{self.path} names the codec {seen(codec)}, which is not among those that "
                        f"are read ({', '.join(sorted(CODECS))}): store it with one of these"
                    )
        if not self.zip:
            return zarr.open_array(str(self.path), path=path, mode="r")
        store = zarr.storage.ZipStore(str(self.path), mode="r")
        array = zarr.open_array(store, path=path, mode="r")
        self.files.callback(store.close)  # only now is there something to close
        return array


def _codecs_of(about: Any) -> Iterator[str]:
    for key in ("compressor", "filters", "codecs", "index_codecs"):
        listed: Any = about.get(key) or ()
        for codec in listed if isinstance(listed, list) else (listed,) if listed else ():
            stated = codec if isinstance(codec, dict) else {"name": codec}
            yield str(stated.get("id", stated.get("name"))).removeprefix("numcodecs.")
            if isinstance(stated.get("configuration"), dict):
                yield from _codecs_of(stated["configuration"])


def _choose(store: _Store, request: Request) -> str:
    """Return the array to read: of an image the finest level, unless another is named."""
    before, named = "", (request.member or "").strip("/")
    is_group = bool(named) and any(name.startswith(f"{named}/") for name in store.arrays)
    if is_group:
        before = f"{named}/"
    images = _multiscales(store.attributes(before.strip("/")))
    if images and (is_group or request.member is None):
        return before + _levels(images[0])[0]
    names = [
        f"/{name}"
        for name, axes in sorted(store.arrays.items())
        if name.startswith(before) and 3 <= axes <= MOST_AXES
    ]
    asked = replace(request, member=None) if is_group else request
    return asked.choose(names, "3D array").strip("/")


def _named_axes(store: _Store, name: str, array: Any) -> list[Axis]:
    """Return the axes of an array by the names of its dimensions, and by arrays of these names."""
    stated = getattr(getattr(array, "metadata", None), "dimension_names", None)
    names = [str(each or "") for each in stated or array.attrs.get("_ARRAY_DIMENSIONS") or ()]
    names = names if len(names) == array.ndim else [""] * array.ndim
    group, axes = name.rpartition("/")[0], []
    for axis, count in zip(names, array.shape):
        path = f"{group}/{axis}".lstrip("/")
        is_there = bool(name and axis) and store.arrays.get(path) == 1
        places = store.open(path) if is_there else None
        whole = np.asarray(places[:]) if places is not None and places.shape == (count,) else None
        axes.append(measured(axis, whole, store.attributes(path) if is_there else {}))
    return axes


def _image_axes(store: _Store, name: str) -> list[Axis] | None:
    """Return the axes of an array that is a level of an image of OME, None if it is of none."""
    parts = name.split("/") if name else []
    for depth in range(len(parts)):
        below = "/".join(parts[depth:])
        for image in _multiscales(store.attributes("/".join(parts[:depth]))):
            if below in _levels(image):
                return _axes_of(image, _levels(image).index(below))
    return None


def _multiscales(attributes: Document) -> list[Document]:
    about = attributes.get("ome", attributes)
    images = about.get("multiscales") if isinstance(about, dict) else None
    for entry in images or []:
        levels = entry.get("datasets") if isinstance(entry, dict) else None
        if not levels or not all(isinstance(level, dict) and "path" in level for level in levels):
            raise FileError("its OME metadata is damaged: multiscales names no arrays")
    return images or []


def _levels(image: Document) -> list[str]:
    return [str(level["path"]).strip("/") for level in image["datasets"]]


def _axes_of(image: Document, level: int) -> list[Axis]:
    """Return the axes of a level: its transformations first, then those of the whole image."""
    stated = image.get("axes", ["z", "y", "x"])
    named = [axis if isinstance(axis, dict) else {"name": axis} for axis in stated]
    names = [str(axis.get("name", "")).lower() for axis in named]
    units = [str(axis.get("unit") or "") for axis in named]
    key = "coordinateTransformations"
    steps = [*image["datasets"][level].get(key, ()), *image.get(key, ())]
    scale, shift = np.ones(len(names)), np.zeros(len(names))
    for step in steps:
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
        scale, shift = (scale * numbers, shift * numbers) if kind == "scale" else (scale, shift + numbers)
    if not steps:
        return [Axis(*each) for each in zip(names, units)]
    return [Axis(*each) for each in zip(names, units, scale.tolist(), shift.tolist())]
