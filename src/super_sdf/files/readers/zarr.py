"""Zarr arrays in folders and zip files, with zarr.

They are (z, y, x) unless OME metadata, names of dimensions as xarray writes them, or ``--axes`` say
otherwise. OME's are levels of an image, of versions 0.4 and 0.5 of OME-NGFF: see
https://ngff.openmicroscopy.org/0.5/, ``multiscales`` metadata. The codecs of all arrays are checked
before anything is unpacked.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any
from zipfile import ZipFile

import numpy as np

from ...errors import FileError, GridError, seen
from ..formats import check_beside
from . import Axis, Request, Volume, measured, placed, stored

CODECS_IN = ("compressor", "filters", "codecs", "index_codecs")  # keys of metadata
# None of these runs what the store names, and all return numbers.
CODECS = {
    *("bytes", "endian", "transpose", "sharding_indexed", "crc32c"),
    *("blosc", "bz2", "gzip", "lz4", "lzma", "pcodec", "zfpy", "zlib", "zstd"),
    *("adler32", "crc32", "fletcher32", "jenkins_lookup3"),
    *("astype", "bitround", "delta", "fixedscaleoffset", "packbits", "quantize", "shuffle"),
}
TRANSFORMS = "coordinateTransformations"


def read_zarr(request: Request) -> Volume:
    """Read ``FOLDER.zarr``, or ``FOLDER.zarr:/ARRAY`` of a group; of OME-Zarr the finest level."""
    import zarr

    path = request.path
    store: Any = str(path)
    for each in path.rglob("*"):  # no link may lead out of a store
        if each.is_symlink() or not (each.is_dir() or each.is_file()):
            check_beside(path, each.relative_to(path).as_posix())
    if not path.is_dir():
        ZipFile(path).close()  # names what is no zip file, as zarr does not
        store = request.files.enter_context(zarr.storage.ZipStore(store, mode="r"))
    root = zarr.open(store, mode="r")
    nodes = {"": root, **dict(root.members(None) if isinstance(root, zarr.Group) else ())}
    for codec in (each for node in nodes.values() for each in _codecs_in(node.metadata.to_dict())):
        if codec not in CODECS:
            known = f"those that are read ({', '.join(sorted(CODECS))})"
            said = f"{path} names the codec {seen(codec)}, which is not among {known}"
            raise FileError(f"{said}: store it with one of these")
    levels = _levels(nodes)
    name = _choose(nodes, levels, request)
    array = nodes.get(name)
    if not isinstance(array, zarr.Array):
        raise FileError(f"{path} is damaged: its metadata names no array at {name!r}")
    attributes = array.attrs.asdict()
    if name not in levels:
        axes = _named_axes(nodes, name)
    else:
        axes, attributes = _image_axes(*levels[name][1:]), {}
        if not {*"xyz"} <= {axis.name for axis in axes} or len(axes) != array.ndim:
            raise GridError(f"its {array.ndim} axes are not named z, y, x by its metadata")
    none = array.fill_value if array.metadata.zarr_format == 2 else None  # as xarray takes it
    place = placed(request, array.shape, attributes, axes)
    return Volume(*stored(array, attributes, none), **place)


def _codecs_in(metadata: Any) -> Iterator[str]:
    """Yield the names of all codecs in metadata, those within a codec, too."""
    for key, value in metadata.items() if isinstance(metadata, dict) else ():
        inner = value if isinstance(value, (list, tuple)) else [value]
        for codec in inner if key in CODECS_IN and value is not None else ():
            named = codec if isinstance(codec, dict) else {"id": codec}
            names = {named[key] for key in ("id", "name") if key in named} or {None}
            yield from (str(name).removeprefix("numcodecs.") for name in names)
        for each in inner:
            yield from _codecs_in(each)


def _levels(nodes: dict[str, Any]) -> dict[str, tuple[str, Any, Any]]:
    """Return group, and metadata of image and level, of the arrays of OME-NGFF's images."""
    levels: dict[str, tuple[str, Any, Any]] = {}
    for group, node in nodes.items():
        attributes = node.attrs.asdict()
        for image in attributes.get("ome", attributes).get("multiscales") or ():
            for level in image["datasets"]:
                name = f"{group}/{str(level['path']).strip('/')}".strip("/")
                levels.setdefault(name, (group, image, level))
    return levels


def _choose(nodes: dict[str, Any], levels: dict[str, Any], request: Request) -> str:
    """Return the array to read: of an image the finest level, unless another is named."""
    named = (request.member or "").strip("/")
    if finest := [name for name, (group, *_) in levels.items() if group == named]:
        return finest[0]
    shapes = {f"/{name}": getattr(node, "shape", ()) for name, node in sorted(nodes.items())}
    if named and not shapes.get(f"/{named}", named):  # a group
        shapes = {name: shape for name, shape in shapes.items() if name.startswith(f"/{named}/")}
        request = replace(request, member=None)
    return request.choose_array(shapes).strip("/")


def _named_axes(nodes: dict[str, Any], name: str) -> list[Axis]:
    """Return the axes of an array by the names of its dimensions, and by arrays of these names."""
    array, folder = nodes[name], name.rpartition("/")[0]
    said = getattr(array.metadata, "dimension_names", None)
    said = said or array.attrs.get("_ARRAY_DIMENSIONS") or ()
    names = [str(each or "") for each in said] if len(said) == array.ndim else [""] * array.ndim
    scales = (nodes.get(f"{folder}/{axis}".lstrip("/")) if axis else None for axis in names)
    return list(map(measured, names, array.shape, scales))


def _image_axes(image: Any, level: Any) -> list[Axis]:
    """Return the axes of an array that is a level of an image of OME-NGFF."""
    axes = [axis if isinstance(axis, dict) else {"name": axis} for axis in image.get("axes", "zyx")]
    steps = [*level.get(TRANSFORMS, ()), *image.get(TRANSFORMS, ())]  # in this order
    scale, shift = np.ones(len(axes)), np.zeros(len(axes))
    for step in steps:
        kind = str(step.get("type"))
        if kind not in ("scale", "translation", "identity"):
            raise GridError(f"one of its {TRANSFORMS} is a {kind}: give scale or translation")
        factor = np.asarray(step.get("scale", 1), np.float64)
        scale, shift = scale * factor, shift * factor + np.asarray(step.get("translation", 0))
    places = zip(scale.tolist(), shift.tolist()) if steps else [(None, None)] * len(axes)
    return [
        Axis(str(axis.get("name", "")).lower(), str(axis.get("unit") or ""), *place)
        for axis, place in zip(axes, places)
    ]
