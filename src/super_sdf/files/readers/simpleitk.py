"""MetaImage, with SimpleITK: world coordinates are LPS.

ITK opens whatever file a header names, and takes a torn zlib stream for data: names are checked
before, and compressed data is unpacked here.
"""

from __future__ import annotations

import re
import zlib
from math import prod
from typing import Any

import numpy as np

from ...errors import FileError, GridError
from ...options import LPS
from ..formats import LONGEST_HEADER, data_files
from . import Index, Request, Volume, triple

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
    is_local = named.lower() == "local"
    files = [] if is_local else data_files(path, named, beginning[found.end() :])
    SimpleITK.ProcessObject.GlobalWarningDisplayOff()
    reader = SimpleITK.ImageFileReader()
    reader.SetFileName(str(path))
    reader.SetImageIO("MetaImageIO")
    try:
        reader.ReadImageInformation()
    except RuntimeError:
        raise FileError("its header is damaged, or not that of a MetaImage file") from None
    size = reader.GetSize()
    if len(size) < 3 or reader.GetNumberOfComponents() != 1:
        more = f" of {reader.GetNumberOfComponents()} numbers"
        raise GridError(f"{path} has shape {size}{more}: give a file of three axes (x, y, z)")
    index = request.pick(size)
    kept = [n for n, at in enumerate(index) if isinstance(at, slice)]
    one = SimpleITK.Image([1] * len(size), reader.GetPixelID())
    dtype = SimpleITK.GetArrayViewFromImage(one).dtype
    data, start = (files[0], 0) if files else (path, found.end())
    promised, follow = prod(size) * dtype.itemsize, data.stat().st_size - start
    is_packed = is_true("CompressedData") and len(files) <= 1
    if not is_packed and len(files) <= 1 and promised > follow:
        raise FileError(f"{data} is truncated: {promised:,} bytes are promised, {follow:,} follow")

    def load(index: Index) -> Any:
        if not is_packed:
            return SimpleITK.GetArrayFromImage(reader.Execute()).T[index]
        is_big = is_true("BinaryDataByteOrderMSB") or is_true("ElementByteOrderMSB")
        stored = dtype.newbyteorder(">" if is_big else "<")
        unpacker = zlib.decompressobj()
        numbers = unpacker.decompress(data.read_bytes()[start:], promised + 1)
        if len(numbers) != promised or not unpacker.eof:
            raise FileError(
                f"{data} is damaged: {promised:,} bytes are promised, and its compressed data is "
                f"torn or has others ({len(numbers):,})"
            )
        return np.frombuffer(numbers, stored).reshape(size[::-1]).T[index]

    steps = np.array(reader.GetSpacing())[kept]
    direction = np.array(reader.GetDirection()).reshape(len(size), -1)[np.ix_(kept, kept)]
    origin = triple(np.array(reader.GetOrigin())[kept])
    place = triple(np.abs(steps)), origin, direction * np.sign(steps)
    unit = fields.get("DistanceUnits", "?")
    notes = (f"lengths are in the unit that it states, {unit}",) * (unit not in NO_UNIT)
    if not {"ElementSpacing", "ElementSize"} & set(fields):
        notes += ("it states no ElementSpacing: taken as 1, as ITK does",)
    return Volume(load, size, dtype, *place, index, notes=notes, space=LPS)
