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
from math import prod
from typing import IO, Any
from zipfile import is_zipfile

import numpy as np
from numpy.lib import format as npy

from ...errors import FileError, GridError
from . import PLACE, Request, Volume, axes_direction, of_array, triple

OPEN3D = ("key", "voxel_size", "block_resolution", "attr_name_tsdf", "attr_name_weight")
SDF_HEADER = struct.Struct("<3i6f")
SDF_TAGGED = re.compile(rb"#sdf 1\r?\ndim +(\d{1,9}) +(\d{1,9}) +(\d{1,9})\s*\ndata\r?\n")
SDF_TEXT = re.compile(rb"[\s\d.+\-a-zA-Z]+")
FLOAT = np.dtype("<f4")


def _header(file: IO[bytes], name: str) -> tuple[tuple[int, ...], str, np.dtype[Any]]:
    """Return shape, order and type of an array with its header."""
    try:
        version = npy.read_magic(file)
        read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, is_fortran, dtype = read(file)
    except Exception:  # NumPy evaluates the text as Python, which fails in many ways
        raise FileError(f"{name} is not an .npy array: its header cannot be read") from None
    return shape, "Fortran" if is_fortran else "C", dtype


def _volume(request: Request, load: Any, header: Any, **more: Any) -> Volume:
    """Return an array with a header, in the order of axes that was asked for."""
    shape, order, dtype = header
    place: Any = {"direction": axes_direction(request.axes), "axes": request.axes}
    index, about = request.pick(shape), {"order": order}
    return Volume(load, shape, dtype, index=index, about=about, **place, **more)


def read_npy(request: Request) -> Volume:
    """Read an ``.npy`` file, which is mapped into memory."""
    with request.path.open("rb") as file:
        header = _header(file, str(request.path))

    def load(index: Any) -> Any:
        return np.load(request.path, mmap_mode="r", allow_pickle=False)[index]

    return _volume(request, load, header, is_mapped=True)


def read_npz(request: Request) -> Volume:
    """Read an array of an ``.npz`` file, by default ``values``, else the only one of three axes."""
    if not is_zipfile(request.path):  # NumPy would take it for a pickle
        raise FileError(f"{request.path} is not a readable .npz archive: write it by numpy.savez")
    archive = request.files.enter_context(np.load(request.path, allow_pickle=False))
    keys = archive.files
    if set(OPEN3D) <= set(keys):
        return _blocks_of_open3d(archive)
    if {"voxels", "factor"} <= set(keys):
        way_out = "mesh it with extract_mesh(read_field(path))"
        raise FileError(f"{request.path} is a refined field, no grid: {way_out}")
    headers, zipped = {}, archive.zip
    for key in set(keys) - set(PLACE):
        info = zipped.getinfo(f"{key}.npy" if f"{key}.npy" in zipped.namelist() else key)
        with zipped.open(info) as file:
            headers[key] = _header(file, f"{request.path}[{key}]")
    shapes = {key: headers[key][0] for key in keys if key in headers}
    is_plain = "values" in keys and request.member is None
    if not is_plain and max(map(len, shapes.values()), default=0) < 3:
        held = ", ".join(keys) or "nothing"
        raise FileError(f"{request.path} has no key 'values' (it holds {held})")
    name = "values" if is_plain else request.choose_array(shapes, "array of three axes")
    place: dict[str, Any] = {}
    for key in set(PLACE) & set(keys):
        place[key] = archive[key]
        most, asked = (9, "nine numbers") if key == "direction" else (3, "one number or three")
        if place[key].size > most or place[key].dtype.kind not in "fiu":
            said = f"shape {place[key].shape} and dtype {place[key].dtype}"
            raise GridError(f"{request.path}[{key}] has {said}: give {asked}")
    return _volume(request, lambda index: archive[name][index], headers[name], place=place)


def _blocks_of_open3d(archive: Any) -> Volume:
    """Return the truncated distances in cubes of voxels: without weight, they are unknown."""
    keys, step, resolution, *numbers = (archive[name] for name in OPEN3D)
    values, weights = (archive[f"value_{int(number.item()):03d}"] for number in numbers)
    low, side, step = keys.min(0).astype(np.int64), int(resolution.item()), float(step.item())
    starts = (keys - low) * side
    shape = tuple((starts.max(0) + side).tolist())
    samples = np.where(weights > 0, values, np.nan)[..., 0].transpose(0, 3, 2, 1)  # block, x, y, z

    def load(index: Any) -> Any:
        whole = np.full(shape, np.nan, samples.dtype)
        for (x, y, z), block in zip(starts, samples):
            whole[x : x + side, y : y + side, z : z + side] = block
        return whole

    return Volume(load, shape, samples.dtype, (step,) * 3, triple(step * side * low))


def read_sdf(request: Request) -> Volume:
    """Read an ``.sdf`` file of any of the three dialects."""
    path, place = request.path, dict[str, Any]()
    with path.open("rb") as file:
        beginning = file.read(4096)
    if tagged := SDF_TAGGED.match(beginning):
        start, shape = tagged.end(), tuple(map(int, tagged.groups()))
    elif SDF_TEXT.fullmatch(beginning):
        words = path.read_bytes().split()
        try:
            shape = tuple(max(int(word), 0) for word in words[:3])
            x, y, z, spacing = (float(word) for word in words[3:7])
            values = np.array(words[7:], np.float32).reshape(shape[::-1]).T
        except (ValueError, OverflowError):
            said = "three sizes, the origin and the spacing, and a value for each sample follows"
            said = f"or truncated: SDFGen's text begins with {said}"
            raise FileError(f"{path} is no .sdf grid, {said}") from None
        return Volume(*of_array(values), (spacing,) * 3, (x, y, z))
    else:
        fields = SDF_HEADER.unpack(beginning[: SDF_HEADER.size].ljust(SDF_HEADER.size, b"\0"))
        start, shape, low, high = SDF_HEADER.size, fields[:3], np.array(fields[3:6]), fields[6:]
        if min(shape) < 1 or not (high > low).all():
            said = "it is neither SDFGen's text nor a binary grid"
            raise FileError(f"{path} is no .sdf grid: {said} (#sdf 1, or sizes, box and values)")
        place = {"spacing": triple((high - low) / shape), "origin": triple(low)}
    follow, promised = path.stat().st_size - start, prod(shape) * FLOAT.itemsize
    if promised != follow:
        raise FileError(f"{path} is damaged: {promised:,} bytes are promised, {follow:,} follow")
    return Volume(*of_array(np.memmap(path, FLOAT, "r", start, shape)), **place, is_mapped=True)
