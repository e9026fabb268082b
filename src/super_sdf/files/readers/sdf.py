"""Files ``.sdf``: the text of SDFGen, and two binary dialects of its descendants.

- Text: ``ni nj nk``, the origin, the spacing, then the values, i fastest.
- ``#sdf 1``: two lines of text and float32 values, k fastest; no spacing, no origin.
- 36 bytes of header (three int32 sizes, the least and the largest corner of the cells as float32),
  then float32 values, k fastest; sample (0, 0, 0) is at the least corner.
"""

from __future__ import annotations

import re
import struct
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError
from ...grid.planes import InputFile, PlaneFile
from ..volume import XYZ, ZYX, Request, Volume

HEADER = struct.Struct("<3i6f")
BEGINNING = 4096  # bytes that show the dialect
PIECE = 1 << 22  # bytes of text at a time
NOT_SPACE = bytes(set(range(33, 127)))  # what may be part of a number
FLOAT = np.dtype("<f4")
TAGGED = re.compile(rb"#sdf 1\r?\ndim +(\d{1,9}) +(\d{1,9}) +(\d{1,9})\s*\ndata\r?\n")
TEXT = re.compile(rb"[\s\d.+\-a-zA-Z]+")


def read_sdf(request: Request) -> Volume:
    """Read a file of any of the three dialects.

    Raises
    ------
    FileError
        If it is none of them, or truncated.
    """
    file = InputFile.open(request.path)
    beginning = file.read(0, BEGINNING).tobytes()
    tagged = TAGGED.match(beginning)
    if tagged:
        shape = tuple(map(int, tagged.groups()))
        return _raw(file, tagged.end(), shape)
    if TEXT.fullmatch(beginning):
        return _read_text(file, beginning)
    return _read_boxed(file, beginning)


def _raw(file: InputFile, offset: int, shape: tuple[int, ...], **place: Any) -> Volume:
    """Return the float32 values after a header."""
    need, follow = prod(shape) * FLOAT.itemsize, file.size - offset
    if need != follow:
        sizes = f"its header promises {' x '.join(map(str, shape))} float32, {need:,} bytes"
        state = "truncated" if need > follow else "no .sdf grid"
        raise FileError(f"{file.name} is {state}: {sizes}, but {follow:,} follow")
    planes = PlaneFile(file, offset, shape, FLOAT)
    return Volume(shape, FLOAT, planes.read, direction=XYZ, stored=planes, **place)


def _read_boxed(file: InputFile, beginning: bytes) -> Volume:
    """Read the dialect whose header has sizes and a box."""
    fields = HEADER.unpack(beginning[: HEADER.size]) if len(beginning) >= HEADER.size else (0,) * 9
    shape, low, high = fields[:3], np.array(fields[3:6]), np.array(fields[6:])
    if min(shape) < 1 or not (high > low).all() or HEADER.size + 4 * prod(shape) != file.size:
        raise FileError(
            f"{file.name} is no .sdf grid: it is neither SDFGen's text nor a binary grid "
            "(#sdf 1, or sizes and box before the values)"
        )
    x, y, z = (high - low) / shape
    return _raw(file, HEADER.size, shape, spacing=(x, y, z), origin=tuple(low))


def _read_text(file: InputFile, beginning: bytes) -> Volume:
    """Read SDFGen's own dialect."""
    head = re.match(rb"\s*" + rb"(\S+)\s+" * 7, beginning)
    try:
        words = head.groups() if head else ()
        nx, ny, nz = (int(word) for word in words[:3])
        x, y, z, spacing = (float(word) for word in words[3:])
    except ValueError:
        head = None
    if head is None or min(nx, ny, nz) < 1 or 2 * nx * ny * nz - 1 > file.size - head.end():
        raise FileError(
            f"{file.name} is no .sdf grid, or truncated: SDFGen's text begins with three sizes, "
            "the origin and the spacing, and a value for each sample follows"
        )
    values = _Values(file, head.end(), nx * ny * nz)

    def read(first: int, last: int) -> NDArray[np.float32]:
        return values.take((last - first) * nx * ny).reshape(last - first, ny, nx)

    return Volume((nz, ny, nx), np.dtype(np.float32), read, (spacing,) * 3, (x, y, z), ZYX)


class _Values:
    """The values of a text file, parsed in order, in pieces."""

    def __init__(self, file: InputFile, offset: int, count: int) -> None:
        self.file, self.offset, self.left = file, offset, count
        self.rest, self.parsed = b"", np.empty(0, np.float32)

    def take(self, count: int) -> NDArray[np.float32]:
        """Return the next ``count`` values."""
        while len(self.parsed) < count:
            self._parse_more()
        taken, self.parsed = self.parsed[:count], self.parsed[count:]
        self.left -= count
        if not self.left:
            self._check_end()
        return taken

    def _parse_more(self) -> None:
        """Parse the next piece of the file, up to its last white space."""
        if self.offset >= self.file.size:
            missing = self.left - len(self.parsed)
            raise FileError(f"{self.file.name} is truncated: {missing:,} values are missing")
        piece = self.file.read(self.offset, PIECE).tobytes()
        self.offset += len(piece)
        text = self.rest + piece
        end = len(text) if self.offset >= self.file.size else len(text.rstrip(NOT_SPACE))
        self.rest = text[end:]
        try:
            values = np.array(text[:end].split(), np.float32)
        except ValueError as error:
            raise FileError(f"{self.file.name} is damaged: {error}") from None
        self.parsed = np.concatenate([self.parsed, values])

    def _check_end(self) -> None:
        """Raise FileError if anything but white space follows the last value."""
        rest = self.rest + self.file.read(self.offset, BEGINNING).tobytes()
        if len(self.parsed) or rest.strip():
            raise FileError(f"{self.file.name} holds more values than its header promises")
