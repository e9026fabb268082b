"""SDFGen's ``.sdf`` files, and MRC and CCP4 maps: raw values behind a short header.

``.sdf`` has three dialects: the text of SDFGen, and two binary ones of its descendants.

- Text: ``ni nj nk``, the origin, the spacing, then the values, i fastest.
- ``#sdf 1``: two lines of text and float32 values, k fastest; no spacing, no origin.
- 36 bytes of header (three int32 sizes, the least and the largest corner of the cells as float32),
  then float32 values, k fastest; sample (0, 0, 0) is at the least corner.

mrcfile parses the header of MRC. Columns, rows and sections run along the world's axes in the order
of ``mapc``, ``mapr`` and ``maps``. Lengths are in angstrom.
"""

from __future__ import annotations

import re
import struct
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arrays import Triple
from ...errors import FileError, GridError
from ...grid.planes import InputFile
from ..streams import CODECS, TextValues, Unpacker, bytes_from, next_planes, raw_planes
from ..volume import XYZ, ZYX, Request, Volume, triple

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
    planes = raw_planes(file, offset, shape, FLOAT)
    return Volume(shape, FLOAT, planes.read, direction=XYZ, stored=planes, **place)


def _read_boxed(file: InputFile, beginning: bytes) -> Volume:
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


# MRC

MAIN_HEADER = 1024  # bytes
VOLUME_STACKS = 401  # space groups from here on are of stacks of volumes
RIGHT = 0.01  # degrees


def read_mrc(request: Request) -> Volume:
    """Read a ``.mrc``, ``.map`` or ``.ccp4`` file, or one that is packed with gzip."""
    import mrcfile
    from mrcfile.utils import data_dtype_from_header

    with mrcfile.open(request.path, permissive=True, header_only=True) as opened:
        header = opened.header
    sizes = tuple(int(header[f"n{axis}"]) for axis in "zyx")
    if min(sizes) < 1:
        raise FileError(f"its sizes are {sizes[::-1]}")
    if header.ispg >= VOLUME_STACKS and header.mz != header.nz:
        raise GridError(f"it is a stack of volumes of {header.mz} sections: save one of them")
    place, notes = _place(header)
    start = MAIN_HEADER + max(int(header.nsymbt), 0)
    dtype, file = data_dtype_from_header(header), InputFile.open(request.path)
    if request.path.suffix.lower() != ".gz":
        stored = raw_planes(file, start, sizes, dtype)
        return Volume(sizes, dtype, stored.read, *place, notes=notes)
    size = start + prod(sizes) * dtype.itemsize
    unpacked = Unpacker(bytes_from(file, 0), CODECS["gzip"](), size, file.name).read
    unpacked(start)
    read = next_planes(unpacked, sizes, dtype)
    return Volume(sizes, dtype, read, *place, packed=file.size, notes=notes)


Place = tuple[Triple | None, Triple, NDArray[np.float64]]


def _place(header: Any) -> tuple[Place, tuple[str, ...]]:
    """Return spacing, origin and direction of the sections, rows and columns, and a note.

    The origin is the field of this name, in angstrom; if it is 0 the place of the first sample in
    the unit cell, in samples.
    """
    order = [int(header[name]) - 1 for name in ("maps", "mapr", "mapc")]
    order = [2, 1, 0] if order == [-1] * 3 else order
    if sorted(order) != [0, 1, 2]:
        raise FileError(f"its axes mapc, mapr, maps are {[axis + 1 for axis in order[::-1]]}")
    angles = _numbers(header.cellb, ("alpha", "beta", "gamma"))
    if angles.any() and np.abs(angles - 90).max() > RIGHT:
        raise GridError(
            f"the angles of its unit cell are {_listed(angles)} degrees, not "
            "90: resample it on a grid with right angles"
        )
    counts = np.array([int(header[name]) for name in ("mx", "my", "mz")])
    cell = _numbers(header.cella, "xyz")
    steps = cell / np.maximum(counts, 1)
    is_stated = bool((cell > 0).all() and (counts > 0).all())
    starts = np.zeros(3)
    starts[order] = [int(header[f"n{axis}start"]) for axis in "zyx"]
    stated, in_cell = _numbers(header.origin, "xyz"), starts * steps
    notes: tuple[str, ...] = ()
    if stated.any() and in_cell.any() and not np.allclose(stated, in_cell, atol=steps.max() / 100):
        notes = (
            f"its origin is {_listed(stated)} and its nstart means {_listed(in_cell)}: the origin "
            "is taken",
        )
    spacing = triple(steps[order]) if is_stated else None
    return (spacing, triple(stated if stated.any() else in_cell), XYZ[:, order]), notes


def _numbers(fields: Any, names: Any) -> NDArray[np.float64]:
    numbers = np.array([fields[name] for name in names], np.float64)
    if not np.isfinite(numbers).all():
        raise FileError(f"its header is damaged: {', '.join(names)} are {numbers.tolist()}")
    return numbers


def _listed(numbers: NDArray[np.float64]) -> str:
    return ", ".join(f"{number:g}" for number in numbers)
