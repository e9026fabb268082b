"""MRC and CCP4 maps, with mrcfile: lengths are in angstrom, values are densities.

Columns, rows and sections run along the world's axes in the order of ``mapc``, ``mapr`` and
``maps``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from . import DENSITY, Request, Volume, triple

VOLUME_STACKS = 401  # space groups from here on are of stacks of volumes


def read_mrc(request: Request) -> Volume:
    """Read a ``.mrc``, ``.map``, ``.rec`` or ``.ccp4`` file, or one that is packed with gzip.

    The origin is the field of this name, in angstrom; if it is 0 the place of the first sample in
    the unit cell, in samples.
    """
    import mrcfile
    from mrcfile.utils import data_dtype_from_header

    with mrcfile.open(request.path, permissive=True, header_only=True) as opened:
        header = opened.header
    sizes = tuple(int(header[f"n{axis}"]) for axis in "zyx")
    order = [int(header[name]) - 1 for name in ("maps", "mapr", "mapc")]
    order = [2, 1, 0] if order == [-1] * 3 else order
    cell, angles, origin = (
        np.array(header[name].tolist(), np.float64) for name in ("cella", "cellb", "origin")
    )
    if header.ispg >= VOLUME_STACKS and header.mz != header.nz:
        raise GridError(f"it is a stack of volumes of {header.mz} sections: save one of them")
    directions = axes_of_cell(angles if angles.all() else np.full(3, 90.0))
    counts = np.array([int(header[name]) for name in ("mx", "my", "mz")])
    steps = cell / np.maximum(counts, 1)
    is_stated = bool((cell > 0).all() and (counts > 0).all())
    if not origin.any():
        origin[order] = [int(header[f"n{axis}start"]) for axis in "zyx"]
        origin = directions @ (origin * steps)

    def load(index: Any) -> Any:
        with mrcfile.open(request.path, permissive=True) as opened:
            if opened.data is None:
                raise FileError("it is truncated")
            return opened.data

    place = triple(steps[order]) if is_stated else None, triple(origin), directions[:, order]
    return Volume(load, sizes, data_dtype_from_header(header), *place, hint=DENSITY)


def axes_of_cell(angles: Any) -> NDArray[np.float64]:
    """Return unit vectors along the axes a, b and c of a cell, in columns, of angles in degrees.

    As in the Protein Data Bank, a is along x, and b in the plane of x and y.
    """
    alpha, beta, gamma = np.cos(np.radians(angles)).round(12)
    height = np.sqrt(1 - gamma**2)
    c = np.array([beta, (alpha - beta * gamma) / height, 0])
    c[2] = np.sqrt(1 - c[0] ** 2 - c[1] ** 2)
    return np.array([[1, 0, 0], [gamma, height, 0], c]).T
