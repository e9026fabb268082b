"""The values of an array behind a header: raw, as text, or compressed; planes in order."""

from __future__ import annotations

import bz2
import zlib
from collections.abc import Callable
from math import prod
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError
from ..grid.planes import InputFile, PlaneFile
from .volume import Planes, in_words_of

PIECE = 1 << 16  # compressed bytes at a time
TEXT_PIECE = 1 << 20  # bytes of text at a time
NOT_SPACE = bytes(set(range(33, 127)))  # what may be part of a number
LONGEST_NUMBER = 400  # characters: a double written out in full

Read: TypeAlias = Callable[[int], bytes]
"""Returns the next ``count`` bytes, or fewer at the end."""


def bytes_from(file: Any, offset: int, end: int | None = None) -> Read:
    """Return a function that reads on in an InputFile, or its like, up to its end or another."""
    stop = file.size if end is None else min(end, file.size)

    def read(count: int) -> bytes:
        nonlocal offset
        data: bytes = file.read(offset, min(count, stop - offset)).tobytes()
        offset += len(data)
        return data

    return read


def raw_planes(
    file: InputFile, offset: int, shape: tuple[int, ...], dtype: np.dtype[Any]
) -> PlaneFile:
    """Return an array that the rest of a file is; FileError if that is shorter or longer."""
    size, follow = prod(shape) * dtype.itemsize, file.size - offset
    if size != follow:
        state = "is truncated" if size > follow else "holds more than its header promises"
        raise FileError(
            f"{file.name} {state}: {in_words_of(shape, dtype)} are promised, but {follow:,} follow"
        )
    return PlaneFile(file, offset, shape, dtype)


def next_planes(read: Read, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Planes:
    """Return a function that returns the next planes of an array whose bytes ``read`` returns."""
    rows = shape[1:]

    def planes(first: int, last: int) -> NDArray[Any]:
        data = read((last - first) * prod(rows) * dtype.itemsize)
        return np.frombuffer(data, dtype).reshape(last - first, *rows)

    return planes


def planes_behind(
    file: InputFile, offset: int, codec: str | None, shape: tuple[int, ...], dtype: np.dtype[Any]
) -> tuple[Planes, int | None]:
    """Return a function that reads planes of what follows in a file, and its size if packed."""
    if codec is None:
        return raw_planes(file, offset, shape, dtype).read, None
    size, packed = prod(shape) * dtype.itemsize, bytes_from(file, offset)
    unpacked = Unpacker(packed, CODECS[codec](), size, file.name)
    return next_planes(unpacked.read, shape, dtype), file.size - offset


class Deflate:
    """zlib or gzip, by its window (see ``zlib``), with the interface of bz2 and lzma."""

    def __init__(self, window: int = zlib.MAX_WBITS) -> None:
        self._inner = zlib.decompressobj(window)

    def __getattr__(self, name: str) -> Any:  # eof and unused_data
        return getattr(self._inner, name)

    @property
    def needs_input(self) -> bool:
        """Whether it needs more compressed bytes before it can return anything."""
        return not self._inner.unconsumed_tail

    def decompress(self, data: bytes, max_length: int) -> bytes:
        """Decompress data into at most ``max_length`` bytes."""
        return self._inner.decompress(self._inner.unconsumed_tail + data, max_length)


CODECS: dict[str, Callable[[], Any]] = {
    "zlib": Deflate,
    "gzip": lambda: Deflate(zlib.MAX_WBITS | 16),
    "bz2": bz2.BZ2Decompressor,
}


class Unpacker:
    """The ``size`` bytes of compressed data, decompressed in small pieces and checked to their end.

    ``packed`` returns the next compressed bytes, ``codec`` decompresses them.
    """

    def __init__(self, packed: Read, codec: Any, size: int, name: str) -> None:
        self._packed, self._codec, self.left, self.name = packed, codec, size, name

    def read(self, count: int) -> bytes:
        """Return the next bytes, or fewer at the end; FileError if they are damaged."""
        count = min(count, self.left)
        pieces = []
        while count:
            piece = self._unpack(count)
            if not piece:
                raise self._damaged(f"{self.left:,} bytes are missing")
            pieces.append(piece)
            count -= len(piece)
            self.left -= len(piece)
        if pieces and not self.left:
            if self._unpack(PIECE) or self._codec.unused_data or self._packed(1):
                raise self._damaged("it holds more than its header promises")
            if not self._codec.eof:
                raise self._damaged("its end, with the checksum, is missing")
        return b"".join(pieces)

    def _unpack(self, most: int) -> bytes:
        while not self._codec.eof:
            data, is_fed = b"", self._codec.needs_input
            try:
                if is_fed:
                    data = self._packed(min(PIECE, most))
                piece: bytes = self._codec.decompress(data, most)
            except FileError:
                raise
            except Exception as error:  # each codec raises its own errors
                raise self._damaged(str(error)) from None
            if piece or (is_fed and not data):
                return piece
        return b""

    def _damaged(self, reason: str) -> FileError:
        return FileError(f"{self.name} is damaged: {reason}")


class TextValues:
    """Values written as text between two offsets of a file, parsed in order, in pieces."""

    def __init__(
        self, file: InputFile, offset: int, end: int, dtype: np.dtype[Any], shape: tuple[int, ...]
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
