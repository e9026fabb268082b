"""NRRD files: pynrrd parses the header, which names the world's axes; the data is read here.

Coordinates are those of the file's own space (LPS, RAS, ...), as its header gives them. pynrrd
would load the whole array, whatever its size, from wherever the header says.
"""

from __future__ import annotations

import io
import re
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError, seen
from ...grid.planes import InputFile
from ...options import LPS, RAS
from ..regular import check_beside
from ..streams import TextValues, planes_behind
from ..volume import (MOST_NAMED, XYZ, Planes, Request, Volume, from_affine, in_words_of, reversed_axes)
from .axes import Axes, in_one_unit

LONGEST = 1 << 20  # bytes of a header
CENTERING = (
    "it states axis mins, but no centerings: its samples are taken as cells, half a spacing from "
    "them, as ITK does"
)
TEXT = ("ascii", "text", "txt")
IN_SPACE = ("domain", "space", "???", "none")  # kinds of axes; others are lists, vectors, time
SPACES = {"right-anterior-superior": RAS, "ras": RAS, "left-posterior-superior": LPS, "lps": LPS}
CODECS = {"gzip": "gzip", "gz": "gzip", "bzip2": "bz2", "bz2": "bz2"}
# Fields in one spelling of those that the format allows
SPELT = {"centers": "centerings", "axismins": "axis mins", "axismaxs": "axis maxs"}
SPELT |= {each: each.replace(" ", "") for each in ("data file", "line skip", "byte skip")}


def read_nrrd(request: Request) -> Volume:
    """Read a ``.nrrd`` file, or a ``.nhdr`` file and the data file that it names."""
    import nrrd

    file = InputFile.open(request.path)
    beginning = io.BytesIO(file.read(0, LONGEST).tobytes())
    header = {SPELT.get(name, name): value for name, value in nrrd.read_header(beginning).items()}
    sizes = tuple(int(size) for size in header["sizes"])
    if len(sizes) < 3 or header["dimension"] != len(sizes):
        raise GridError(f"{request.path} has shape {sizes}: give a file of three axes (x, y, z)")
    if min(sizes) < 1:
        raise FileError(f"its sizes are {sizes}")
    layer = _layer(request, header, sizes)
    rest = sizes if layer is None else (1, *sizes[1:])
    space = _axes(header).in_space(rest)
    shape = [rest[axis] for axis in space[::-1]]
    start = beginning.tell()
    if "datafile" in header:
        file, start = InputFile.open(check_beside(request.path, header["datafile"])), 0
    elif start >= LONGEST:
        raise FileError(f"its header has more than {LONGEST:,} bytes")
    layers = 1 if layer is None else sizes[0]
    stored = (*shape[:2], shape[2] * layers)  # layers are the fastest axis
    dtype = _dtype(nrrd, header)
    read_all, packed = _data(file, header, start, stored, dtype)

    def read(first: int, last: int) -> NDArray[Any]:
        planes: NDArray[Any] = read_all(first, last)[..., layer or 0 :: layers]
        return planes

    place, notes = _place(header, space)
    stated = SPACES.get(str(header.get("space", "")).lower())
    return Volume(tuple(shape), dtype, read, *place, packed=packed, notes=notes, space=stated)


def _axes(header: dict[str, Any]) -> Axes:
    """Return the axes of a file, the fastest first, named if it says which three are in space."""
    count = len(header["sizes"])
    kinds = header.get("kinds", ["???"] * count)
    directions = header.get("space directions")
    is_in_space = [kind in IN_SPACE for kind in kinds]
    if directions is not None:
        along = np.nan_to_num(np.asarray(directions, np.float64)[:, :3])
        is_in_space = (along != 0).any(1).tolist()
    if sum(is_in_space) != 3 or len(is_in_space) != count:
        return Axes.named([""] * count)
    names = iter("xyz")
    return Axes.named([next(names) if each else "" for each in is_in_space])


def _layer(request: Request, header: dict[str, Any], sizes: tuple[int, ...]) -> int | None:
    """Return which layer of a segmentation is read: the fastest of four axes; None without any."""
    count = sizes[0]
    if request.member is None and (count == 1 or len(sizes) < 4 or _axes(header).names[0]):
        return None
    if len(sizes) < 4:
        raise FileError(f"{request.path} holds one array: give no name of another in it")
    asked = (request.member or "").strip("/")
    if asked in map(str, range(count)):
        return int(asked)
    layers = ", ".join(f"{i}{_segments(header, i)}" for i in range(min(count, MOST_NAMED)))
    wrong = f", and none of them is {seen(asked)}" if asked else ""
    raise FileError(
        f"{request.path} holds {count:,} layers, {layers}{wrong}: give {request.path}:0, say, and "
        "--label for one of several segments in it"
    )


def _segments(header: dict[str, Any], layer: int) -> str:
    segments = [
        f"{header.get(key.replace('_Layer', '_Name'), '?')} "
        f"{header.get(key.replace('_Layer', '_LabelValue'), '?')}"
        for key, value in header.items()
        if re.fullmatch(r"Segment\d+_Layer", key) and value.strip() == str(layer)
    ]
    return f" ({seen(', '.join(segments))})" if segments else ""


def _dtype(nrrd: Any, header: dict[str, Any]) -> np.dtype[Any]:
    """Return the type that pynrrd makes of the header: it reads one sample that is 0."""
    said: dict[str, Any] = {key: header[key] for key in ("type", "endian") if key in header}
    if header["encoding"].lower() in TEXT:
        said["endian"] = "little"  # which text need not state
    one = {**said, "encoding": "raw", "dimension": 1, "sizes": np.array([1])}
    return np.dtype(nrrd.read_data(one, io.BytesIO(bytes(8))).dtype)


def _data(
    file: InputFile,
    header: dict[str, Any],
    start: int,
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
) -> tuple[Planes, int | None]:
    encoding, skip = header["encoding"], header.get("byteskip", 0)
    start = _after_lines(file, start, header.get("lineskip", 0))
    if encoding == "raw":
        start = file.size - prod(shape) * dtype.itemsize if skip == -1 else start + skip
        if start < 0:
            raise FileError(
                f"{file.name} is truncated: {in_words_of(shape, dtype)} are promised, it has "
                f"{file.size:,}"
            )
    elif skip or encoding.lower() not in (*TEXT, *CODECS):
        raise FileError(f"its encoding is {seen(encoding)}, byte skip {skip}: save it as raw")
    elif encoding.lower() in TEXT:
        return TextValues(file, start, file.size, dtype, shape).planes, None
    return planes_behind(file, start, CODECS.get(encoding.lower()), shape, dtype)


def _after_lines(file: InputFile, start: int, lines: int) -> int:
    text = file.read(start, LONGEST).tobytes() if lines else b""
    place = 0
    for _ in range(lines):
        place = text.find(b"\n", place) + 1
        if not place:
            raise FileError(f"it has no {lines:,} lines to skip (line skip)")
    return start + place


def _place(
    header: dict[str, Any], space: list[int]
) -> tuple[tuple[Any, Any, NDArray[np.float64]], tuple[str, ...]]:
    """Return spacing, origin and direction of the array in C order, and notes on the unit.

    None stands for what is not stated. A ``space origin`` holds beside ``spacings``, too.
    """
    notes: tuple[str, ...] = ()
    origin = header.get("space origin")
    directions, units = header.get("space directions"), header.get("space units", ())
    if directions is None:
        steps, low = _steps(header, space)
        columns = None if steps is None else np.diag(steps)
        units = units or _of_axes(header.get("units"), space, ())
        if origin is None and low is not None:
            origin = low
            if "centerings" not in header:
                notes = (CENTERING,)
    else:
        columns = np.asarray(directions, np.float64)[space, :3].T
        if columns.shape != (3, 3) or not np.isfinite(columns).all():
            raise FileError(f"its space directions are {columns.T.tolist()}: give three of three")
    factors, told = in_one_unit([unit.strip('"') for unit in units[:3]] or [""] * 3)
    notes += told
    if factors is None:
        return (None, None, XYZ[:, ::-1]), notes
    origin = None if origin is None else np.asarray(origin, np.float64)[:3] * factors
    if columns is None:
        return (None, _numbers(origin), XYZ[:, ::-1]), notes
    lengths, _, direction = from_affine(np.column_stack([np.diag(factors) @ columns, np.zeros(3)]))
    spacing, direction = reversed_axes(lengths, direction)
    return (spacing, _numbers(origin), direction), notes


def _steps(header: dict[str, Any], space: list[int]) -> tuple[Any, Any]:
    """Return the steps and the first position along the axes by ``spacings`` and ``axis mins``.

    The mins of cells are their borders: their first sample is half a step further. Samples whose
    centering is not stated are cells, as for ITK and teem.
    """
    none = np.full(3, np.nan)
    steps, low, high = (
        np.asarray(_of_axes(header.get(name), space, none), np.float64)
        for name in ("spacings", "axis mins", "axis maxs")
    )
    said = header.get("centerings", ())
    said = said.split() if isinstance(said, str) else said  # pynrrd does not split "centers"
    is_cell = np.array([each != "node" for each in _of_axes(said, space, ("cell",) * 3)])
    counts = np.asarray(header["sizes"])[space] - ~is_cell
    steps = np.where(np.isfinite(steps), steps, (high - low) / np.maximum(counts, 1))
    if not (np.isfinite(steps) & (steps != 0)).all():
        return None, None
    low = low + np.where(is_cell, steps / 2, 0)
    return steps, low if np.isfinite(low).all() else None


def _of_axes(values: Any, space: list[int], default: Any) -> Any:
    is_stated = values is not None and len(values) > max(space)  # for all
    return [values[axis] for axis in space] if is_stated else default


def _numbers(numbers: Any) -> tuple[float, ...] | None:
    if numbers is None or not np.isfinite(numbers).all():
        return None
    return tuple(float(number) for number in numbers)
