"""NumPy's files: ``.npy`` (one array) and ``.npz`` (a zip archive of arrays).

The keys of an ``.npz`` are ``values`` and, optionally, ``spacing``, ``origin`` and ``direction``.
Or they are those of Open3D's ``VoxelBlockGrid``.
"""

from __future__ import annotations

from math import prod
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from ...errors import FileError, GridError
from ..volume import PLACE, Later, Request, Volume, axes_direction, in_words_of, kept_axes, triple

OPEN3D = {"key.npy", "voxel_size.npy", "block_resolution.npy", "attr_name_tsdf.npy"}


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
        raise FileError(
            f"{name} is truncated: its header promises {in_words_of(shape, dtype)}, but "
            f"{follow:,} follow"
        )
    return shape, "F" if is_fortran else "C", dtype


def _volume(values: Any, order: str, axes: str, **place: Any) -> Volume:
    about = {"order": "Fortran" if order == "F" else "C"}
    kept = kept_axes(values.shape)
    return Volume(
        values, direction=axes_direction(axes), kept=kept, axes=axes, about=about, place=place
    )


def read_npy(request: Request) -> Volume:
    """Read an ``.npy`` file, which is mapped into memory."""
    with request.path.open("rb") as file:
        shape, order, _ = _header(file, request.path.stat().st_size, str(request.path))
    if 0 in shape:
        raise GridError(f"values have shape {shape}: give at least 2 samples on each axis")
    values = np.load(request.path, mmap_mode="r", allow_pickle=False)
    return _volume(values, order, request.axes)


def read_npz(request: Request) -> Volume:
    """Read the known arrays of an ``.npz`` file."""
    archive = request.files.enter_context(np.load(request.path, allow_pickle=False))
    if not isinstance(archive, np.lib.npyio.NpzFile):
        raise FileError(f"{request.path} is not a readable .npz archive: it is one array")
    zipped: Any = archive.zip
    names = zipped.namelist()
    if OPEN3D.issubset(names):
        return _read_blocks(archive, request)
    if {"voxels", "factor"} <= set(archive.files):
        raise FileError(
            f"{request.path} is a refined field, no grid: mesh it with "
            "extract_mesh(read_field(path))"
        )
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
    member = "values.npy" if "values.npy" in names else "values"
    info = zipped.getinfo(member)
    with zipped.open(info) as file:
        shape, order, dtype = _header(file, info.file_size, f"{request.path}[values]")
    return _volume(
        Later(shape, dtype, lambda: archive["values"]), order, request.axes, **place
    )


def _read_blocks(archive: Any, request: Request) -> Volume:
    """Return the truncated distances in cubes of voxels, at the keys of a hash map.

    Voxel (x, y, z) of the block with key k is at ``voxel_size * (k * resolution + (x, y, z))``;
    voxels without weight, and blocks that are missing, are unknown.
    """

    def array(key: str) -> Any:
        if key not in archive.files:
            raise FileError(f"{request.path} is Open3D's VoxelBlockGrid, but has no key {key!r}")
        return archive[key]

    keys = array("key").astype(np.int64)
    resolution, step = (array(name).item() for name in ("block_resolution", "voxel_size"))
    values, weights = (
        array(f"value_{array(f'attr_name_{name}').item():03d}") for name in ("tsdf", "weight")
    )
    blocks = (len(keys), *(resolution,) * 3, 1)
    if keys.shape != (len(keys), 3) or not len(keys) or not values.shape == weights.shape == blocks:
        raise GridError(f"its keys have shape {keys.shape}, its values {values.shape}")
    samples = np.where(weights > 0, values, np.nan)[..., 0]
    samples = samples.transpose(0, 3, 2, 1)  # (block, x, y, z)
    low = keys.min(0)
    starts = (keys - low) * resolution
    shape = tuple((starts.max(0) + resolution).tolist())

    def load() -> Any:
        whole = np.full(shape, np.nan, samples.dtype)
        for (x, y, z), block in zip(starts, samples):
            whole[x : x + resolution, y : y + resolution, z : z + resolution] = block
        return whole

    origin = triple(step * resolution * low)
    return Volume(Later(shape, samples.dtype, load), (step,) * 3, origin)
