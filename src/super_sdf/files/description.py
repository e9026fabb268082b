"""What a grid file states, for ``info``: no sample is read where the format allows it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FileError
from ..grid.placement import STRAIGHT
from ..grid.planes import InputFile
from ..options import check_path
from .archives import open_archive
from .formats import GridFormat, choose_axes, find_format
from .grids import find_members, npz_member, open_volume, read_small, reader_of
from .headers import ArrayHeader, read_array_header
from .regular import check_regular_file
from .volume import find_placement, place_in_world

NOTHING_GIVEN = {"spacing": None, "origin": None, "direction": None}


def describe_grid_file(path: str | Path) -> dict[str, Any]:
    """Return format, shape (x, y, z), type, place and storage of the array in a grid file.

    What the file does not state is None or missing. Chunks and shards are in the order of the
    array's own axes.

    Raises
    ------
    SuperSdfError
        As in ``read_grid``.
    """
    path = check_path(path, "path")
    format_ = find_format(path)
    if format_.key in ("npy", "npz"):
        found = (_of_npy if format_.key == "npy" else _of_npz)(check_regular_file(path))
    else:
        found = _of_volume(path, format_)
    return {"file": str(path), "format": format_.name, **found}


def _of_npy(path: Path) -> dict[str, Any]:
    """Return what the header of an .npy file says."""
    header = read_array_header(reader_of(InputFile.open(path)), str(path)).squeezed()
    return {**_of_header(header), "spacing": None, "origin": None}


def _of_npz(path: Path) -> dict[str, Any]:
    """Return what the header of the values in an .npz file says, and their place."""
    file = InputFile.open(path)
    with open_archive(file) as archive:
        members = find_members(archive, path)
        header = read_array_header(
            npz_member(archive, members["values"], path).read, f"{path}[values]"
        ).squeezed()
        place: dict[str, Any] = {
            key: read_small(archive, members[key], f"{path}[{key}]").ravel().tolist()
            for key in ("spacing", "origin", "direction")
            if key in members
        }
    return {**_of_header(header), "spacing": None, "origin": None, **place}


def _of_header(header: ArrayHeader) -> dict[str, Any]:
    """Return the facts of an array by its header."""
    order = "Fortran" if header.fortran_order else "C"
    return {
        "shape": list(header.shape),
        "dtype": str(header.dtype),
        "bytes": header.size,
        "order": order,
    }


def _of_volume(path: Path, format_: GridFormat) -> dict[str, Any]:
    """Return what a file that its own library reads says."""
    with open_volume(path, format_, choose_axes(format_, None), (0, None)) as volume:
        if len(volume.shape) != 3:
            raise FileError(f"its array has shape {volume.shape}: give three axes")
        placement = find_placement(volume, str(path))
        place = place_in_world(volume, placement, NOTHING_GIVEN)
    shape = [volume.shape[placement.world_axes.index(w)] for w in range(3)]
    found: dict[str, Any] = {
        "shape": shape,
        "dtype": str(volume.dtype),
        "bytes": int(np.prod(shape, dtype=object)) * volume.dtype.itemsize,
        "axes in the file": "".join("xyz"[w] for w in placement.world_axes),
        "spacing": _listed(place["spacing"]),
        "origin": _listed(place["origin"]),
    }
    if place["direction"] not in (None, STRAIGHT):
        found["direction"] = np.asarray(place["direction"]).ravel().tolist()
    if volume.chunks:
        found["chunks"] = list(volume.chunks)
    return {**found, **volume.about, "notes": list(volume.notes)}


def _listed(numbers: Any) -> list[float] | None:
    """Return numbers as a list of floats; None if there are none."""
    return None if numbers is None else [float(number) for number in np.ravel(numbers)]
