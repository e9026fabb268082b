"""The members of an ``.npz`` archive, read in pieces."""

from __future__ import annotations

import zipfile
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ..errors import FileError
from .volume import in_words_of


class ArrayHeader(NamedTuple):
    """Shape, order and type of an array."""

    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype[Any]

    @property
    def size(self) -> int:
        """Size of the array in bytes."""
        return prod(self.shape) * self.dtype.itemsize

    def __str__(self) -> str:
        return in_words_of(self.shape, self.dtype)


def open_archive(path: Path) -> zipfile.ZipFile:
    """Open an ``.npz`` archive."""
    try:
        return zipfile.ZipFile(path)
    except Exception as error:  # zipfile raises over ten kinds of error on damaged fields
        raise FileError(f"{path} is not a readable .npz archive: {error}") from None


class Member:
    """An array of an archive: its header, and its values as they are unpacked, in order."""

    def __init__(self, archive: zipfile.ZipFile, info: zipfile.ZipInfo, name: str) -> None:
        self.name, self.left = name, info.file_size
        try:
            self._file: Any = archive.open(info)
            read = npy.read_array_header_1_0
            if npy.read_magic(self._file) != (1, 0):
                read = npy.read_array_header_2_0
            self.header = ArrayHeader(*read(self._file))
            self.left -= self._file.tell()
        except Exception as error:
            raise FileError(f"{name} is not an .npy array, or damaged: {error}"[:300]) from None
        if self.header.dtype.hasobject:
            raise FileError(f"{name} holds Python objects: save the numbers alone")

    def read(self, count: int) -> bytes:
        """Return the next bytes."""
        try:
            data: bytes = self._file.read(count)
        except Exception as error:  # zipfile and zlib raise their own errors
            raise FileError(f"{self.name} is damaged: {error}") from None
        if len(data) < count:
            raise FileError(f"{self.name} is damaged: {count - len(data):,} bytes are missing")
        return data

    def array(self) -> NDArray[Any]:
        """Return the whole array."""
        raw = np.frombuffer(self.read(self.header.size), self.header.dtype)
        return raw.reshape(self.header.shape, order="F" if self.header.fortran_order else "C")
