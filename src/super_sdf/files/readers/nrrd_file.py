"""NRRD files, with pynrrd, which loads the whole array; the header names the world's axes.

Coordinates are those of the file's own space (LPS, RAS, ...), as its header gives them.
"""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from ..volume import XYZ, Request, Volume, from_affine, reversed_axes


def read_nrrd(request: Request) -> Volume:
    """Read a ``.nrrd`` file, or a ``.nhdr`` file and the data file that it names."""
    import nrrd

    header = nrrd.read_header(str(request.path))
    sizes = tuple(int(size) for size in header["sizes"])
    if len(sizes) != 3:
        raise GridError(f"{request.path} has shape {sizes}: give a file of three axes (x, y, z)")
    packed = 1 if header["encoding"] == "raw" else 2
    request.check_loads(8 * prod(sizes) * packed, "pynrrd")
    values, header = nrrd.read(str(request.path), index_order="C")
    spacing, origin, direction = _place(header)

    def read(first: int, last: int) -> NDArray[Any]:
        planes: NDArray[Any] = values[first:last]
        return planes

    return Volume(values.shape, values.dtype, read, spacing, origin, direction)


def _place(header: dict[str, Any]) -> tuple[Any, Any, NDArray[np.float64]]:
    """Return spacing, origin and direction of the array in C order; None for what is not stated."""
    directions = header.get("space directions")
    if directions is not None:
        columns = np.asarray(directions, np.float64).T
        if columns.shape != (3, 3) or not np.isfinite(columns).all():
            raise FileError(f"its space directions are {columns.T.tolist()}: give three of three")
        lengths, _, direction = from_affine(np.column_stack([columns, np.zeros(3)]))
        spacing, direction = reversed_axes(lengths, direction)
        return spacing, _numbers(header.get("space origin")), direction
    spacings, least = header.get("spacings"), header.get("axis mins")
    spacing, direction = reversed_axes(XYZ[0] if spacings is None else spacings, XYZ)
    if spacings is None or not np.isfinite(spacings).all():
        return None, None, direction
    if least is None or not np.isfinite(least).all():
        return spacing, None, direction
    cells = [kind == "cell" for kind in header.get("centerings", ("node",) * 3)]
    origin = np.asarray(least, np.float64) + np.where(cells, np.asarray(spacings) / 2, 0)
    return spacing, _numbers(origin), direction


def _numbers(numbers: Any) -> tuple[float, ...] | None:
    return None if numbers is None else tuple(float(number) for number in numbers)
