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
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import FileError, GridError, seen
from ..formats import check_beside, check_regular_file
from . import Request, Volume
from .axes import Axis, measured, placed, stored

METADATA = (".zarray", ".zgroup", ".zattrs", "zarr.json")
# None of these runs what the store names, and all return numbers.
CODECS = {
    *("bytes", "endian", "transpose", "sharding_indexed", "crc32c"),
    *("blosc", "bz2", "gzip", "lz4", "lzma", "pcodec", "zfpy", "zlib", "zstd"),
    *("adler32", "crc32", "fletcher32", "jenkins_lookup3"),
    *("astype", "bitround", "delta", "fixedscaleoffset", "packbits", "quantize", "shuffle"),
}
TRANSFORMS = "coordinateTransformations"

Document = dict[str, Any]


def read_zarr(request: Request) -> Volume:
    """Read ``FOLDER.zarr``, or ``FOLDER.zarr:/ARRAY`` of a group; of OME-Zarr the finest level."""
    nodes = _nodes_of(request)
    name = _choose(nodes, request)
    array, axes = _open(nodes, name, request), _image_axes(nodes, name)
    attributes, version = dict(array.attrs), nodes[name]["zarr_format"]
    if axes is None:
        axes = _named_axes(nodes, name, array, request)
    elif {*"xyz"} <= {axis.name for axis in axes} and len(axes) == array.ndim:
        attributes = {}
    else:
        listed = ", ".join(axis.name for axis in axes)
        said = f"an array of {array.ndim} axes has the axes {listed}"
        raise GridError(f"{said}: give an image of z, y, x")
    place = placed(request, axes, attributes, array.shape)
    none = array.fill_value if version == 2 else None  # as xarray takes it
    numbers = stored(array, attributes, none, array.nchunks_initialized, array.fill_value)
    sizes = {name: getattr(array, name, None) for name in ("chunks", "shards")}
    about = {"zarr format": version, **{name: list(size) for name, size in sizes.items() if size}}
    return Volume(*numbers, **place, about=about)


def _nodes_of(request: Request) -> dict[str, Document]:
    """Return the metadata of the arrays and groups of a store, with attributes as in version 3.

    It is read without zarr, and no link may lead out of the store.
    """
    path, nodes = request.path, dict[str, Document]()
    if is_zip := not path.is_dir():
        archive = request.files.enter_context(zipfile.ZipFile(path))
        keys = archive.namelist()
    else:
        listed = [Path(at, n) for at, inner, names in os.walk(path) for n in (*inner, *names)]
        keys = [each.relative_to(path).as_posix() for each in listed]
        for key, each in zip(keys, listed):
            if each.is_symlink():
                check_beside(path, key)
            elif not each.is_dir() and not each.is_file():
                check_regular_file(each)
    for key in keys:
        node, _, name = key.rpartition("/")
        if name in METADATA:
            data = archive.read(key) if is_zip else (path / key).read_bytes()
            content = json.loads(data)
            if not isinstance(content, dict):
                raise FileError(f"{path} is damaged: {key} is no JSON object")
            content = {"attributes": content} if name == ".zattrs" else content
            nodes[node] = nodes.get(node, {}) | content
    return nodes


def _images(nodes: dict[str, Document], path: str) -> list[Document]:
    """Return the images that the metadata of a group describes, as OME-NGFF has it."""
    attributes: Document = nodes.get(path, {}).get("attributes") or {}
    images: list[Document] = attributes.get("ome", attributes).get("multiscales") or []
    return images


def _open(nodes: dict[str, Document], path: str, request: Request) -> Any:
    """Return an array, whose codecs must be in the list."""
    import zarr

    if "shape" not in nodes.get(path, {}):
        raise FileError(f"{request.path} is damaged: its metadata names no array at {path!r}")
    for codec in _codecs_of(nodes[path]):
        if codec not in CODECS:
            raise FileError(
                f"{request.path} names the codec {seen(codec)}, which is not among those that are "
                f"read ({', '.join(sorted(CODECS))}): store it with one of these"
            )
    if request.path.is_dir():
        return zarr.open_array(str(request.path), path=path, mode="r")
    store = zarr.storage.ZipStore(str(request.path), mode="r")
    array = zarr.open_array(store, path=path, mode="r")
    request.files.callback(store.close)  # only now is there something to close
    return array


def _codecs_of(about: Document) -> Iterator[str]:
    """Yield the names of the codecs in metadata, those within a codec, too."""
    for key in ("compressor", "filters", "codecs", "index_codecs"):
        listed: Any = about.get(key) or ()
        for codec in listed if isinstance(listed, (list, tuple)) else (listed,):
            named = codec if isinstance(codec, dict) else {"name": codec}
            yield str(named.get("id", named.get("name"))).removeprefix("numcodecs.")
            if isinstance(named.get("configuration"), dict):
                yield from _codecs_of(named["configuration"])


def _choose(nodes: dict[str, Document], request: Request) -> str:
    """Return the array to read: of an image the finest level, unless another is named."""
    shapes = {f"/{n}": node["shape"] for n, node in sorted(nodes.items()) if "shape" in node}
    if "/" in shapes:
        if request.member is not None:
            raise FileError(f"{request.path} is one array: give no name of another in it")
        return ""
    named = (request.member or "").strip("/")
    is_group = bool(named) and any(name.startswith(f"/{named}/") for name in shapes)
    before = f"/{named}/" if is_group else "/"
    images = _images(nodes, before.strip("/"))
    if images and (is_group or request.member is None):
        return (before + str(images[0]["datasets"][0]["path"]).strip("/"))[1:]
    inner = {name: shape for name, shape in shapes.items() if name.startswith(before)}
    asked = replace(request, member=None) if is_group else request
    return asked.choose_array(inner, "3D array").strip("/")


def _named_axes(nodes: dict[str, Document], name: str, array: Any, request: Request) -> list[Axis]:
    """Return the axes of an array by the names of its dimensions, and by arrays of these names."""
    said = getattr(array.metadata, "dimension_names", None)
    names = [str(each or "") for each in said or array.attrs.get("_ARRAY_DIMENSIONS") or ()]
    names = names if len(names) == array.ndim else [""] * array.ndim
    group, axes = name.rpartition("/")[0], []
    for axis, count in zip(names, array.shape):
        path = f"{group}/{axis}".lstrip("/")
        is_there = bool(name and axis) and nodes.get(path, {}).get("shape") == [count]
        places = _open(nodes, path, request)[:] if is_there else None
        axes.append(measured(axis, places, nodes.get(path, {}).get("attributes") or {}))
    return axes


def _image_axes(nodes: dict[str, Document], name: str) -> list[Axis] | None:
    """Return the axes of an array that is a level of an image of OME, None if it is of none."""
    parts = name.split("/") if name else []
    levels = (
        (image, level)
        for depth in range(len(parts))
        for image in _images(nodes, "/".join(parts[:depth]))
        for level in image["datasets"]
        if str(level["path"]).strip("/") == "/".join(parts[depth:])
    )
    if not (found := next(levels, None)):
        return None
    image, level = found
    axes = [axis if isinstance(axis, dict) else {"name": axis} for axis in image.get("axes", "zyx")]
    steps = [*level.get(TRANSFORMS, ()), *image.get(TRANSFORMS, ())]  # in this order
    scale, shift = np.ones(len(axes)), np.zeros(len(axes))
    for step in steps:
        kind = str(step.get("type"))
        numbers = np.asarray(step.get(kind, ()), np.float64)
        if kind == "scale":
            scale, shift = scale * numbers, shift * numbers
        elif kind == "translation":
            shift = shift + numbers
        elif kind != "identity":
            said = f"one of its {TRANSFORMS} has the type {kind!r}"
            raise GridError(f"{said}: give scale or translation")
    places = zip(scale.tolist(), shift.tolist()) if steps else [(None, None)] * len(axes)
    return [
        Axis(str(axis.get("name", "")).lower(), str(axis.get("unit") or ""), *place)
        for axis, place in zip(axes, places)
    ]
