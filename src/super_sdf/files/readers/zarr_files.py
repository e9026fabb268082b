"""Zarr arrays in folders and zip files, with zarr.

They are (z, y, x) unless OME metadata, names of dimensions as xarray writes them, or ``--axes`` say
otherwise. OME's are levels of an image, of versions 0.4 and 0.5 of OME-NGFF: see
https://ngff.openmicroscopy.org/0.5/, ``multiscales`` metadata. zarr makes the codecs that the
metadata names when it opens an array, and takes chunks that are not there for the fill value; here
the one is checked, and the other counted.
"""

from __future__ import annotations

import json
import os
import re
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import cached_property
from math import prod
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError, seen
from ..regular import check_beside, check_regular_file
from ..unpacking import BOX, PIECE
from ..volume import Box, ReadBox, Request, Volume
from .axes import Axes, along, placed, unscaled, without_gaps

MOST_AXES = 5  # time, channel, and three of space


def read_zarr(request: Request) -> Volume:
    """Read ``FOLDER.zarr``, or ``FOLDER.zarr:/ARRAY`` of a group; of OME-Zarr the finest level."""
    files = _Store(request)
    arrays = files.arrays
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
    import zarr

    if request.path.is_dir():
        return zarr.open_array(str(request.path), path=name, mode="r")
    store = zarr.storage.ZipStore(str(request.path), mode="r")
    array = zarr.open_array(store, path=name, mode="r")
    request.files.callback(store.close)  # only now is there something to close
    return array


def _choose(files: _Store, arrays: dict[str, int], request: Request) -> str:
    """Return the array to read: of an image the finest level, unless another is named."""
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


def _volume(files: _Store, name: str, array: Any, request: Request) -> Volume:
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
    shards, version = _shards(array), _version(array)
    stored = files.chunks_of(name, _counts(array.shape, shards or array.chunks))
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


def _named_axes(files: _Store, name: str, array: Any, request: Request) -> Axes:
    """Return the axes of an array by the names of its dimensions, and by arrays of these names."""
    stated = getattr(array.metadata, "dimension_names", None) if _version(array) > 2 else None
    names = stated or array.attrs.get("_ARRAY_DIMENSIONS") or ()
    if len(names) != array.ndim:
        names = ("",) * array.ndim
    group = name.rpartition("/")[0]

    def coordinates(axis: int) -> tuple[NDArray[Any] | None, Document]:
        path = f"{group}/{names[axis]}".lstrip("/")
        if not name or not names[axis] or files.arrays.get(path) != 1:
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


def _image_axes(files: _Store, name: str) -> Axes | None:
    """Return the axes of an array that is a level of an image of OME, None if it is of none."""
    parts = name.strip("/").split("/")
    for depth in range(len(parts)):
        for image in _multiscales(files.attributes("/".join(parts[:depth]))):
            below = "/".join(parts[depth:])
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


def _axes_of(image: Document, level: int) -> Axes:
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


# The files of a store, without zarr

ARRAY_2, ATTRIBUTES_2, NODE_3 = ".zarray", ".zattrs", "zarr.json"
# None of these runs what the store names, and all return numbers.
CODECS = {
    *("bytes", "endian", "transpose", "sharding_indexed", "crc32c"),
    *("blosc", "bz2", "gzip", "lz4", "lzma", "pcodec", "zfpy", "zlib", "zstd"),
    *("adler32", "crc32", "fletcher32", "jenkins_lookup3"),
    *("astype", "bitround", "delta", "fixedscaleoffset", "packbits", "quantize", "shuffle"),
}
CHUNK_KEY = re.compile(r"(?:c[./])?(\d+(?:[./]\d+)*)")
NOT_STORED = 2**64 - 1  # as the place of a chunk in the index of a shard
CHECKSUM = 4  # bytes of CRC-32C after that index
MOST_ABSENT = 1 << 20  # chunks: to look for them takes a minute

Document = dict[str, Any]


class _Store:
    """The files of a store in a folder or zip file, which may not lead out of it: bytes by key."""

    def __init__(self, request: Request) -> None:
        self.path = request.path
        self.zip: zipfile.ZipFile | None = None
        if self.path.is_dir():
            self.sizes = dict(self._listed(str(self.path), ""))
        else:
            self.zip = request.files.enter_context(zipfile.ZipFile(self.path))
            self.sizes = {info.filename: info.compress_size for info in self.zip.infolist()}

    def _listed(self, folder: str, before: str) -> Iterator[tuple[str, int]]:
        for entry in os.scandir(folder):
            key = before + entry.name
            if entry.is_dir(follow_symlinks=False):
                yield from self._listed(entry.path, f"{key}/")
                continue
            if entry.is_symlink():
                check_beside(self.path, key)
            elif not entry.is_file():
                check_regular_file(entry.path)
            yield key, entry.stat().st_size

    def open(self, key: str) -> IO[bytes]:
        return self.zip.open(key) if self.zip else open(self.path / key, "rb")

    def document(self, path: str, name: str) -> Document:
        """Return the metadata of an array or a group, empty if the store has none of this name."""
        key = f"{path}/{name}" if path else name
        if key not in self.sizes:
            return {}
        with self.open(key) as file:
            content = json.load(file)
        if not isinstance(content, dict):
            raise FileError(f"{self.path} is damaged: {key} is no JSON object")
        return content

    @cached_property
    def arrays(self) -> dict[str, int]:
        """The number of axes of each array, by its path."""
        counts = {}
        for key in self.sizes:
            path, _, name = key.rpartition("/")
            if name in (ARRAY_2, NODE_3):
                about = self.document(path, name)
                if name == ARRAY_2 or about.get("node_type") == "array":
                    counts[path] = len(about.get("shape", ()))
        return counts

    def attributes(self, path: str) -> Document:
        stated = self.document(path, NODE_3).get("attributes") or {}
        return {**self.document(path, ATTRIBUTES_2), **stated}

    def check_codecs(self, path: str) -> None:
        """Raise FileError if an array names a codec that is not in the list."""
        for name in (ARRAY_2, NODE_3):
            for codec in _codecs_of(self.document(path, name)):
                if codec not in CODECS:
                    raise FileError(
                        f"{self.path} names the codec {seen(codec)}, which is not among those that "
                        f"are read ({', '.join(sorted(CODECS))}): store it with one of these"
                    )

    def chunks_of(self, path: str, counts: Sequence[int]) -> dict[tuple[int, ...], str]:
        """Return the keys of the chunks, or shards, that are stored, by their indices."""
        before, chunks = f"{path}/" if path else "", {}
        for key in self.sizes:
            match = CHUNK_KEY.fullmatch(key, len(before)) if key.startswith(before) else None
            indices = tuple(map(int, re.split("[./]", match[1]))) if match else ()
            if len(indices) == len(counts) and all(i < n for i, n in zip(indices, counts)):
                chunks[indices] = key
        return chunks

    def absent(self, array: Any, path: str, stored: dict[tuple[int, ...], str]) -> tuple[int, int]:
        """Return how many chunks of an array are not stored, and how many it has."""
        total = prod(_counts(array.shape, array.chunks))
        there = len(stored)
        if _shards(array):
            there = sum(self._in_shard(array, path, *shard) for shard in stored.items())
        if total - there > MOST_ABSENT:
            raise FileError(
                f"{self.path} has {total:,} chunks, of which {there:,} are stored: store it in "
                "larger ones"
            )
        return total - there, total

    def _in_shard(self, array: Any, path: str, indices: tuple[int, ...], key: str) -> int:
        """Return how many chunks of a shard are stored, of those within the array."""
        codec = self.document(path, NODE_3)["codecs"][0]["configuration"]
        shard, chunk = array.shards, array.chunks
        left = [min(n - i * s, s) for n, i, s in zip(array.shape, indices, shard)]
        within = _counts(left, chunk)
        names = [str(step.get("name")) for step in codec["index_codecs"]]
        if names not in (["bytes"], ["bytes", "crc32c"]):
            return prod(within)  # its index cannot be read here
        counts = _counts(shard, chunk)
        size = 16 * prod(counts) + CHECKSUM * (len(names) - 1)
        with self.open(key) as file:
            if codec.get("index_location", "end") == "end":
                file.seek(-size, os.SEEK_END)
            index = np.frombuffer(file.read(size)[: 16 * prod(counts)], "<u8")
        places = index.reshape(*counts, 2)[tuple(map(slice, within))]
        return int((places[..., 0] != NOT_STORED).sum())

    def check_sums(self, keys: Sequence[str]) -> None:
        """Read shards in a zip file to their checksums: zarr reads parts, which have none."""
        for key in keys if self.zip else ():
            with self.open(key) as file:
                while file.read(PIECE):
                    pass


def _counts(shape: Sequence[int], chunks: Sequence[int]) -> list[int]:
    return [-(-size // chunk) for size, chunk in zip(shape, chunks)]


def _shards(array: Any) -> tuple[int, ...] | None:
    return getattr(array, "shards", None)  # arrays of zarr 2 have none


def _version(array: Any) -> int:
    return getattr(getattr(array, "metadata", None), "zarr_format", 2)  # as all arrays of zarr 2


def _codecs_of(about: Any) -> Iterator[str]:
    if isinstance(about, dict):
        for key in ("compressor", "filters", "codecs", "index_codecs"):
            listed: Any = about.get(key) or ()
            for codec in listed if isinstance(listed, list) else (listed,) if listed else ():
                stated = codec if isinstance(codec, dict) else {"name": codec}
                name = stated.get("id", stated.get("name"))
                yield str(name).removeprefix("numcodecs.")
                yield from _codecs_of(stated.get("configuration"))
