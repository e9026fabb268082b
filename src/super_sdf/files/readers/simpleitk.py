"""MetaImage, with SimpleITK: world coordinates are LPS.

ITK opens whatever file a header names, and takes a torn zlib stream for data: names are checked
before, and compressed data is unpacked here.
"""

from __future__ import annotations

import re
import zlib
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import FileError, GridError, seen
from ...options import LPS
from ..regular import LONGEST_HEADER, check_beside
from ..volume import Request, Volume, kept_axes, triple

NO_UNIT = ("", "?", "mm", "UNKNOWN")


def read_metaimage(request: Request) -> Volume:
    """Read a ``.mha`` file, or a ``.mhd`` file and the data files that it names."""
    import SimpleITK

    path = request.path
    with path.open("rb") as file:
        beginning = file.read(LONGEST_HEADER)
    found = re.search(rb"^ElementDataFile *[=:] *([^\n]*)\n?", beginning, re.M)
    if not found:
        raise FileError("its header is damaged: it has no ElementDataFile")
    lines = beginning[: found.start()].decode(errors="replace").splitlines()
    pairs = (re.split("[=:]", line, maxsplit=1) for line in lines)
    fields = {pair[0].strip(): pair[-1].strip() for pair in pairs}

    def is_true(name: str) -> bool:
        return fields.get(name, "F")[:1] in ("T", "t", "1")  # as ITK reads it

    named = found[1].decode(errors="surrogateescape").strip()
    names = [] if named.lower() == "local" else _names(named, beginning[found.end() :])
    files = [check_beside(path, name) for name in names]
    SimpleITK.ProcessObject.GlobalWarningDisplayOff()
    reader = SimpleITK.ImageFileReader()
    reader.SetFileName(str(path))
    reader.SetImageIO("MetaImageIO")
    try:
        reader.ReadImageInformation()
    except RuntimeError:
        raise FileError("its header is damaged, or not that of a MetaImage file") from None
    size, kept = reader.GetSize(), kept_axes(reader.GetSize())
    if len(kept) != 3 or reader.GetNumberOfComponents() != 1:
        more = f" of {reader.GetNumberOfComponents()} numbers"
        raise GridError(f"{path} has shape {size}{more}: give a file of three axes (x, y, z)")
    one = SimpleITK.Image([1] * len(size), reader.GetPixelID())
    dtype = SimpleITK.GetArrayViewFromImage(one).dtype
    data, start = (files[0], 0) if files else (path, found.end())
    promised, follow = prod(size) * dtype.itemsize, data.stat().st_size - start
    is_packed = is_true("CompressedData") and len(files) <= 1
    if not is_packed and len(files) <= 1 and promised > follow:
        raise FileError(f"{data} is truncated: {promised:,} bytes are promised, {follow:,} follow")

    def load() -> Any:
        if not is_packed:
            return SimpleITK.GetArrayFromImage(reader.Execute()).T
        is_big = is_true("BinaryDataByteOrderMSB") or is_true("ElementByteOrderMSB")
        stored = dtype.newbyteorder(">" if is_big else "<")
        return np.frombuffer(_unpacked(data, start, promised), stored).reshape(size[::-1]).T

    steps = np.array(reader.GetSpacing())[list(kept)]
    direction = np.array(reader.GetDirection()).reshape(len(size), -1)[np.ix_(kept, kept)]
    origin = triple(np.array(reader.GetOrigin())[list(kept)])
    place = triple(np.abs(steps)), origin, direction * np.sign(steps)
    unit = fields.get("DistanceUnits", "?")
    notes = (f"lengths are in the unit that it states, {unit}",) * (unit not in NO_UNIT)
    if not {"ElementSpacing", "ElementSize"} & set(fields):
        notes += ("it states no ElementSpacing: taken as 1, as ITK does",)
    return Volume(load, size, dtype, *place, kept, notes=notes, space=LPS)


def _names(named: str, rest: bytes) -> list[str]:
    """Return the names of the data files, of which a list or a pattern has one a slice."""
    if named.upper().startswith("LIST"):
        return [line for line in rest.decode(errors="surrogateescape").split("\n") if line.strip()]
    if "%" not in named:
        return [named]
    pattern, *numbers = named.split()
    if not re.fullmatch("[^%]*%0?[0-9]?d[^%]*", pattern) or len(numbers) < 2:
        raise FileError(f"its ElementDataFile is {seen(named)}: give NAME%03d.raw 1 20 1")
    first, last, step = (int(number) for number in (*numbers, "1")[:3])
    return [pattern % number for number in range(first, last + 1, step)]


def _unpacked(path: Path, start: int, size: int) -> bytes:
    """Return the ``size`` bytes of a zlib stream; FileError unless it is whole and has as many."""
    unpacker = zlib.decompressobj()
    data = unpacker.decompress(path.read_bytes()[start:], size + 1)
    if len(data) != size or not unpacker.eof:
        raise FileError(
            f"{path} is damaged: {size:,} bytes are promised, and its compressed data is torn or "
            f"has others ({len(data):,})"
        )
    return data
