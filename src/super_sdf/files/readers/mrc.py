"""MRC and CCP4 maps: mrcfile parses the header, the values are read here.

Columns, rows and sections run along the world's axes in the order of ``mapc``, ``mapr`` and
``maps``. Lengths are in angstrom.
"""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arrays import Triple
from ...errors import FileError, GridError
from ...grid.planes import InputFile
from ..streams import CODECS, Unpacker, bytes_from, next_planes, raw_planes
from ..volume import XYZ, Request, Volume, triple

MAIN_HEADER = 1024  # bytes
VOLUME_STACKS = 401  # space groups from here on are of stacks of volumes
RIGHT = 0.01  # degrees


def read_mrc(request: Request) -> Volume:
    """Read a ``.mrc``, ``.map`` or ``.ccp4`` file, or one that is packed with gzip."""
    import mrcfile
    from mrcfile.utils import data_dtype_from_header

    with mrcfile.open(request.path, permissive=True, header_only=True) as opened:
        header = opened.header
    sizes = tuple(int(header[f"n{axis}"]) for axis in "zyx")
    if min(sizes) < 1:
        raise FileError(f"its sizes are {sizes[::-1]}")
    if header.ispg >= VOLUME_STACKS and header.mz != header.nz:
        raise GridError(f"it is a stack of volumes of {header.mz} sections: save one of them")
    place, notes = _place(header)
    start = MAIN_HEADER + max(int(header.nsymbt), 0)
    dtype, file = data_dtype_from_header(header), InputFile.open(request.path)
    if request.path.suffix.lower() != ".gz":
        stored = raw_planes(file, start, sizes, dtype)
        return Volume(sizes, dtype, stored.read, *place, notes=notes)
    size = start + prod(sizes) * dtype.itemsize
    unpacked = Unpacker(bytes_from(file, 0), CODECS["gzip"](), size, file.name).read
    unpacked(start)
    read = next_planes(unpacked, sizes, dtype)
    return Volume(sizes, dtype, read, *place, packed=file.size, notes=notes)


Place = tuple[Triple | None, Triple, NDArray[np.float64]]


def _place(header: Any) -> tuple[Place, tuple[str, ...]]:
    """Return spacing, origin and direction of the sections, rows and columns, and a note.

    The origin is the field of this name, in angstrom; if it is 0 the place of the first sample in
    the unit cell, in samples.
    """
    order = [int(header[name]) - 1 for name in ("maps", "mapr", "mapc")]
    order = [2, 1, 0] if order == [-1] * 3 else order
    if sorted(order) != [0, 1, 2]:
        raise FileError(f"its axes mapc, mapr, maps are {[axis + 1 for axis in order[::-1]]}")
    angles = _numbers(header.cellb, ("alpha", "beta", "gamma"))
    if angles.any() and np.abs(angles - 90).max() > RIGHT:
        raise GridError(
            f"the angles of its unit cell are {_listed(angles)} degrees, not "
            "90: resample it on a grid with right angles"
        )
    counts = np.array([int(header[name]) for name in ("mx", "my", "mz")])
    cell = _numbers(header.cella, "xyz")
    steps = cell / np.maximum(counts, 1)
    is_stated = bool((cell > 0).all() and (counts > 0).all())
    starts = np.zeros(3)
    starts[order] = [int(header[f"n{axis}start"]) for axis in "zyx"]
    stated, in_cell = _numbers(header.origin, "xyz"), starts * steps
    notes: tuple[str, ...] = ()
    if stated.any() and in_cell.any() and not np.allclose(stated, in_cell, atol=steps.max() / 100):
        notes = (
            f"its origin is {_listed(stated)} and its nstart means {_listed(in_cell)}: the origin "
            "is taken",
        )
    spacing = triple(steps[order]) if is_stated else None
    return (spacing, triple(stated if stated.any() else in_cell), XYZ[:, order]), notes


def _numbers(fields: Any, names: Any) -> NDArray[np.float64]:
    """Return three fields of the header, which must be finite."""
    numbers = np.array([fields[name] for name in names], np.float64)
    if not np.isfinite(numbers).all():
        raise FileError(f"its header is damaged: {', '.join(names)} are {numbers.tolist()}")
    return numbers


def _listed(numbers: NDArray[np.float64]) -> str:
    return ", ".join(f"{number:g}" for number in numbers)
