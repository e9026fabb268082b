"""NRRD files: pynrrd parses the header, which names the world's axes; the data is read here.

Coordinates are those of the file's own space (LPS, RAS, ...), as its header gives them. pynrrd
would load the whole array, whatever its size, from wherever the header says.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError, seen
from ...grid.planes import InputFile
from ..headers import ArrayHeader
from ..regular import check_beside
from ..volume import XYZ, Request, Volume, from_affine, reversed_axes
from .values import TextValues, bytes_from, packed_planes, raw_planes

LONGEST = 1 << 20  # bytes of a header
TEXT = ("ascii", "text", "txt")
CODECS = {"gzip": "gzip", "gz": "gzip", "bzip2": "bz2", "bz2": "bz2"}


def read_nrrd(request: Request) -> Volume:
    """Read a ``.nrrd`` file, or a ``.nhdr`` file and the data file that it names."""
    import nrrd

    file = InputFile.open(request.path)
    beginning = io.BytesIO(file.read(0, LONGEST).tobytes())
    header = {_plain(name): value for name, value in nrrd.read_header(beginning).items()}
    sizes = tuple(int(size) for size in header["sizes"])
    if len(sizes) != 3 or header["dimension"] != 3:
        raise GridError(f"{request.path} has shape {sizes}: give a file of three axes (x, y, z)")
    if min(sizes) < 1:
        raise FileError(f"its sizes are {sizes}")
    start = beginning.tell()
    if "datafile" in header:
        file, start = InputFile.open(check_beside(request.path, header["datafile"])), 0
    elif start >= LONGEST:
        raise FileError(f"its header has more than {LONGEST:,} bytes")
    array = ArrayHeader(sizes[::-1], _dtype(nrrd, header), False, 0)
    read, packed = _data(file, header, start, array)
    place = _place(header)
    return Volume(array.shape, array.dtype, read, *place, packed=packed)


def _plain(name: str) -> str:
    """Return the name of a field without the spaces in those that may be written either way."""
    return name.replace(" ", "") if name in ("data file", "line skip", "byte skip") else name


def _dtype(nrrd: Any, header: dict[str, Any]) -> np.dtype[Any]:
    """Return the type that pynrrd makes of the header: it reads one sample that is 0."""
    said: dict[str, Any] = {key: header[key] for key in ("type", "endian") if key in header}
    if header["encoding"].lower() in TEXT:
        said["endian"] = "little"  # which text need not state
    one = {**said, "encoding": "raw", "dimension": 1, "sizes": np.array([1])}
    return np.dtype(nrrd.read_data(one, io.BytesIO(bytes(8))).dtype)


def _data(
    file: InputFile, header: dict[str, Any], start: int, array: ArrayHeader
) -> tuple[Any, int | None]:
    """Return a function that reads planes, and the size of compressed data."""
    encoding, skip = header["encoding"], header.get("byteskip", 0)
    start = _after_lines(file, start, header.get("lineskip", 0))
    if encoding == "raw":
        start = file.size - array.size if skip == -1 else start + skip
        if start < 0:
            raise FileError(f"{file.name} is truncated: {array} are promised, it has {file.size:,}")
        return raw_planes(file, start, array.shape, array.dtype).read, None
    if skip or encoding.lower() not in (*TEXT, *CODECS):
        raise FileError(f"its encoding is {seen(encoding)}, byte skip {skip}: save it as raw")
    if encoding.lower() in TEXT:
        return TextValues(file, start, file.size, array.dtype, array.shape).planes, None
    packed = bytes_from(file, start)
    read = packed_planes(packed, CODECS[encoding], array.shape, array.dtype, file.name)
    return read, file.size - start


def _after_lines(file: InputFile, start: int, lines: int) -> int:
    """Return where the data begins after some lines."""
    text = file.read(start, LONGEST).tobytes() if lines else b""
    place = 0
    for _ in range(lines):
        place = text.find(b"\n", place) + 1
        if not place:
            raise FileError(f"it has no {lines:,} lines to skip (line skip)")
    return start + place


def _place(header: dict[str, Any]) -> tuple[Any, Any, NDArray[np.float64]]:
    """Return spacing, origin and direction of the array in C order; None for what is not stated."""
    directions = header.get("space directions")
    if directions is not None:
        columns = np.asarray(directions, np.float64).T
        if columns.shape != (3, 3) or not np.isfinite(columns).all():
            raise FileError(f"its space directions are {columns.T.tolist()}: give three of three")
        lengths, _, direction = from_affine(np.column_stack([columns, np.zeros(3)]))
        spacing, direction = reversed_axes(lengths, direction)
        return spacing, _numbers(header.get("space origin")), direction
    spacings, least = header.get("spacings"), header.get("axis mins")
    spacing, direction = reversed_axes(XYZ[0] if spacings is None else spacings, XYZ)
    if spacings is None or not np.isfinite(spacings).all():
        return None, None, direction
    if least is None or not np.isfinite(least).all():
        return spacing, None, direction
    cells = [kind == "cell" for kind in header.get("centerings", ("node",) * 3)]
    origin = np.asarray(least, np.float64) + np.where(cells, np.asarray(spacings) / 2, 0)
    return spacing, _numbers(origin), direction


def _numbers(numbers: Any) -> tuple[float, ...] | None:
    return None if numbers is None else tuple(float(number) for number in numbers)
