"""Arrays in files, read plane by plane.

Not mapped into memory: a map counts as memory of this process, and if another process cuts the file
off, the system kills whoever looks behind its new end. What is read here is what the file held when
it was opened, or an error.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import cached_property
from io import FileIO
from math import prod
from pathlib import Path
from threading import Lock
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..errors import FileError
from ..machine.memory import check_fits

BLOCK_BYTES = 1 << 20  # read at a time when all planes are


class InputFile:
    """A file that is read at any place, by any thread; it must not change meanwhile.

    Parameters
    ----------
    file : FileIO
        The open file.
    name : str
        What errors call it.

    Attributes
    ----------
    size : int
        Its bytes when it was opened.
    """

    def __init__(self, file: FileIO, name: str) -> None:
        self.file, self.name = file, name
        self.state = self._look()
        self.size = self.state[0]
        self._lock = Lock()

    @classmethod
    def open(cls, path: Path) -> InputFile:
        """Open a file by its path."""
        try:
            return cls(FileIO(str(path)), str(path))
        except OSError as error:
            raise FileError(f"{path} cannot be read: {error.strerror or error}") from None

    def __del__(self) -> None:
        if hasattr(self, "file"):
            self.file.close()

    def _look(self) -> tuple[int, int]:
        """Return size and time of the last change."""
        found = os.fstat(self.file.fileno())
        return found.st_size, found.st_mtime_ns

    def check_unchanged(self) -> None:
        """Raise FileError if the file was written to since it was opened."""
        if self._look() != self.state:
            raise FileError(f"{self.name} changed while it was read: read it when it is complete")

    def read_into(self, out: NDArray[Any], offset: int) -> None:
        """Fill an array, contiguous in memory, with what is in the file from ``offset`` on."""
        view = out.view(np.uint8).reshape(-1).data
        while view:
            count = self._read_some(view, offset)
            if not count:
                break
            view, offset = view[count:], offset + count
        self.check_unchanged()
        if view:
            raise FileError(f"{self.name} ends {len(view):,} bytes too early")

    def _read_some(self, view: memoryview, offset: int) -> int:
        """Read at least a byte unless the file ends; return how many."""
        try:
            if hasattr(os, "preadv"):  # no place that forked processes would share
                return os.preadv(self.file.fileno(), [view], offset)
            with self._lock:
                self.file.seek(offset)
                return self.file.readinto(view) or 0
        except OSError as error:
            raise FileError(f"{self.name} cannot be read: {error.strerror or error}") from None

    def read(self, offset: int, count: int) -> NDArray[np.uint8]:
        """Return at most ``count`` bytes from ``offset`` on, fewer only where the file ends."""
        out = np.empty(max(min(count, self.size - offset), 0), np.uint8)
        self.read_into(out, offset)
        return out


class PlaneFile:
    """An array in a file, of which planes along the first axis are read when asked for.

    Parameters
    ----------
    file : InputFile
        Where it is.
    offset : int
        The byte at which it begins.
    shape, dtype
        The array's, of three axes (nx, ny, nz).
    turned : bool
        In the file the last two axes are swapped: (nx, nz, ny).
    """

    ndim = 3

    def __init__(
        self,
        file: InputFile,
        offset: int,
        shape: tuple[int, ...],
        dtype: np.dtype[Any],
        *,
        turned: bool = False,
    ) -> None:
        self.file, self.offset = file, offset
        self.shape, self.dtype, self.turned = shape, dtype, turned
        self.plane_bytes = shape[1] * shape[2] * dtype.itemsize

    def __len__(self) -> int:
        return self.shape[0]

    def read(self, first: int, last: int) -> NDArray[Any]:
        """Return planes ``first`` to before ``last``.

        Raises
        ------
        FileError
            If the file was changed since it was opened, or cannot be read any more.
        """
        _, ny, nz = self.shape
        planes = np.empty(
            (max(last - first, 0), *((nz, ny) if self.turned else (ny, nz))), self.dtype
        )
        self.file.read_into(planes, self.offset + first * self.plane_bytes)
        return planes.transpose(0, 2, 1) if self.turned else planes

    def __getitem__(self, which: int | slice) -> NDArray[Any]:
        """Return one plane, or a run of planes, as of an array."""
        if isinstance(which, slice):
            first, last, step = which.indices(len(self))
            return self.read(first, last) if step == 1 else self.loaded[which]
        number = range(len(self))[which]
        plane: NDArray[Any] = self.read(number, number + 1)[0]
        return plane

    def __iter__(self) -> Iterator[NDArray[Any]]:
        step = max(BLOCK_BYTES // self.plane_bytes, 1)
        for first in range(0, len(self), step):
            yield from self.read(first, min(first + step, len(self)))

    @cached_property
    def loaded(self) -> NDArray[Any]:
        """The whole array; it stays in memory.

        Raises
        ------
        OutOfMemoryError
            If it is larger than what is free.
        """
        size = prod(self.shape) * self.dtype.itemsize
        check_fits(size, f"{self.file.name}, whole,", "read it plane by plane (SdfGrid.planes)")
        return self.read(0, len(self))

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self.loaded, dtype) if copy else np.asarray(self.loaded, dtype)

    def __reduce__(self) -> tuple[Any, ...]:
        """Give another process the array: it may not have the file."""
        return np.asarray, (self.loaded,)


Samples: TypeAlias = NDArray[Any] | PlaneFile
"""An array, or a file that is read as one."""
