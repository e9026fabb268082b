"""MetaImage files: arrays (z, y, x) in C order; world coordinates are LPS.

Read here and not with ITK, which takes a damaged zlib stream for data, opens whatever a header
names, and checks no size in it: what is left to do is a header of text before raw or zlib data.
"""

from __future__ import annotations

import re
from itertools import zip_longest
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError, seen
from ...grid.planes import InputFile
from ..regular import check_beside
from ..streams import planes_behind, raw_planes
from ..volume import Planes, Request, Volume, kept_axes, reversed_axes, triple

LONGEST = 1 << 20  # bytes of a header, with a list of files
LAST = "ElementDataFile"  # the field after which the data begins
TYPES = {
    f"MET_{sign}{name}": f"{kind}{size}"
    for name, size in {"CHAR": 1, "SHORT": 2, "INT": 4, "LONG": 4, "LONG_LONG": 8}.items()
    for sign, kind in (("", "i"), ("U", "u"))
} | {"MET_FLOAT": "f4", "MET_DOUBLE": "f8"}
LINE = re.compile(rb"[^\n]*\n?")
FIELD = re.compile(rb"([^=:]*)([=:]?)(.*)", re.S)  # matches anything
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
    header = Header(file.read(0, LONGEST).tobytes())
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
    return Volume(size[::-1], header.dtype, read, *place, packed=packed, notes=header.notes())


class Header:
    """The fields of a header, up to the one that names the data.

    ``rest`` is what follows in the beginning of the file, and ``length`` where that begins.
    """

    def __init__(self, text: bytes) -> None:
        self.fields: dict[str, str] = {}
        for line in LINE.finditer(text):
            name, sign, value = FIELD.fullmatch(line[0]).groups()  # type: ignore[union-attr]
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
        """Return the whole numbers of a field."""
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
        """Return sentences on the unit, and on a spacing that is not stated."""
        unit, notes = self.fields.get("DistanceUnits", "?").strip(), tuple[str, ...]()
        if unit not in NO_UNIT:
            notes = (f"lengths are in the unit that it states, {unit}",)
        if not any(name in self.fields for name in SPACING):
            notes += ("it states no ElementSpacing: taken as 1, as ITK does",)
        return notes

    def flag(self, name: str, default: bool = False) -> bool:
        """Return a field that is true or false, as ITK reads it: by its first letter."""
        return self.fields.get(name, str(default))[:1] in ("T", "t", "1")

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the samples."""
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
    """Return whether one letter differs between two names, or is missing at the end."""
    return abs(len(a) - len(b)) <= 1 and sum(x != y for x, y in zip_longest(a, b)) == 1


def _data(
    request: Request, file: InputFile, header: Header, shape: tuple[int, ...]
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
    files: list[InputFile], header: Header, start: int, shape: tuple[int, ...]
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
