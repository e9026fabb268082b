"""MRC and CCP4 maps, with mrcfile: lengths are in angstrom, values are densities.

Columns, rows and sections run along the world's axes in the order of ``mapc``, ``mapr`` and
``maps``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...errors import FileError, GridError
from . import DENSITY, XYZ, Request, Volume, triple

VOLUME_STACKS = 401  # space groups from here on are of stacks of volumes
RIGHT = 0.01  # degrees


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
    if angles.any() and np.abs(angles - 90).max() > RIGHT:
        raise GridError(f"the angles of its cell are {angles.tolist()} degrees: resample it to 90")
    counts = np.array([int(header[name]) for name in ("mx", "my", "mz")])
    steps = cell / np.maximum(counts, 1)
    is_stated = bool((cell > 0).all() and (counts > 0).all())
    if not origin.any():
        origin[order] = [int(header[f"n{axis}start"]) for axis in "zyx"]
        origin *= steps

    def load(index: Any) -> Any:
        with mrcfile.open(request.path, permissive=True) as opened:
            if opened.data is None:
                raise FileError("it is truncated")
            return opened.data

    place = triple(steps[order]) if is_stated else None, triple(origin), XYZ[:, order]
    return Volume(load, sizes, data_dtype_from_header(header), *place, hint=DENSITY)
