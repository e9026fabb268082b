"""NRRD files, with pynrrd.

Coordinates are those of the file's own space (LPS, RAS, ...), as its header gives them. Not with
SimpleITK, which turns them all to LPS, takes spacings by axis mins and maxs for 1, and refuses
bzip2, an axis of time, and spacings beside a space.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from ...options import LPS, RAS
from ..formats import LONGEST_HEADER, data_files
from . import LABELS, Index, Names, Request, Volume, from_affine, triple
from .axes import one_unit

CENTERING = (
    "it states axis mins, but no centerings: its samples are taken as cells, half a spacing from "
    "them, as ITK does"
)
IN_SPACE = ("domain", "space", "???", "none")  # kinds of axes; others are lists, vectors, time
SPACES = {"right-anterior-superior": RAS, "ras": RAS, "left-posterior-superior": LPS, "lps": LPS}
# Fields in one spelling of those that the format allows
SPELT = {"centers": "centerings", "axismins": "axis mins", "axismaxs": "axis maxs"}
LIST = re.compile(rb"^data ?file: *LIST[^\n]*\n", re.M)


def read_nrrd(request: Request) -> Volume:
    """Read a ``.nrrd`` file, or a ``.nhdr`` file and the data files that it names."""
    import nrrd

    path = request.path
    with path.open("rb") as file:
        beginning = file.read(LONGEST_HEADER)
        file.seek(0)
        found = LIST.search(beginning)
        lines = beginning[: found.start()].splitlines(keepends=True) if found else file
        raw = nrrd.read_header(lines)
    header = {SPELT.get(name, name): value for name, value in raw.items()}
    named = "LIST" if found else str(raw.pop("data file", raw.pop("datafile", "")))
    files = data_files(path, named, beginning[found.end() if found else 0 :]) if named else []
    sizes = tuple(int(size) for size in header["sizes"])
    kept = _axes_in_space(header)
    if header["dimension"] != len(sizes) or len(sizes) < 3:
        raise GridError(f"{path} has shape {sizes}: give a file of three axes (x, y, z)")
    if min(sizes) < 1:
        raise FileError(f"its sizes are {sizes}")
    index = request.pick(sizes, kept)
    space = [n for n, at in enumerate(index) if isinstance(at, slice)]

    def load(index: Index) -> Any:
        if not files:
            return nrrd.read(str(path))[0][index]
        part = {**raw, "sizes": np.array([*sizes[:-1], sizes[-1] // len(files)])}
        parts = [
            nrrd.read_data({**part, "data file": str(each.absolute())}, None, str(path))
            for each in files
        ]
        return np.concatenate(parts, axis=-1)[index]

    place, notes = _place(header, space)
    layer = next((at for at in index if not isinstance(at, slice)), 0)
    return Volume(
        *(load, sizes, nrrd.reader._determine_datatype(raw), *place, index),
        space=SPACES.get(str(header.get("space", "")).lower()),
        notes=notes,
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


def _place(header: dict[str, Any], space: list[int]) -> tuple[tuple[Any, Any, Any], Any]:
    """Return spacing, origin and direction of the axes in space, None if not stated, and notes.

    A ``space origin`` holds beside ``spacings``, too. The mins of cells are their borders: their
    first sample is half a step further. Samples whose centering is not stated are cells, as for ITK
    and teem.
    """

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
        none = [np.nan] * 3
        steps, low, high = (
            np.array(of_axes(name, none), np.float64)
            for name in ("spacings", "axis mins", "axis maxs")
        )
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
        return (None, None, None), notes + told
    if origin is not None:
        origin = triple(origin[:3]) if np.isfinite(origin[:3]).all() else None
    if columns is None:
        return (None, origin, None), notes + told
    found = from_affine(np.column_stack([columns, np.zeros(3)]))
    return (found["spacing"], origin, found["direction"]), notes + told
