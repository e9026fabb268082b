"""The ``.sdf`` files of SDFGen and its descendants, in three dialects.

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
from ..volume import Request, Volume, in_words_of, of_array

HEADER = struct.Struct("<3i6f")
TAGGED = re.compile(rb"#sdf 1\r?\ndim +(\d{1,9}) +(\d{1,9}) +(\d{1,9})\s*\ndata\r?\n")
TEXT = re.compile(rb"[\s\d.+\-a-zA-Z]+")
FLOAT = np.dtype("<f4")


def read_sdf(request: Request) -> Volume:
    """Read an ``.sdf`` file of any of the three dialects."""
    path = request.path
    with path.open("rb") as file:
        beginning = file.read(4096)
    place: dict[str, Any] = {}
    if tagged := TAGGED.match(beginning):
        start, shape = tagged.end(), tuple(map(int, tagged.groups()))
    elif TEXT.fullmatch(beginning):
        words = path.read_bytes().split()
        try:
            shape = tuple(max(int(word), 0) for word in words[:3])
            x, y, z, spacing = (float(word) for word in words[3:7])
            values = np.array(words[7:], np.float32).reshape(shape[::-1]).T
        except (ValueError, OverflowError):
            raise FileError(
                f"{path} is no .sdf grid, or truncated: SDFGen's text begins with three sizes, the "
                "origin and the spacing, and a value for each sample follows"
            ) from None
        return Volume(*of_array(values), (spacing,) * 3, (x, y, z))
    else:
        fields = HEADER.unpack(beginning[: HEADER.size].ljust(HEADER.size, b"\0"))
        start, shape, low, high = HEADER.size, fields[:3], np.array(fields[3:6]), fields[6:]
        if min(shape) < 1 or not (high > low).all():
            said = "it is neither SDFGen's text nor a binary grid"
            raise FileError(f"{path} is no .sdf grid: {said} (#sdf 1, or sizes, box and values)")
        steps = (high - low) / shape
        place = {"spacing": tuple(steps.tolist()), "origin": tuple(low.tolist())}
    follow, promised = path.stat().st_size - start, in_words_of(shape, FLOAT)
    if prod(shape) * FLOAT.itemsize != follow:
        raise FileError(f"{path} is damaged: {promised} are promised, but {follow:,} follow")
    values = np.memmap(path, FLOAT, "r", start, shape)
    return Volume(*of_array(values), **place, is_mapped=True)
