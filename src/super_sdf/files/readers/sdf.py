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

from ...errors import FileError
from ...grid.planes import InputFile
from ..streams import TextValues, raw_planes
from ..volume import XYZ, ZYX, Request, Volume

HEADER = struct.Struct("<3i6f")
BEGINNING = 4096  # bytes that show the dialect
FLOAT = np.dtype("<f4")
TAGGED = re.compile(rb"#sdf 1\r?\ndim +(\d{1,9}) +(\d{1,9}) +(\d{1,9})\s*\ndata\r?\n")
TEXT = re.compile(rb"[\s\d.+\-a-zA-Z]+")


def read_sdf(request: Request) -> Volume:
    """Read a file of any of the three dialects."""
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
    planes = raw_planes(file, offset, shape, FLOAT)
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
    shape, dtype = (nz, ny, nx), np.dtype(np.float32)
    read = TextValues(file, head.end(), file.size, dtype, shape).planes
    return Volume(shape, dtype, read, (spacing,) * 3, (x, y, z), ZYX)
