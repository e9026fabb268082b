"""Arrays as they are: NumPy's ``.npy`` (one array) and ``.npz`` (a zip of arrays), and ``.sdf``.

The keys of an ``.npz`` are ``values`` and, optionally, ``spacing``, ``origin`` and ``direction``.
Or they are those of Open3D's ``VoxelBlockGrid``. The ``.sdf`` of SDFGen has three dialects:

- Text: ``ni nj nk``, the origin, the spacing, then the values, i fastest.
- ``#sdf 1``: two lines of text and float32 values, k fastest; no spacing, no origin.
- 36 bytes of header (three int32 sizes, the least and the largest corner of the cells as float32),
  then float32 values, k fastest; sample (0, 0, 0) is at the least corner.
"""

from __future__ import annotations

import re
import struct
from typing import Any
from zipfile import is_zipfile

import numpy as np
from numpy.lib import format as npy

from ...errors import FileError
from ..formats import plugin
from . import PLACE, Request, Volume, placed, stored, triple

OPEN3D = ("key", "voxel_size", "block_resolution", "attr_name_tsdf", "attr_name_weight")
SDF_HEADER = struct.Struct("<3i6f")
SDF_TAGGED = re.compile(rb"#sdf 1\r?\ndim +(\d{1,9}) +(\d{1,9}) +(\d{1,9})\s*\ndata\r?\n")
SDF_TEXT = re.compile(rb"[\s\d.+\-a-zA-Z]+")


def read_npy(request: Request) -> Volume:
    """Read an ``.npy`` file, which is mapped into memory."""
    values = npy.open_memmap(request.path, mode="r")
    return Volume(*stored(values), **placed(request, values.shape, {}), is_mapped=True)


def read_npz(request: Request) -> Volume:
    """Read an array of an ``.npz`` file, by default ``values``, else the only one of three axes."""
    if not is_zipfile(request.path):  # NumPy would take it for a pickle
        raise FileError(f"{request.path} is not a readable .npz archive: write it by numpy.savez")
    archive = request.files.enter_context(np.load(request.path, allow_pickle=False))
    keys = set(archive.files)
    if set(OPEN3D) <= keys:
        return _blocks_of_open3d(request, archive)
    if {"voxels", "factor"} <= keys:
        way_out = "mesh it with extract_mesh(read_field(path))"
        raise FileError(f"{request.path} is a refined field, no grid: {way_out}")
    shapes, dtypes = {}, {}
    for key in (key for key in archive.files if key not in PLACE):
        with archive.zip.open(f"{key}.npy") as file:  # without its samples
            is_first = npy.read_magic(file) == (1, 0)
            read = npy.read_array_header_1_0 if is_first else npy.read_array_header_2_0
            shapes[key], _, dtypes[key] = read(file)
    is_plain = "values" in keys and request.member is None
    name = "values" if is_plain else request.choose_array(shapes)
    place = placed(request, shapes[name], {key: archive[key] for key in keys & set(PLACE)})
    return Volume(lambda at: archive[name][at], shapes[name], dtypes[name], **place)


def read_plugin(request: Request) -> Volume:
    """Read a file by the function of another package, which returns the keys of an ``.npz``."""
    found = plugin("readers", request.path.suffix).load()(request.path)
    values = np.asanyarray(found["values"])
    place = placed(request, values.shape, {key: found[key] for key in PLACE if key in found})
    return Volume(*stored(values), **place)


def _blocks_of_open3d(request: Request, archive: Any) -> Volume:
    """Return the truncated distances in cubes of voxels: without weight, they are unknown."""
    keys, step, resolution, *numbers = (archive[name] for name in OPEN3D)
    values, weights = (archive[f"value_{int(number.item()):03d}"] for number in numbers)
    low, side, step = keys.min(0).astype(np.int64), int(resolution.item()), float(step.item())
    starts = (keys - low) * side
    shape = tuple((starts.max(0) + side).tolist())
    samples = np.where(weights > 0, values, np.nan)[..., 0].transpose(0, 3, 2, 1)  # block, x, y, z
    request.check_fits(shape, samples.dtype)
    whole = np.full(shape, np.nan, samples.dtype)
    for (x, y, z), block in zip(starts, samples):
        whole[x : x + side, y : y + side, z : z + side] = block
    return Volume(*stored(whole), (step,) * 3, triple(step * side * low))


def read_sdf(request: Request) -> Volume:
    """Read an ``.sdf`` file of any of the three dialects."""
    path, place = request.path, dict[str, Any]()
    with path.open("rb") as file:
        beginning = file.read(4096)
    if tagged := SDF_TAGGED.match(beginning):
        start, shape = tagged.end(), tuple(map(int, tagged.groups()))
    elif SDF_TEXT.fullmatch(beginning):
        words = path.read_bytes().split()
        shape = tuple(map(int, words[:3]))
        x, y, z, spacing = map(float, words[3:7])
        values = np.array(words[7:], np.float32).reshape(shape[::-1]).T
        return Volume(*stored(values), (spacing,) * 3, (x, y, z))
    else:
        start, fields = SDF_HEADER.size, SDF_HEADER.unpack(beginning[: SDF_HEADER.size])
        shape, low, high = fields[:3], np.array(fields[3:6]), fields[6:]
        if min(shape) < 1 or not (high > low).all():
            raise FileError("it is neither SDFGen's text nor a binary grid")
        place = {"spacing": triple((high - low) / shape), "origin": triple(low)}
    values = np.memmap(path, "<f4", "r", start)
    return Volume(*stored(values.reshape(shape)), **place, is_mapped=True)
