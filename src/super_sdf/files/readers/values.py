"""The values of an array behind a header: raw, as text, or compressed; planes in order."""

from __future__ import annotations

import bz2
import zlib
from collections.abc import Callable
from math import prod
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError
from ...grid.planes import InputFile, PlaneFile
from ..archives import Codec, Deflate, Unpacker
from ..headers import ArrayHeader, Read

TEXT_PIECE = 1 << 20  # bytes of text at a time
NOT_SPACE = bytes(set(range(33, 127)))  # what may be part of a number
LONGEST_NUMBER = 400  # characters: a double written out in full
CODECS: dict[str, Callable[[], Codec]] = {
    "zlib": lambda: Deflate(zlib.MAX_WBITS),
    "gzip": lambda: Deflate(zlib.MAX_WBITS | 16),
    "bz2": bz2.BZ2Decompressor,
}


def raw_planes(
    file: InputFile, offset: int, shape: tuple[int, ...], dtype: np.dtype[Any]
) -> PlaneFile:
    """Return an array that the rest of a file is.

    Raises
    ------
    FileError
        If the file ends too early, or goes on.
    """
    header, follow = ArrayHeader(shape, dtype, False, offset), file.size - offset
    if header.size != follow:
        state = "is truncated" if header.size > follow else "holds more than its header promises"
        raise FileError(f"{file.name} {state}: {header} are promised, but {follow:,} follow")
    return PlaneFile(file, offset, shape, dtype)


class Positional(Protocol):
    """What can be read at any offset, such as an ``InputFile``."""

    size: int

    def read(self, offset: int, count: int) -> NDArray[np.uint8]:
        """Return ``count`` bytes from ``offset`` on, or fewer at the end."""
        ...


def bytes_from(file: Positional, offset: int, end: int | None = None) -> Read:
    """Return a function that reads a file from an offset on, up to its end or another one."""
    stop = file.size if end is None else min(end, file.size)

    def read(count: int) -> bytes:
        nonlocal offset
        data = file.read(offset, min(count, stop - offset)).tobytes()
        offset += len(data)
        return data

    return read


def packed_planes(
    packed: Read, codec: str, shape: tuple[int, ...], dtype: np.dtype[Any], name: str
) -> Callable[[int, int], NDArray[Any]]:
    """Return a function that returns the next planes of a compressed array.

    Parameters
    ----------
    packed : callable
        Returns the next compressed bytes.
    codec : {"zlib", "gzip", "bz2"}
        How they are compressed.
    shape, dtype, name
        Of the array.
    """
    header = ArrayHeader(shape, dtype, False, 0)
    return next_planes(Unpacker(packed, CODECS[codec](), header.size, name).read, header)


def next_planes(read: Read, header: ArrayHeader) -> Callable[[int, int], NDArray[Any]]:
    """Return a function that returns the next planes of an array whose bytes ``read`` returns."""
    rows = header.shape[1:]

    def planes(first: int, last: int) -> NDArray[Any]:
        size = (last - first) * prod(rows) * header.dtype.itemsize
        return np.frombuffer(read(size), header.dtype).reshape(last - first, *rows)

    return planes


class TextValues:
    """Values written as text, parsed in order, in pieces.

    Parameters
    ----------
    file : InputFile
        The file.
    offset, end : int
        Where the text begins and ends.
    dtype, shape
        Of the array.
    """

    def __init__(
        self,
        file: InputFile,
        offset: int,
        end: int,
        dtype: np.dtype[Any],
        shape: tuple[int, ...],
    ) -> None:
        self.name, self.shape, self.left = file.name, shape, prod(shape)
        self.text = bytes_from(file, offset, end)
        if 2 * self.left - 1 > end - offset:
            raise FileError(
                f"{self.name} is truncated: its header promises {self.left:,} values, but "
                f"{end - offset:,} bytes of text follow"
            )
        self.rest, self.parsed = b"", np.empty(0, dtype)

    def planes(self, first: int, last: int) -> NDArray[Any]:
        """Return the next planes."""
        count = (last - first) * prod(self.shape[1:])
        while len(self.parsed) < count:
            self._parse_more()
        taken, self.parsed = self.parsed[:count], self.parsed[count:]
        self.left -= count
        if not self.left and (len(self.parsed) or (self.rest + self.text(TEXT_PIECE)).strip()):
            raise FileError(f"{self.name} holds more values than its header promises")
        return taken.reshape(last - first, *self.shape[1:])

    def _parse_more(self) -> None:
        """Parse the next piece of text, up to its last white space."""
        piece = self.text(TEXT_PIECE)
        text = self.rest + piece
        if not text:
            missing = self.left - len(self.parsed)
            raise FileError(f"{self.name} is truncated: {missing:,} values are missing")
        end = len(text.rstrip(NOT_SPACE)) if piece else len(text)
        self.rest = text[end:]
        if len(self.rest) > LONGEST_NUMBER:
            raise FileError(f"{self.name} is damaged: a value of {len(self.rest):,} characters")
        try:
            values = np.array(text[:end].split(), self.parsed.dtype)
        except (ValueError, OverflowError) as error:
            raise FileError(f"{self.name} is damaged: {str(error)[:100]}") from None
        self.parsed = np.concatenate([self.parsed, values])
