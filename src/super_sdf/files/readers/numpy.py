"""NumPy's files: ``.npy`` (one array) and ``.npz`` (a zip archive of arrays).

The keys of an ``.npz`` are ``values`` and, optionally, ``spacing``, ``origin`` and ``direction``.
Or they are those of Open3D's ``VoxelBlockGrid``.
"""

from __future__ import annotations

from math import prod
from typing import IO, Any
from zipfile import is_zipfile

import numpy as np
from numpy.lib import format as npy

from ...errors import FileError, GridError
from ..volume import (
    PLACE,
    Request,
    Volume,
    axes_direction,
    in_words_of,
    kept_axes,
    of_array,
    triple,
)

OPEN3D = ("key", "voxel_size", "block_resolution", "attr_name_tsdf", "attr_name_weight")


def _header(file: IO[bytes], size: int, name: str) -> tuple[tuple[int, ...], str, np.dtype[Any]]:
    """Return shape, order and type of an array of ``size`` bytes with its header."""
    try:
        version = npy.read_magic(file)
        read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, is_fortran, dtype = read(file)
    except Exception:  # NumPy evaluates the text as Python, which fails in many ways
        raise FileError(f"{name} is not an .npy array: its header cannot be read") from None
    if dtype.hasobject:
        raise FileError(f"{name} holds Python objects: save the numbers alone")
    follow = size - file.tell()
    if prod(shape) * dtype.itemsize > follow:
        promised = in_words_of(shape, dtype)
        said = f"{name} is truncated: its header promises {promised}, but {follow:,} follow"
        raise FileError(said)
    return shape, "Fortran" if is_fortran else "C", dtype


def read_npy(request: Request) -> Volume:
    """Read an ``.npy`` file, which is mapped into memory."""
    with request.path.open("rb") as file:
        shape, order, _ = _header(file, request.path.stat().st_size, str(request.path))
    if 0 in shape:
        raise GridError(f"values have shape {shape}: give at least 2 samples on each axis")
    values = np.load(request.path, mmap_mode="r", allow_pickle=False)
    return Volume(
        *of_array(values),
        direction=axes_direction(request.axes),
        kept=kept_axes(shape),
        axes=request.axes,
        about={"order": order},
        is_mapped=True,
    )


def read_npz(request: Request) -> Volume:
    """Read the known arrays of an ``.npz`` file."""
    if not is_zipfile(request.path):  # NumPy would take it for a pickle
        raise FileError(f"{request.path} is not a readable .npz archive: write it by numpy.savez")
    archive = request.files.enter_context(np.load(request.path, allow_pickle=False))
    if set(OPEN3D) <= set(archive.files):
        return _blocks_of_open3d(archive)
    if {"voxels", "factor"} <= set(archive.files):
        way_out = "mesh it with extract_mesh(read_field(path))"
        raise FileError(f"{request.path} is a refined field, no grid: {way_out}")
    if "values" not in archive.files:
        held = ", ".join(archive.files) or "nothing"
        raise FileError(f"{request.path} has no key 'values' (it holds {held})")
    place: dict[str, Any] = {}
    for key in PLACE:
        if key in archive.files:
            place[key] = archive[key]
            most, asked = (9, "nine numbers") if key == "direction" else (3, "one number or three")
            if place[key].size > most or place[key].dtype.kind not in "fiu":
                said = f"shape {place[key].shape} and dtype {place[key].dtype}"
                raise GridError(f"{request.path}[{key}] has {said}: give {asked}")
    zipped: Any = archive.zip
    info = zipped.getinfo("values.npy" if "values.npy" in zipped.namelist() else "values")
    with zipped.open(info) as file:
        shape, order, dtype = _header(file, info.file_size, f"{request.path}[values]")
    return Volume(
        *(lambda: archive["values"], shape, dtype),
        direction=axes_direction(request.axes),
        kept=kept_axes(shape),
        axes=request.axes,
        about={"order": order},
        place=place,
    )


def _blocks_of_open3d(archive: Any) -> Volume:
    """Return the truncated distances in cubes of voxels, at the keys of a hash map.

    Voxel (x, y, z) of the block with key k is at ``voxel_size * (k * resolution + (x, y, z))``;
    voxels without weight, and blocks that are missing, are unknown.
    """
    keys, step, resolution, *numbers = (archive[name] for name in OPEN3D)
    values, weights = (archive[f"value_{int(number.item()):03d}"] for number in numbers)
    low, side, step = keys.min(0).astype(np.int64), int(resolution.item()), float(step.item())
    starts = (keys - low) * side
    shape = tuple((starts.max(0) + side).tolist())
    samples = np.where(weights > 0, values, np.nan)[..., 0].transpose(0, 3, 2, 1)  # block, x, y, z

    def load() -> Any:
        whole = np.full(shape, np.nan, samples.dtype)
        for (x, y, z), block in zip(starts, samples):
            whole[x : x + side, y : y + side, z : z + side] = block
        return whole

    return Volume(load, shape, samples.dtype, (step,) * 3, triple(step * side * low))
