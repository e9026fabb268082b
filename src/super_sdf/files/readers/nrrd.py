"""NRRD files, with pynrrd.

Coordinates are those of the file's own space (LPS, RAS, ...), as its header gives them. Not with
SimpleITK, which turns them all to LPS, takes spacings by axis mins and maxs for 1, and refuses
bzip2, an axis of time, and spacings beside a space.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from ...options import LPS, RAS
from ..regular import check_beside
from ..volume import Request, Volume, from_affine, triple
from .axes import one_unit

CENTERING = (
    "it states axis mins, but no centerings: its samples are taken as cells, half a spacing from "
    "them, as ITK does"
)
IN_SPACE = ("domain", "space", "???", "none")  # kinds of axes; others are lists, vectors, time
SPACES = {"right-anterior-superior": RAS, "ras": RAS, "left-posterior-superior": LPS, "lps": LPS}
# Fields in one spelling of those that the format allows
SPELT = {"centers": "centerings", "axismins": "axis mins", "axismaxs": "axis maxs"}
SPELT |= {"datafile": "data file"}


def read_nrrd(request: Request) -> Volume:
    """Read a ``.nrrd`` file, or a ``.nhdr`` file and the data file that it names."""
    import nrrd

    raw = nrrd.read_header(str(request.path))
    header = {SPELT.get(name, name): value for name, value in raw.items()}
    if "data file" in header:
        check_beside(request.path, str(header["data file"]))
    sizes = tuple(int(size) for size in header["sizes"])
    kept = _axes_in_space(header) or tuple(n for n, size in enumerate(sizes) if size > 1)
    longer = [axis for axis, size in enumerate(sizes) if size > 1 and axis not in kept]
    if len(kept) != 3 or longer or header["dimension"] != len(sizes):
        raise GridError(f"{request.path} has shape {sizes}: give a file of three axes (x, y, z)")
    if min(sizes) < 1:
        raise FileError(f"its sizes are {sizes}")
    dtype = nrrd.reader._determine_datatype(raw)
    space = SPACES.get(str(header.get("space", "")).lower())
    place, notes = _place(header, kept)
    read = nrrd.read
    return Volume(
        lambda: read(str(request.path))[0], sizes, dtype, *place, kept, notes=notes, space=space
    )


def _axes_in_space(header: dict[str, Any]) -> tuple[int, ...] | None:
    """Return the axes that the header says are in space, None if these are not three."""
    count = len(header["sizes"])
    is_in_space = [kind in IN_SPACE for kind in header.get("kinds", ["???"] * count)]
    if header.get("space directions") is not None:
        along = np.nan_to_num(np.asarray(header["space directions"], np.float64)[:, :3])
        is_in_space = (along != 0).any(1).tolist()
    axes = tuple(axis for axis, is_one in enumerate(is_in_space) if is_one)
    return axes if len(axes) == 3 and len(is_in_space) == count else None


def _place(header: dict[str, Any], space: tuple[int, ...]) -> tuple[tuple[Any, Any, Any], Any]:
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
        columns = np.asarray(header["space directions"], np.float64)[list(space), :3].T
        if columns.shape != (3, 3) or not np.isfinite(columns).all():
            raise FileError(f"its space directions are {columns.T.tolist()}: give three of three")
    else:
        none = [np.nan] * 3
        steps, low, high = (
            np.array(of_axes(name, none), np.float64)
            for name in ("spacings", "axis mins", "axis maxs")
        )
        is_cell = np.array([each != "node" for each in of_axes("centerings", ["cell"] * 3)])
        counts = np.maximum(np.asarray(header["sizes"])[list(space)] - ~is_cell, 1)
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
    spacing, _, direction = from_affine(np.column_stack([columns, np.zeros(3)]))
    return (spacing, origin, direction), notes + told
