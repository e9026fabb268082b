"""The header of an ``.npy`` array, parsed here because files of all kinds claim to be one.

NumPy evaluates the header as Python, which fails in about ten ways on damaged headers, and reads as
many bytes of it as the file claims.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import prod
from typing import Any

import numpy as np

from ..errors import FileError

MAGIC = b"\x93NUMPY"
LENGTH_FORMATS = {b"\x01\x00": "<H", b"\x02\x00": "<I", b"\x03\x00": "<I"}  # by version
LONGEST = 10_000  # bytes, NumPy's limit
KEYS = {"descr", "fortran_order", "shape"}
ENTRY = re.compile(
    r"""\s*['"](?P<key>\w+)['"]\s*:\s*
    (?P<value> '[^']*' | "[^"]*" | True | False | \[.*\]
        | \(\s* (?: [0-9]+L?\s* (?:,\s*[0-9]+L?\s*)* ,?\s* )? \) )  # Python 2 wrote 12L
    \s*(?:,|(?=\}))""",
    re.VERBOSE,
)
DTYPE = re.compile(r"[<>|=]?[?biufcmMOSUV][0-9]{0,9}(\[\w+\])?")

Read = Callable[[int], bytes]
"""Returns the next ``count`` bytes, or fewer at the end."""


@dataclass(frozen=True)
class ArrayHeader:
    """Shape, dtype and order of an array, and the length of the header in bytes."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fortran_order: bool
    length: int

    @property
    def size(self) -> int:
        """Size of the array in bytes."""
        return prod(self.shape) * self.dtype.itemsize

    def squeezed(self) -> ArrayHeader:
        """Return the header without axes of length 1 beside three others, of the same bytes."""
        return replace(self, shape=tuple(self.shape[axis] for axis in kept_axes(self.shape)))

    def __str__(self) -> str:
        return f"{' x '.join(map(str, self.shape))} {self.dtype}, {self.size:,} bytes"


def kept_axes(shape: Sequence[int]) -> list[int]:
    """Return the axes of an array without those of length 1 that are beside three others."""
    single = [axis for axis, count in enumerate(shape) if count == 1][: max(len(shape) - 3, 0)]
    return [axis for axis in range(len(shape)) if axis not in single]


def read_array_header(read: Read, name: str) -> ArrayHeader:
    """Read a header of format 1, 2 or 3.

    Raises
    ------
    FileError
        If it is not a header, or describes an array of anything but plain numbers.
    """
    start = read(8)
    length_format = LENGTH_FORMATS.get(start[6:])
    if start[:6] != MAGIC or length_format is None:
        raise _no_header(name)
    size = struct.calcsize(length_format)
    field = read(size)
    length = struct.unpack(length_format, field)[0] if len(field) == size else 0
    if length > LONGEST:
        raise _no_header(name, f"it claims {length:,} bytes")
    header = read(length)
    if not header or len(header) < length:
        raise _no_header(name)
    text = header.decode("latin1").strip()
    return ArrayHeader(*_interpret(text, name), length=8 + size + length)


def _interpret(text: str, name: str) -> tuple[tuple[int, ...], np.dtype[Any], bool]:
    """Parse the text of a header: shape, dtype, and whether in Fortran order."""
    entries = list(ENTRY.finditer(text, 1))
    values = {entry["key"]: entry["value"] for entry in entries}
    rest = text[:1] + ENTRY.sub("", text[1:]).strip()
    if rest != "{}" or set(values) != KEYS or len(entries) != len(KEYS):
        raise _no_header(name, _shortened(text))
    dtype = _read_dtype(values["descr"], name)
    numbers = re.findall("[0-9]+", values["shape"])
    if values["fortran_order"] not in ("True", "False") or not values["shape"].startswith("("):
        raise _no_header(name, _shortened(text))
    if any(len(number) > 18 for number in numbers):
        raise _no_header(name, f"it claims the shape {_shortened(values['shape'])}")
    return tuple(map(int, numbers)), dtype, values["fortran_order"] == "True"


def _read_dtype(text: str, name: str) -> np.dtype[Any]:
    """Parse the dtype of a header."""
    if text.startswith("["):
        raise FileError(f"{name} holds records, {_shortened(text)}: save the distances alone")
    if not DTYPE.fullmatch(text[1:-1]):
        raise _no_header(name, f"it claims the dtype {_shortened(text)}")
    try:
        dtype = np.dtype(text[1:-1])
    except (TypeError, ValueError):
        raise _no_header(name, f"it claims the dtype {_shortened(text)}") from None
    if dtype.hasobject:
        raise FileError(f"{name} holds Python objects: save the numbers alone")
    return dtype


def _no_header(name: str, reason: str = "") -> FileError:
    """Return the error for an invalid header."""
    ending = f": {reason}" if reason else ""
    return FileError(f"{name} is not an .npy array: its header cannot be read{ending}")


def _shortened(text: str) -> str:
    """Return the beginning of a text on one line."""
    shown = text.encode("unicode_escape").decode("ascii")
    return shown if len(shown) <= 60 else f"{shown[:60]}..."
