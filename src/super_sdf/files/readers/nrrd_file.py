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
    """Return spacing, origin and direction of the array in C order."""
    if header.get("space directions") is not None:
        matrix = np.zeros((3, 4))
        directions = np.asarray(header["space directions"], np.float64)
        if directions.shape != (3, 3) or not np.isfinite(directions).all():
            raise FileError(f"its space directions are {directions.tolist()}: give three of three")
        matrix[:, :3] = directions.T
        spacing, origin, direction = from_affine(matrix)
        if header.get("space origin") is None:
            return *reversed_axes(spacing, direction), None
        origin = tuple(float(x) for x in header["space origin"])
        spacing, direction = reversed_axes(spacing, direction)
        return spacing, origin, direction
    spacings = header.get("spacings")
    if spacings is None or not np.isfinite(spacings).all():
        return None, None, XYZ[:, ::-1]
    spacing, direction = reversed_axes(spacings, XYZ)
    least = header.get("axis mins")
    if least is None or not np.isfinite(least).all():
        return spacing, None, direction
    cells = [kind == "cell" for kind in header.get("centerings", ("node",) * 3)]
    origin = np.asarray(least, np.float64) + np.where(cells, np.asarray(spacings) / 2, 0)
    return spacing, tuple(map(float, origin)), direction
