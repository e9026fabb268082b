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
from .axes import Axis, measured, placed, stored

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
    if "" in store.arrays and request.member is not None:
        raise FileError(f"{request.path} is one array: give no name of another in it")
    name = "" if "" in store.arrays else _choose(store, request)
    array, axes = store.open(name), _image_axes(store, name)
    attributes, version = dict(array.attrs), 2 if store.document(name, ARRAY_2) else 3
    if axes and (not {*"xyz"} <= {axis.name for axis in axes} or len(axes) != array.ndim):
        listed = ", ".join(axis.name for axis in axes)
        said = f"an array of {array.ndim} axes has the axes {listed}"
        raise GridError(f"{said}: give an image of z, y, x")
    if axes:
        place = placed(axes, {}, array.shape, request.axes)
    else:
        place = placed(_named_axes(store, name, array), attributes, array.shape, request.axes)
    total = prod(-(-size // chunk) for size, chunk in zip(array.shape, array.chunks))
    absent = max(total - array.nchunks_initialized, 0)
    none = array.fill_value if version == 2 else None  # as xarray takes it
    about = {"chunks": list(array.chunks), "zarr format": version}
    if shards := getattr(array, "shards", None):
        about["shards"] = list(shards)
    numbers = stored(array, attributes, none, absent, array.fill_value)
    return Volume(*numbers, **place, about=about)


class _Store:
    """The arrays of a store in a folder or zip file, which may not lead out of it, by their path.

    Metadata is read here without zarr.
    """

    def __init__(self, request: Request) -> None:
        self.path, self.files = request.path, request.files
        self.zip: zipfile.ZipFile | None = None
        if not self.path.is_dir():
            self.zip = request.files.enter_context(zipfile.ZipFile(self.path))
        self.keys = set(self.zip.namelist() if self.zip else self._listed())
        self.arrays: dict[str, int] = {}  # the number of axes of each
        for key in self.keys:
            path, _, name = key.rpartition("/")
            if name in (ARRAY_2, NODE_3):
                about = self.document(path, name)
                if name == ARRAY_2 or about.get("node_type") == "array":
                    self.arrays[path] = len(about.get("shape", ()))

    def _listed(self) -> Iterator[str]:
        for at, folders, names in os.walk(self.path):
            for name in (*folders, *names):
                path = Path(at, name)
                key = path.relative_to(self.path).as_posix()
                if path.is_symlink():
                    check_beside(self.path, key)
                elif not path.is_dir() and not path.is_file():
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
        of_3 = self.document(path, NODE_3).get("attributes") or {}
        return {**self.document(path, ATTRIBUTES_2), **of_3}

    def images(self, path: str) -> list[Document]:
        """Return the images that the metadata of a group describes, as OME-NGFF has it."""
        attributes = self.attributes(path)
        images: list[Document] = attributes.get("ome", attributes).get("multiscales") or []
        return images

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


def _codecs_of(about: Document) -> Iterator[str]:
    for key in ("compressor", "filters", "codecs", "index_codecs"):
        listed: Any = about.get(key) or ()
        for codec in listed if isinstance(listed, (list, tuple)) else (listed,):
            named = codec if isinstance(codec, dict) else {"name": codec}
            yield str(named.get("id", named.get("name"))).removeprefix("numcodecs.")
            if isinstance(named.get("configuration"), dict):
                yield from _codecs_of(named["configuration"])


def _choose(store: _Store, request: Request) -> str:
    """Return the array to read: of an image the finest level, unless another is named."""
    named = (request.member or "").strip("/")
    is_group = any(name.startswith(f"{named}/") for name in store.arrays) and bool(named)
    before = f"{named}/" if is_group else ""
    images = store.images(before.strip("/"))
    if images and (is_group or request.member is None):
        return before + str(images[0]["datasets"][0]["path"]).strip("/")
    counts = sorted(item for item in store.arrays.items() if item[0].startswith(before))
    names = [f"/{name}" for name, axes in counts if 3 <= axes <= MOST_AXES]
    asked = replace(request, member=None) if is_group else request
    return asked.choose(names, "3D array").strip("/")


def _named_axes(store: _Store, name: str, array: Any) -> list[Axis]:
    """Return the axes of an array by the names of its dimensions, and by arrays of these names."""
    said = getattr(getattr(array, "metadata", None), "dimension_names", None)
    names = [str(each or "") for each in said or array.attrs.get("_ARRAY_DIMENSIONS") or ()]
    names = names if len(names) == array.ndim else [""] * array.ndim
    group, axes = name.rpartition("/")[0], []
    for axis, count in zip(names, array.shape):
        path = f"{group}/{axis}".lstrip("/")
        is_there = bool(name and axis) and store.arrays.get(path) == 1
        places = store.open(path)[:] if is_there else ()
        about = store.attributes(path) if is_there else {}
        axes.append(measured(axis, places if len(places) == count else None, about))
    return axes


def _image_axes(store: _Store, name: str) -> list[Axis] | None:
    """Return the axes of an array that is a level of an image of OME, None if it is of none.

    The transformations of a level come first, then those of the whole image.
    """
    parts = name.split("/") if name else []
    levels = (
        (image, level)
        for depth in range(len(parts))
        for image in store.images("/".join(parts[:depth]))
        for level in image["datasets"]
        if str(level["path"]).strip("/") == "/".join(parts[depth:])
    )
    image, level = next(levels, (None, None))
    if image is None or level is None:
        return None
    named = [
        axis if isinstance(axis, dict) else {"name": axis} for axis in image.get("axes", "zyx")
    ]
    key = "coordinateTransformations"
    steps = [*level.get(key, ()), *image.get(key, ())]
    scale, shift = np.ones(len(named)), np.zeros(len(named))
    for step in steps:
        kind = str(step.get("type"))
        numbers = np.asarray(step.get(kind, ()), np.float64)
        if kind not in ("identity", "scale", "translation"):
            raise GridError(f"one of its {key} has the type {kind!r}: give scale or translation")
        if kind == "scale":
            scale, shift = scale * numbers, shift * numbers
        elif kind == "translation":
            shift = shift + numbers
    places = zip(scale.tolist(), shift.tolist()) if steps else [(None, None)] * len(named)
    return [
        Axis(str(axis.get("name", "")).lower(), str(axis.get("unit") or ""), *place)
        for axis, place in zip(named, places)
    ]
