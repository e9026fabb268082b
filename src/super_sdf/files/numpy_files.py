"""NumPy's files: ``.npy`` (one array) and ``.npz`` (a zip archive of arrays), checked before use.

The keys of an ``.npz`` are ``values`` and, optionally, ``spacing``, ``origin`` and ``direction``.
Or they are those of Open3D's ``VoxelBlockGrid``.
"""

from __future__ import annotations

import warnings
import zipfile
from contextlib import suppress
from copy import copy
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ..errors import FileError, GridError, OutOfMemoryError
from ..grid.planes import InputFile, PlaneFile
from .streams import CODECS, Read, Unpacker, bytes_from, next_planes
from .volume import (PLACE, ZYX, Request, Volume, axes_direction, in_short, in_words_of, kept_axes, triple)

LONGEST = 10_000  # bytes of a header, NumPy's limit
LARGEST = 10**18  # samples along an axis
OPEN3D = {"key.npy", "voxel_size.npy", "block_resolution.npy", "attr_name_tsdf.npy"}


class ArrayHeader(NamedTuple):
    """Shape, order and type of an array of plain numbers, and the bytes of its header."""

    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype[Any]
    length: int

    @property
    def size(self) -> int:
        """Size of the array in bytes."""
        return prod(self.shape) * self.dtype.itemsize

    def __str__(self) -> str:
        return in_words_of(self.shape, self.dtype)

    def check_size(self, follow: int, name: str) -> None:
        """Raise FileError unless ``follow`` bytes, those after the header, are the array."""
        sizes = f"its header promises {self}, but {follow:,} follow"
        if self.size > follow:
            raise FileError(f"{name} is truncated: {sizes}")
        if self.size < follow:
            raise FileError(f"{name} holds more than one array, or its header is damaged: {sizes}")

    def volume(self, axes: str, **about: Any) -> Volume:
        """Return the array as a volume whose first axis is the slowest in the file."""
        shape = tuple(self.shape[axis] for axis in kept_axes(self.shape))
        if self.fortran_order and len(shape) == 3:
            shape, axes = shape[::-1], axes[::-1]
        order = {"order": "Fortran" if self.fortran_order else "C"}
        return Volume(
            shape, self.dtype, direction=axes_direction(axes), axes=axes, about=order, **about
        )


class _Head:
    """The bytes of a file from its beginning on; NumPy reads as many as a header claims."""

    def __init__(self, read: Read) -> None:
        self._read, self.taken = read, 0

    def read(self, count: int) -> bytes:
        if count > LONGEST:
            raise ValueError(count)
        data = self._read(count)
        self.taken += len(data)
        return data


def read_array_header(read: Read, name: str) -> ArrayHeader:
    """Read a header of format 1, 2 or 3; raise FileError unless it is one of plain numbers."""
    head: Any = _Head(read)
    try:
        version = npy.read_magic(head)
        parse = {
            (1, 0): npy.read_array_header_1_0,
            (2, 0): npy.read_array_header_2_0,
            (3, 0): npy.read_array_header_2_0,  # differs in the names of records alone
        }[version]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            header = ArrayHeader(*parse(head, max_header_size=LONGEST), head.taken)
        if not 0 <= min(header.shape, default=0) <= max(header.shape, default=0) <= LARGEST:
            raise ValueError(header.shape)
    except FileError:
        raise
    except Exception:  # NumPy evaluates the text as Python, which fails in many ways
        raise FileError(f"{name} is not an .npy array: its header cannot be read") from None
    if header.dtype.hasobject:
        raise FileError(f"{name} holds Python objects: save the numbers alone")
    if header.dtype.names or header.dtype.subdtype:
        raise FileError(f"{name} holds records, {header.dtype}: save the distances alone"[:200])
    return header


def read_npy(request: Request) -> Volume:
    """Read an ``.npy`` file; its planes are not loaded but read from it, if it is in C order."""
    file = InputFile.open(request.path)
    header = read_array_header(bytes_from(file, 0), file.name)
    header.check_size(file.size - header.length, file.name)
    volume = header.volume(request.axes)
    planes = PlaneFile(file, header.length, volume.shape, volume.dtype)
    return replace(volume, read=planes.read, stored=planes)


def open_archive(path: Path) -> zipfile.ZipFile:
    """Open an ``.npz`` archive, each member of which has one name in its two headers."""
    try:
        archive = zipfile.ZipFile(path)
        for info in archive.infolist():
            with suppress(RuntimeError, NotImplementedError):  # one that is not read may be packed
                archive.open(info).close()  # or encrypted as it likes
        return archive
    except Exception as error:  # zipfile raises over ten kinds of error on damaged fields
        raise FileError(f"{path} is not a readable .npz archive: {error}") from None


class Member:
    """An array of an archive: its header, and its values as they are unpacked, in order."""

    def __init__(self, archive: zipfile.ZipFile, info: zipfile.ZipInfo, name: str) -> None:
        self.name, self.packed, self.left = name, info.compress_size, info.file_size
        if info.flag_bits & 1:
            raise FileError(f"{name} is encrypted: save it without a password")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2):
            raise FileError(
                f"{name} is compressed by a method that NumPy does not write "
                f"({info.compress_type}): use np.savez_compressed"
            )
        try:
            self._file: Any = archive.open(info)
            if info.compress_type == zipfile.ZIP_BZIP2:  # which zipfile unpacks without a bound
                stored = copy(info)
                stored.compress_type, stored.file_size = zipfile.ZIP_STORED, info.compress_size
                del stored.CRC  # that of what is unpacked; bzip2 has its own
                packed = archive.open(stored).read
                self._file = Unpacker(packed, CODECS["bz2"](), self.left, name)
        except Exception as error:
            raise FileError(f"{name} is damaged: {error}") from None
        self.header = read_array_header(self.read, name)

    def read(self, count: int) -> bytes:
        """Return the next bytes, or fewer at the end, where the checksum is compared."""
        try:
            data: bytes = self._file.read(count)
        except FileError:
            raise
        except zipfile.BadZipFile:
            raise FileError(f"{self.name} is damaged: its checksum is wrong") from None
        except Exception as error:  # zipfile and zlib raise their own errors
            raise FileError(f"{self.name} is damaged: {error}") from None
        self.left -= len(data)
        if len(data) < min(count, self.left + len(data)):
            raise FileError(f"{self.name} is damaged: {self.left:,} bytes are missing")
        return data

    def array(self) -> NDArray[Any]:
        """Return the whole array, which may not be larger than what follows."""
        self.header.check_size(self.left, self.name)
        raw = np.frombuffer(self.read(self.header.size), self.header.dtype)
        return raw.reshape(self.header.shape, order="F" if self.header.fortran_order else "C")


def read_npz(request: Request) -> Volume:
    """Read the known arrays of an ``.npz`` file."""
    archive = request.files.enter_context(open_archive(request.path))
    if OPEN3D.issubset(archive.namelist()):
        return _read_blocks(archive, request)
    infos = _known_members(archive, request.path)
    place = {key: _read_small(archive, infos[key], request, key) for key in PLACE if key in infos}
    member = Member(archive, infos["values"], f"{request.path}[values]")
    header = member.header
    header.check_size(member.left, member.name)
    volume = header.volume(request.axes, place=place, packed=member.packed, part="[values]")
    planes = next_planes(member.read, volume.shape, volume.dtype)
    return replace(volume, read=planes)


def _known_members(archive: zipfile.ZipFile, path: Path) -> dict[str, zipfile.ZipInfo]:
    infos = archive.infolist()
    names = [info.filename.removesuffix(".npy") for info in infos]
    if {"voxels", "factor"} <= set(names):
        raise FileError(
            f"{path} is a refined field, no grid: mesh it with extract_mesh(read_field(path))"
        )
    if "values" not in names:
        raise FileError(f"{path} has no key 'values' (it holds {in_short(names) or 'nothing'})")
    keys = ("values", *PLACE)
    twice = next((key for key in keys if names.count(key) > 1), None)
    if twice:
        raise FileError(f"{path} holds {twice!r} {names.count(twice)} times: save it once")
    return {name: info for name, info in zip(names, infos) if name in keys}


def _read_small(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, request: Request, key: str
) -> NDArray[Any]:
    member = Member(archive, info, f"{request.path}[{key}]")
    most, asked = (9, "nine numbers") if key == "direction" else (3, "one number or three")
    header = member.header
    if prod(header.shape) > most:
        raise GridError(f"{member.name} has shape {header.shape}: give {asked}")
    if header.dtype.kind not in "fiu":
        raise GridError(f"{member.name} has dtype {header.dtype}: give {asked}")
    return member.array()


def _read_blocks(archive: zipfile.ZipFile, request: Request) -> Volume:
    """Return the truncated distances in cubes of voxels, at the keys of a hash map.

    Voxel (x, y, z) of the block with key k is at ``voxel_size * (k * resolution + (x, y, z))``;
    voxels without weight, and blocks that are missing, are unknown.
    """

    def array(key: str) -> NDArray[Any]:
        if f"{key}.npy" not in archive.namelist():
            raise FileError(f"{request.path} is Open3D's VoxelBlockGrid, but has no key {key!r}")
        member = Member(archive, archive.getinfo(f"{key}.npy"), f"{request.path}[{key}]")
        if member.header.size > request.room:
            raise OutOfMemoryError(
                f"{member.name}, {member.header}, does not fit: allow more (--max-memory)"
            )
        return member.array()

    keys = array("key").astype(np.int64)
    resolution, step = (array(name).item() for name in ("block_resolution", "voxel_size"))
    values, weights = (
        array(f"value_{array(f'attr_name_{name}').item():03d}") for name in ("tsdf", "weight")
    )
    blocks = (len(keys), *(resolution,) * 3, 1)
    if keys.shape != (len(keys), 3) or not len(keys) or not values.shape == weights.shape == blocks:
        raise GridError(f"its keys have shape {keys.shape}, its values {values.shape}")
    samples = np.where(weights > 0, values, np.nan)[..., 0]  # (block, z, y, x)
    low = keys.min(0)
    starts = (keys - low)[:, ::-1] * resolution
    shape = starts.max(0) + resolution

    def read(first: int, last: int) -> NDArray[Any]:
        planes = np.full((last - first, *shape[1:]), np.nan, samples.dtype)
        met = (starts[:, 0] < last) & (starts[:, 0] + resolution > first)
        for (z, y, x), block in zip(starts[met], samples[met]):
            cut = block[max(first - z, 0) : last - z]
            a = max(z - first, 0)
            planes[a : a + len(cut), y : y + resolution, x : x + resolution] = cut
        return planes

    sizes, origin = tuple(shape.tolist()), triple(step * resolution * low)
    return Volume(sizes, samples.dtype, read, (step,) * 3, origin, ZYX, packed=values.nbytes)


NUMPY_READERS = {"npy": read_npy, "npz": read_npz}
