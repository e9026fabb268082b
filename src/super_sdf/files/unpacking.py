"""Arrays that cannot be read where they are: packed ones, and those of which x runs fastest.

Each is copied once, from its first byte to its last: into memory if it is small, else into a
temporary file, which has no name and is gone with the process, however that ends.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from io import FileIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, OutOfMemoryError
from ..grid.planes import InputFile, PlaneFile, Samples
from ..machine.memory import in_words
from .headers import ArrayHeader, Read

PIECE = 1 << 23  # bytes at a time
ON_DISK = "/var/tmp"  # /tmp is in memory on many systems

Write = Callable[[int, NDArray[np.uint8]], None]
"""Puts bytes at a place, counted from the beginning."""


def unpack(read: Read, header: ArrayHeader, name: str, room: int) -> Samples:
    """Return the three-dimensional array whose bytes come from ``read``.

    Parameters
    ----------
    read : callable
        Gives the bytes behind the header.
    header : ArrayHeader
        What they are.
    name : str
        What errors call the array.
    room : int
        The bytes that it may take of memory.

    Raises
    ------
    OutOfMemoryError
        If it is larger than that, and than what is free where temporary files go.
    """
    copy_all = _copy_turned if header.fortran_order else _copy
    if header.size <= room:
        held = np.empty(header.size, np.uint8)
        copy_all(read, header, _writer_to(held))
        return _as_planes(held, header)
    file = _scratch_file(header, name)
    copy_all(read, header, _writer_to_file(file, name))
    return PlaneFile(
        InputFile(file, name), 0, header.shape, header.dtype, turned=header.fortran_order
    )


def _as_planes(held: NDArray[np.uint8], header: ArrayHeader) -> NDArray[Any]:
    """Return bytes as the array that they are."""
    nx, ny, nz = header.shape
    if header.fortran_order:
        return held.view(header.dtype).reshape(nx, nz, ny).transpose(0, 2, 1)
    return held.view(header.dtype).reshape(nx, ny, nz)


def _copy(read: Read, header: ArrayHeader, write: Write) -> None:
    """Copy an array."""
    for start in range(0, header.size, PIECE):
        write(start, np.frombuffer(read(min(PIECE, header.size - start)), np.uint8))


def _copy_turned(read: Read, header: ArrayHeader, write: Write) -> None:
    """Copy an array of which x runs fastest, then y, so that x runs slowest, then z.

    So a plane of x is in one piece, and a few planes of z at a time go in pieces of some kilobytes.
    """
    nx, ny, nz = header.shape
    size = header.dtype.itemsize
    step = max(PIECE // (nx * ny * size), 1)
    for first in range(0, nz, step):
        count = min(step, nz - first)
        planes = np.frombuffer(read(count * nx * ny * size), header.dtype)
        turned = np.ascontiguousarray(planes.reshape(count * ny, nx).T).view(np.uint8)
        for i, piece in enumerate(turned):
            write((i * nz + first) * ny * size, piece)


def _writer_to(held: NDArray[np.uint8]) -> Write:
    """Return what writes to memory."""

    def write(start: int, piece: NDArray[np.uint8]) -> None:
        held[start : start + len(piece)] = piece

    return write


def _writer_to_file(file: FileIO, name: str) -> Write:
    """Return what writes to a file."""

    def write(start: int, piece: NDArray[np.uint8]) -> None:
        rest = piece.data
        try:
            file.seek(start)
            while rest:
                rest = rest[file.write(rest) :]
        except OSError as error:
            raise FileError(
                f"{name} cannot be unpacked to {scratch_folder()}: {error.strerror or error}; "
                "set TMPDIR to another folder"
            ) from None

    return write


def scratch_folder() -> str:
    """Return the folder for temporary files: that of TMPDIR, else one on a disk."""
    if not os.environ.get("TMPDIR") and os.access(ON_DISK, os.W_OK):
        return ON_DISK
    return tempfile.gettempdir()


def _scratch_file(header: ArrayHeader, name: str) -> FileIO:
    """Return an empty file without a name, where there is room for an array."""
    folder = scratch_folder()
    free = shutil.disk_usage(folder).free
    if header.size > free:
        raise OutOfMemoryError(
            f"{name}, {header}, is too large to unpack into memory, and {folder} has "
            f"{in_words(free)} free; save it as .npy, its last axis fastest, or set TMPDIR to a "
            "folder with more room"
        )
    try:
        return tempfile.TemporaryFile(dir=folder, prefix="super-sdf-", buffering=0)
    except OSError as error:
        raise FileError(f"no temporary file can be made in {folder}: {error.strerror}") from None
