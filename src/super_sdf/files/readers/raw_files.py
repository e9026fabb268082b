"""Raw values behind a header: MetaImage, SDFGen's ``.sdf`` files, and MRC and CCP4 maps.

MetaImage has arrays (z, y, x) in C order; its world coordinates are LPS. It is read here and not
with ITK, which takes a damaged zlib stream for data, opens whatever a header names, and checks no
size in it: what is left to do is a header of text before raw or zlib data.

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
from itertools import zip_longest
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arrays import Triple
from ...errors import FileError, GridError, seen
from ...grid.planes import InputFile
from ...options import LPS
from ..regular import check_beside
from ..streams import (CODECS, TextValues, Unpacker, bytes_from, next_planes, planes_behind, raw_planes)
from ..volume import XYZ, ZYX, Planes, Request, Volume, kept_axes, reversed_axes, triple

LONGEST = 1 << 20  # bytes of a header, with a list of files
LAST = "ElementDataFile"  # the field after which the data begins
TYPES = {
    f"MET_{sign}{name}": f"{kind}{size}"
    for name, size in {"CHAR": 1, "SHORT": 2, "INT": 4, "LONG": 4, "LONG_LONG": 8}.items()
    for sign, kind in (("", "i"), ("U", "u"))
} | {"MET_FLOAT": "f4", "MET_DOUBLE": "f8"}
LINE = re.compile(rb"([^=:\n]*)([=:]?)([^\n]*)\n?")  # matches anything
PATTERN = re.compile(r"([^%]*)%(0?[0-9]?)d([^%]*)")
# Names of one and the same field; of several, ITK takes the first here.
SPACING = "ElementSpacing", "ElementSize"
ORIGIN = "Origin", "Offset", "Position"
DIRECTION = "TransformMatrix", "Rotation", "Orientation"
IS_BIG = "BinaryDataByteOrderMSB", "ElementByteOrderMSB"

KNOWN = (*SPACING, *ORIGIN, *DIRECTION, *IS_BIG, "DimSize", "CompressedData", "BinaryData")
MERGED = re.compile(rf"({'|'.join(KNOWN)}) *=")  # a line whose end is damaged
NO_UNIT = ("", "?", "mm", "UNKNOWN")


def read_metaimage(request: Request) -> Volume:
    """Read a ``.mha`` file, or a ``.mhd`` file and the data files that it names."""
    file = InputFile.open(request.path)
    header = _Header(file.read(0, LONGEST).tobytes())
    size = header.whole("DimSize", ())
    channels = header.whole("ElementNumberOfChannels", (1,))
    space = kept_axes(size)
    if len(space) != 3 or channels != (1,):
        more = f" of {channels[0]} numbers" * (channels != (1,))
        raise GridError(
            f"{request.path} has shape {size}{more}: give a file of three axes (x, y, z)"
        )
    if min(size) < 1 or max(size) > np.iinfo(np.int64).max:
        raise FileError(f"its DimSize is {header.fields['DimSize']}")
    count = len(size)
    spacing = np.array(header.numbers(SPACING, np.ones(count)))[space]
    matrix = np.array(header.numbers(DIRECTION, np.eye(count).ravel())).reshape(count, count)
    direction = matrix.T[np.ix_(space, space)] * np.where(spacing < 0, -1, 1)  # as ITK takes it
    origin = triple(np.array(header.numbers(ORIGIN, np.zeros(count)))[space])
    steps, direction = reversed_axes(np.abs(spacing), direction)
    size = tuple(size[axis] for axis in space)
    read, packed = _data(request, file, header, size[::-1])
    place = steps, origin, direction
    return Volume(
        *(size[::-1], header.dtype, read, *place), packed=packed, notes=header.notes(), space=LPS
    )


class _Header:
    """The fields of a header up to that of the data; ``rest`` follows, from ``length`` on."""

    def __init__(self, text: bytes) -> None:
        self.fields: dict[str, str] = {}
        for line in LINE.finditer(text):
            name, sign, value = line.groups()
            key = name.decode("latin1").strip()
            said = value.decode(errors="surrogateescape").strip()
            if not sign and key:
                raise FileError(f"its header is damaged: the line {seen(key)} is no NAME = VALUE")
            if self.fields.get(key, said) != said and key != "Comment":
                raise FileError(f"its header is damaged: it states {key} twice")
            self.fields[key] = said
            near = next((name for name in KNOWN if _are_one_letter_apart(key, name)), None)
            if near or (key != "Comment" and MERGED.search(said)):
                raise FileError(
                    f"its header is damaged: the line {seen(line[0].decode('latin1').strip())} is "
                    f"no {near or 'single field'}"
                )
            if key == LAST:
                self.rest, self.length = text[line.end() :], line.end()
                return
        raise FileError(f"its header is damaged: it has no {LAST} in {len(text):,} bytes")

    def whole(self, name: str, default: tuple[int, ...]) -> tuple[int, ...]:
        if name not in self.fields:
            return default
        words = self.fields[name].split()
        if not all(re.fullmatch("-?[0-9]{1,18}", word) for word in words):
            raise FileError(f"its {name} is {seen(self.fields[name])}: give whole numbers")
        return tuple(map(int, words))

    def numbers(self, names: tuple[str, ...], default: NDArray[Any]) -> list[float]:
        """Return the numbers of the first of some fields that there is."""
        name = next((name for name in names if name in self.fields), None)
        if name is None:
            return default.tolist()
        try:
            numbers = [float(word) for word in self.fields[name].split()]
        except ValueError:
            numbers = []
        if len(numbers) != len(default) or not np.isfinite(numbers).all():
            raise FileError(f"its {name} is {seen(self.fields[name])}: give {len(default)} numbers")
        return numbers

    def notes(self) -> tuple[str, ...]:
        unit = self.fields.get("DistanceUnits", "?").strip()
        notes = (f"lengths are in the unit that it states, {unit}",) * (unit not in NO_UNIT)
        if not any(name in self.fields for name in SPACING):
            notes += ("it states no ElementSpacing: taken as 1, as ITK does",)
        return notes

    def flag(self, name: str, default: bool = False) -> bool:
        return self.fields.get(name, str(default))[:1] in ("T", "t", "1")  # as ITK reads it

    @property
    def dtype(self) -> np.dtype[Any]:
        kind = self.fields.get("ElementType", "")
        if kind not in TYPES:
            raise FileError(f"its ElementType is {seen(kind)}: give one of {', '.join(TYPES)}")
        is_big = self.flag(next((name for name in IS_BIG if name in self.fields), ""))
        return np.dtype(">" + TYPES[kind] if is_big else "<" + TYPES[kind])

    def files(self, count: int) -> list[str]:
        """Return the names of the data files, of which a list or a pattern has one a slice."""
        first, *words = self.fields[LAST].split() or [""]
        if first.startswith("LIST"):
            if words not in ([], ["2"]):
                raise FileError(f"its {LAST} is {seen(self.fields[LAST])}: give one file a slice")
            names = self.rest.decode(errors="surrogateescape").split("\n", count)[:count]
            return [name.strip() for name in names]
        if "%" not in first:
            return [self.fields[LAST]]
        pattern, numbers = PATTERN.fullmatch(first), words or ["1"]
        if not pattern or not all(re.fullmatch("-?[0-9]{1,9}", number) for number in numbers):
            raise FileError(
                f"its {LAST} is {seen(self.fields[LAST])}: give NAME%03d.raw 1 {count} 1"
            )
        low, step = int(numbers[0]), int(numbers[2]) if len(numbers) > 2 else 1
        before, width, after = pattern.groups()
        return [f"{before}{format(low + i * step, width + 'd')}{after}" for i in range(count)]


def _are_one_letter_apart(a: str, b: str) -> bool:
    return abs(len(a) - len(b)) <= 1 and sum(x != y for x, y in zip_longest(a, b)) == 1


def _data(
    request: Request, file: InputFile, header: _Header, shape: tuple[int, ...]
) -> tuple[Planes, int | None]:
    if not header.flag("BinaryData", True):
        raise FileError("its BinaryData is False: save it as binary")
    if header.fields[LAST].lower() == "local":
        files, start = [file], header.length
    else:
        names = header.files(min(shape[0], LONGEST))
        files = [InputFile.open(check_beside(request.path, name)) for name in names]
        start = 0
    skip = header.whole("HeaderSize", (0,))[0]
    start = skip if skip > 0 else start
    if header.flag("CompressedData"):
        return _compressed(files, header, start, shape)
    part = (shape[0] // len(files), *shape[1:])
    if len(files) * part[0] != shape[0]:
        raise FileError(f"it names {len(files)} data files for {shape[0]:,} slices")
    if skip == -1:
        start = max(files[0].size - prod(part) * header.dtype.itemsize, 0)
    parts = [raw_planes(each, start, part, header.dtype) for each in files]

    def read(first: int, last: int) -> NDArray[Any]:
        if len(parts) == 1:
            return parts[0].read(first, last)
        return np.concatenate([parts[number].read(0, 1) for number in range(first, last)])

    return read, None


def _compressed(
    files: list[InputFile], header: _Header, start: int, shape: tuple[int, ...]
) -> tuple[Planes, int | None]:
    file = files[0]
    if len(files) > 1 or header.fields.get("HeaderSize", "0").startswith("-"):
        raise FileError("it is compressed, in several files or behind others: store it as .mha")
    follow = file.size - start
    size = header.whole("CompressedDataSize", (follow,))[0]
    if size != follow:
        raise FileError(
            f"{file.name} is damaged: its CompressedDataSize is {size:,}, but {follow:,} bytes "
            "follow"
        )
    return planes_behind(file, start, "zlib", shape, header.dtype)


# SDFGen

HEADER = struct.Struct("<3i6f")
BEGINNING = 4096  # bytes that show the dialect
FLOAT = np.dtype("<f4")
TAGGED = re.compile(rb"#sdf 1\r?\ndim +(\d{1,9}) +(\d{1,9}) +(\d{1,9})\s*\ndata\r?\n")
TEXT = re.compile(rb"[\s\d.+\-a-zA-Z]+")


def read_sdf(request: Request) -> Volume:
    """Read an ``.sdf`` file of any of the three dialects."""
    file = InputFile.open(request.path)
    beginning = file.read(0, BEGINNING).tobytes()
    if tagged := TAGGED.match(beginning):
        return _raw(file, tagged.end(), tuple(map(int, tagged.groups())))
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
