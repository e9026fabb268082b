"""Arrays that cannot be read plane by plane in their file: compressed, or in Fortran order.

Each is copied once, from its first byte to its last: into memory if it is small, else into a
temporary file without a name, which disappears with the process, however that ends.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from functools import partial
from io import FileIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, OutOfMemoryError
from ..grid.planes import InputFile, PlaneFile, SampleArray
from ..machine.memory import in_words, is_in_memory
from .headers import ArrayHeader, Read

PIECE = 1 << 23  # bytes at a time
# No grid with a surface is compressed further than this; deflate reaches 1,030 on zeros.
BOMB_RATIO = 500
ON_DISK = "/var/tmp"  # /tmp is in memory on many systems

Write = Callable[[int, NDArray[np.uint8]], None]
"""Writes bytes at an offset from the beginning."""


def check_ratio(header: ArrayHeader, packed: int, name: str, room: int) -> None:
    """Raise OutOfMemoryError if an array is compressed as no grid is, and does not fit in ``room``.

    So no scratch file takes more than ``BOMB_RATIO`` times the bytes of the input.
    """
    if header.size > room and header.size > BOMB_RATIO * packed:
        raise OutOfMemoryError(
            f"{name}, {header}, is compressed to {packed:,} bytes, like a zip bomb, and does not "
            "fit in memory; if it is a grid, save it as .npy"
        )


def unpack(read: Read, header: ArrayHeader, name: str, room: int) -> SampleArray:
    """Return the 3D array (nx, ny, nz) whose bytes come from ``read``.

    Parameters
    ----------
    read : callable
        Returns the next bytes after the header.
    header : ArrayHeader
        Shape, dtype and order of the array.
    name : str
        The name of the array in error messages.
    room : int
        Bytes of memory that the array may take.

    Returns
    -------
    array or PlaneFile
        In memory if it fits in ``room``, else in a temporary file.

    Raises
    ------
    OutOfMemoryError
        If it fits neither in ``room`` nor in the folder for temporary files.
    """
    copy_all = _copy_swapped if header.fortran_order else _copy
    return fill(partial(copy_all, read, header), header, name, room)


def fill(copy: Callable[[Write], None], header: ArrayHeader, name: str, room: int) -> SampleArray:
    """Return the 3D array (nx, ny, nz) that ``copy`` writes.

    Parameters
    ----------
    copy : callable
        Called with a function that writes bytes; planes of x are contiguous. In them y is fastest
        if the header says Fortran order, else z.
    header, name, room
        As in ``unpack``.
    """
    if header.size <= room:
        held = np.empty(header.size, np.uint8)
        copy(_writer_to(held))
        return _as_planes(held, header)
    file = _scratch_file(header, name)
    copy(_writer_to_file(file, name))
    return PlaneFile(
        InputFile(file, name), 0, header.shape, header.dtype, swapped=header.fortran_order
    )


def _as_planes(held: NDArray[np.uint8], header: ArrayHeader) -> NDArray[Any]:
    """Return a view of the bytes as an array (nx, ny, nz)."""
    nx, ny, nz = header.shape
    if header.fortran_order:
        return held.view(header.dtype).reshape(nx, nz, ny).transpose(0, 2, 1)
    return held.view(header.dtype).reshape(nx, ny, nz)


def _copy(read: Read, header: ArrayHeader, write: Write) -> None:
    """Copy an array in C order."""
    for start in range(0, header.size, PIECE):
        write(start, np.frombuffer(read(min(PIECE, header.size - start)), np.uint8))


def _copy_swapped(read: Read, header: ArrayHeader, write: Write) -> None:
    """Copy an array in Fortran order (x fastest, then y, then z) to the order x, z, y (y fastest).

    Then a plane of x is contiguous, and each chunk of z planes is written in pieces of kilobytes.
    """
    nx, ny, nz = header.shape
    size = header.dtype.itemsize
    step = max(PIECE // (nx * ny * size), 1)
    for first in range(0, nz, step):
        count = min(step, nz - first)
        planes = np.frombuffer(read(count * nx * ny * size), header.dtype)
        swapped = np.ascontiguousarray(planes.reshape(count * ny, nx).T).view(np.uint8)
        for i, piece in enumerate(swapped):
            write((i * nz + first) * ny * size, piece)


def _writer_to(held: NDArray[np.uint8]) -> Write:
    """Return a function that writes to memory."""

    def write(start: int, piece: NDArray[np.uint8]) -> None:
        held[start : start + len(piece)] = piece

    return write


def _writer_to_file(file: FileIO, name: str) -> Write:
    """Return a function that writes to a file."""

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
    """Return the folder for temporary files: TMPDIR, else one on a disk."""
    if not os.environ.get("TMPDIR") and os.access(ON_DISK, os.W_OK):
        return ON_DISK
    return tempfile.gettempdir()


def _scratch_file(header: ArrayHeader, name: str) -> FileIO:
    """Return an empty unnamed file with room for an array, on a disk: memory would count."""
    folder = scratch_folder()
    if is_in_memory(folder):
        raise OutOfMemoryError(
            f"{name}, {header}, is too large to unpack into memory, and {folder} is in memory, "
            "too: set TMPDIR to a folder on a disk, or allow more (--max-memory)"
        )
    free = shutil.disk_usage(folder).free
    if header.size > free:
        raise OutOfMemoryError(
            f"{name}, {header}, is too large to unpack into memory, and {folder} has "
            f"{in_words(free)} free; save it as .npy in C order, or set TMPDIR to a folder "
            "with more room"
        )
    try:
        return tempfile.TemporaryFile(dir=folder, prefix="super-sdf-", buffering=0)
    except OSError as error:
        raise FileError(f"no temporary file can be made in {folder}: {error.strerror}") from None
