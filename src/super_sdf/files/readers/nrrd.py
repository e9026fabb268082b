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

from ...errors import FileError, GridError, seen
from ...options import LPS, RAS
from ..regular import check_beside
from ..volume import MOST_NAMED, Later, Request, Volume, from_affine
from .axes import in_one_unit

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
    if len(sizes) < 3 or header["dimension"] != len(sizes):
        raise GridError(f"{request.path} has shape {sizes}: give a file of three axes (x, y, z)")
    if min(sizes) < 1:
        raise FileError(f"its sizes are {sizes}")
    in_space = _axes_in_space(header)
    layer = _layer(request, header, sizes, in_space)
    shape = sizes if layer is None else (1, *sizes[1:])
    kept = in_space or tuple(axis for axis, size in enumerate(shape) if size > 1)
    longer = [axis for axis, size in enumerate(shape) if size > 1 and axis not in kept]
    if len(kept) != 3 or longer:
        raise GridError(f"{request.path} has shape {sizes}: give a file of three axes (x, y, z)")
    dtype = nrrd.reader._determine_datatype(raw)

    def load() -> NDArray[Any]:
        data = nrrd.read(str(request.path))[0]
        return data if layer is None else data[layer : layer + 1]

    place, notes = _place(header, kept)
    space = SPACES.get(str(header.get("space", "")).lower())
    return Volume(Later(shape, dtype, load), *place, kept, notes=notes, space=space)


def _axes_in_space(header: dict[str, Any]) -> tuple[int, ...] | None:
    """Return the axes that the header says are in space, None if these are not three."""
    count = len(header["sizes"])
    is_in_space = [kind in IN_SPACE for kind in header.get("kinds", ["???"] * count)]
    if header.get("space directions") is not None:
        along = np.nan_to_num(np.asarray(header["space directions"], np.float64)[:, :3])
        is_in_space = (along != 0).any(1).tolist()
    axes = tuple(axis for axis, is_one in enumerate(is_in_space) if is_one)
    return axes if len(axes) == 3 and len(is_in_space) == count else None


def _layer(
    request: Request, header: dict[str, Any], sizes: tuple[int, ...], in_space: Any
) -> int | None:
    """Return which layer of a segmentation is read: the fastest of four axes; None without any."""
    count = sizes[0]
    if request.member is None and (count == 1 or len(sizes) < 4 or 0 in (in_space or ())):
        return None
    if len(sizes) < 4:
        raise FileError(f"{request.path} holds one array: give no name of another in it")
    asked = (request.member or "").strip("/")
    if asked in map(str, range(count)):
        return int(asked)
    listed = []
    for layer in range(min(count, MOST_NAMED)):
        segments = [
            f"{header.get(key.replace('_Layer', '_Name'), '?')} "
            f"{header.get(key.replace('_Layer', '_LabelValue'), '?')}"
            for key, value in header.items()
            if re.fullmatch(r"Segment\d+_Layer", key) and value.strip() == str(layer)
        ]
        listed.append(f"{layer} ({seen(', '.join(segments))})" if segments else str(layer))
    wrong = f", and none of them is {seen(asked)}" if asked else ""
    raise FileError(
        f"{request.path} holds {count:,} layers, {', '.join(listed)}{wrong}: give "
        f"{request.path}:0, say, and --label for one of several segments in it"
    )


def _place(header: dict[str, Any], space: tuple[int, ...]) -> tuple[tuple[Any, Any, Any], Any]:
    """Return spacing, origin and direction of the axes in space, and notes on the unit.

    None stands for what is not stated. A ``space origin`` holds beside ``spacings``, too. The mins
    of cells are their borders: their first sample is half a step further. Samples whose centering
    is not stated are cells, as for ITK and teem.
    """
    notes: tuple[str, ...] = ()
    columns: NDArray[np.float64] | None
    origin, units = header.get("space origin"), header.get("space units")
    if header.get("space directions") is not None:
        columns = np.asarray(header["space directions"], np.float64)[list(space), :3].T
        if columns.shape != (3, 3) or not np.isfinite(columns).all():
            raise FileError(f"its space directions are {columns.T.tolist()}: give three of three")
    else:

        def of_axes(name: str, default: Any) -> Any:
            said = header.get(name, ())
            said = said.split() if isinstance(said, str) else said  # pynrrd does not split some
            return [said[axis] for axis in space] if len(said) > max(space) else default

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
    factors, told = in_one_unit([unit.strip('"') for unit in (units or [])[:3]] or [""] * 3)
    if factors is None:
        return (None, None, None), notes + told
    if origin is not None:
        origin = np.asarray(origin, np.float64)[:3] * factors
        origin = tuple(origin.tolist()) if np.isfinite(origin).all() else None
    if columns is None:
        return (None, origin, None), notes + told
    spacing, _, direction = from_affine(np.column_stack([np.diag(factors) @ columns, np.zeros(3)]))
    return (spacing, origin, direction), notes + told
