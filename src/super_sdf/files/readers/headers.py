"""NRRD, with pynrrd, and MetaImage, with SimpleITK: headers in text, which may name data files.

Both libraries open whatever file a header names: names are checked before. Coordinates of NRRD are
those of the file's own space (LPS, RAS, ...). SimpleITK turns them all to LPS, takes spacings by
axis mins and maxs for 1, and refuses bzip2, an axis of time, and spacings beside a space; and of
MetaImage, which is LPS, it takes a torn zlib stream for data, so that is unpacked here.
"""

from __future__ import annotations

import re
import zlib
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from ...options import LPS, RAS
from ..formats import check_beside, split_header
from . import LABELS, Index, Names, Request, Volume, from_affine, kept_of, triple
from .axes import in_unit, one_unit

CENTERING = (
    "it states axis mins, but no centerings: its samples are taken as cells, half a spacing from "
    "them, as ITK does"
)
IN_SPACE = ("domain", "space", "???", "none")  # kinds of axes; others are lists, vectors, time
SPACES = {"right-anterior-superior": RAS, "ras": RAS, "left-posterior-superior": LPS, "lps": LPS}
# Fields in one spelling of those that the format allows
SPELT = {"centers": "centerings", "axismins": "axis mins", "axismaxs": "axis maxs"}


def read_nrrd(request: Request) -> Volume:
    """Read a ``.nrrd`` file, or a ``.nhdr`` file and the data files that it names."""
    import nrrd

    path, (text, named, _) = request.path, split_header(request.path)
    raw = nrrd.read_header(text.splitlines(True))
    if {"data file", "datafile"} & set(raw):  # pynrrd would open another one
        raise FileError("its header is damaged: it names its data twice")
    files = [check_beside(path, name) for name in named]
    header = {SPELT.get(name, name): value for name, value in raw.items()}
    sizes = tuple(int(size) for size in header["sizes"])
    if header["dimension"] != len(sizes) or min(sizes) < 1:
        raise FileError(f"its sizes are {sizes}")
    index = request.pick(sizes, _axes_in_space(header))

    def load(index: Index) -> Any:
        if not files:
            return nrrd.read(str(path))[0][index]
        part = {**raw, "sizes": np.array([*sizes[:-1], sizes[-1] // len(files)])}
        parts = [
            nrrd.read_data({**part, "data file": str(each.absolute())}, None, str(path))
            for each in files
        ]
        return np.concatenate(parts, axis=-1)[index]

    layer = next((at for at in index if not isinstance(at, slice)), 0)
    return Volume(
        *(load, sizes, nrrd.reader._determine_datatype(raw)),
        **_place(header, kept_of(index)),
        index=index,
        space=SPACES.get(str(header.get("space", "")).lower()),
        hint=LABELS if "Segment0_LabelValue" in raw else "",
        names=_segments(raw, layer),
    )


def _segments(raw: dict[str, Any], layer: int) -> Names:
    """Return the labels that 3D Slicer names in a ``.seg.nrrd``, those of a layer of several."""
    names: Names = {}
    for number in range(len(raw)):
        label, name, colour, at = (
            str(raw.get(f"Segment{number}_{key}", ""))
            for key in ("LabelValue", "Name", "Color", "Layer")
        )
        if label and name and int(at or 0) == layer:
            rgb = [round(255 * float(share)) for share in colour.split()]
            names[int(label)] = name, (rgb[0], rgb[1], rgb[2]) if len(rgb) == 3 else None
    return names


def _axes_in_space(header: dict[str, Any]) -> tuple[int, ...] | None:
    """Return the axes that the header says are in space, None if these are not three."""
    count = len(header["sizes"])
    is_in_space = [kind in IN_SPACE for kind in header.get("kinds", ["???"] * count)]
    if header.get("space directions") is not None:
        along = np.nan_to_num(np.asarray(header["space directions"], np.float64)[:, :3])
        is_in_space = (along != 0).any(1).tolist()
    axes = tuple(axis for axis, is_one in enumerate(is_in_space) if is_one)
    return axes if len(axes) == 3 and len(is_in_space) == count else None


def _place(header: dict[str, Any], space: list[int]) -> dict[str, Any]:
    """Return what a ``Volume`` says of the place of the axes in space, as far as it is stated."""

    def of_axes(name: str, default: Any) -> Any:
        said = header.get(name, ())
        said = said.split() if isinstance(said, str) else said  # pynrrd does not split some
        return [said[axis] for axis in space] if len(said) > max(space) else default

    notes: tuple[str, ...] = ()
    columns: NDArray[np.float64] | None
    origin, units = header.get("space origin"), header.get("space units")
    if header.get("space directions") is not None:
        columns = np.asarray(header["space directions"], np.float64)[space, :3].T
        if columns.shape != (3, 3) or not np.isfinite(columns).all():
            raise FileError(f"its space directions are {columns.T.tolist()}: give three of three")
    else:
        names = ("spacings", "axis mins", "axis maxs")
        steps, low, high = (np.array(of_axes(name, [np.nan] * 3), float) for name in names)
        # what is not stated is a cell, as for ITK and teem: its first sample is half a step further
        is_cell = np.array([each != "node" for each in of_axes("centerings", ["cell"] * 3)])
        counts = np.maximum(np.asarray(header["sizes"])[space] - ~is_cell, 1)
        steps = np.where(np.isfinite(steps), steps, (high - low) / counts)
        columns = np.diag(steps) if (np.isfinite(steps) & (steps != 0)).all() else None
        units = units or of_axes("units", None)
        low = low + np.where(is_cell, steps / 2, 0)
        if origin is None and columns is not None and np.isfinite(low).all():
            origin = low
            notes = (CENTERING,) if "centerings" not in header else ()
    is_one, told = one_unit([unit.strip('"') for unit in (units or [])[:3]])
    if not is_one:
        return {"notes": notes + told}
    if origin is not None:  # it holds beside ``spacings``, too
        origin = triple(origin[:3]) if np.isfinite(origin[:3]).all() else None
    place = {} if columns is None else from_affine(columns)
    return {**place, "origin": origin, "notes": notes + told}


def read_metaimage(request: Request) -> Volume:
    """Read a ``.mha`` file, or a ``.mhd`` file and the data files that it names."""
    import SimpleITK

    path, (text, named, start) = request.path, split_header(request.path)
    if not start:
        raise FileError("its header is damaged: it has no ElementDataFile")
    lines = text.decode(errors="replace").splitlines()
    pairs = (re.split("[=:]", line, maxsplit=1) for line in lines)
    fields = {pair[0].strip(): pair[-1].strip() for pair in pairs}
    true = {name for name, value in fields.items() if value[:1] in ("T", "t", "1")}  # as in ITK
    is_local = [name.lower() for name in named] == ["local"]
    files = [check_beside(path, name) for name in named if not is_local]
    SimpleITK.ProcessObject.GlobalWarningDisplayOff()
    reader = SimpleITK.ImageFileReader()
    reader.SetFileName(str(path))
    reader.SetImageIO("MetaImageIO")
    try:
        reader.ReadImageInformation()
    except RuntimeError:
        raise FileError("its header is damaged, or not that of a MetaImage file") from None
    size = reader.GetSize()
    if (components := reader.GetNumberOfComponents()) != 1:
        raise GridError(f"{path} has {components} numbers a sample: give a file of three axes")
    one = SimpleITK.Image([1] * len(size), reader.GetPixelID())
    dtype = SimpleITK.GetArrayViewFromImage(one).dtype
    data, start = (files[0], 0) if files else (path, start)
    promised, follow = prod(size) * dtype.itemsize, data.stat().st_size - start
    is_packed = "CompressedData" in true and len(files) <= 1
    if not is_packed and len(files) <= 1 and promised > follow:
        raise FileError(f"{data} is truncated: {promised:,} bytes are promised, {follow:,} follow")

    def load(index: Index) -> Any:
        if not is_packed:
            return SimpleITK.GetArrayFromImage(reader.Execute()).T[index]
        is_big = {"BinaryDataByteOrderMSB", "ElementByteOrderMSB"} & true
        numbers = _unpacked(data, start, promised)
        values = np.frombuffer(numbers, dtype.newbyteorder(">" if is_big else "<"))
        return values.reshape(size[::-1]).T[index]

    index = request.pick(size)
    kept = kept_of(index)
    steps, origin = (np.array(said)[kept] for said in (reader.GetSpacing(), reader.GetOrigin()))
    direction = np.array(reader.GetDirection()).reshape(len(size), -1)[np.ix_(kept, kept)]
    place = triple(np.abs(steps)), triple(origin), direction * np.sign(steps)
    notes = in_unit(re.sub("^(mm|UNKNOWN|[?])$", "", fields.get("DistanceUnits", "")))
    if not {"ElementSpacing", "ElementSize"} & set(fields):
        notes += ("it states no ElementSpacing: taken as 1, as ITK does",)
    return Volume(load, size, dtype, *place, index, notes=notes, space=LPS)


def _unpacked(data: Path, start: int, promised: int) -> bytes:
    """Return what a zlib stream in a file holds."""
    unpacker = zlib.decompressobj()
    numbers = unpacker.decompress(data.read_bytes()[start:], promised + 1)
    if len(numbers) != promised or not unpacker.eof:
        said = f"{data} is damaged: {promised:,} bytes are promised, and its compressed data is"
        raise FileError(f"{said} torn or has others ({len(numbers):,})")
    return numbers
