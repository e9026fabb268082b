"""MATLAB's ``.mat`` files: up to version 7 with SciPy, version 7.3, which is HDF5, with h5py.

Variables ``spacing``, ``origin`` and ``direction`` beside the array are its place, as in ``.npz``.
"""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np

from ..volume import Request, Volume
from .axes import Axes
from .choosing import choose_member
from .hdf5 import check_stored, volume_of
from .stored import placed

PLACE = ("spacing", "origin", "direction")
INTEGERS = tuple(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))
NUMBERS = ("double", "single", "logical", *INTEGERS)
ORDER = (
    "its axes are taken as x, y, z, the order of ndgrid; of an array in the order of meshgrid, "
    "which is y, x, z, save permute(V, [2 1 3])"
)


def read_mat(request: Request) -> Volume:
    """Read ``FILE.mat:VARIABLE``; without a name the only array of three axes."""
    import h5py

    return (_read_73 if h5py.is_hdf5(request.path) else _read_5)(request)


def _read_5(request: Request) -> Volume:
    """Read a file of version 4 to 7: a variable is loaded whole."""
    from scipy.io import loadmat, whosmat

    listed = whosmat(request.path)
    arrays = {name: shape for name, shape, kind in listed if len(shape) == 3 and kind in NUMBERS}
    name = choose_member(request, list(arrays), "array of three axes")
    request.check_loads(8 * prod(arrays[name]), "SciPy")
    found = loadmat(request.path, variable_names=[name, *PLACE])
    values = found[name].T  # planes of the last axis are contiguous
    _, place = _placed({key: found[key] for key in PLACE if key in found}, values.shape, request)
    return Volume(values.shape, values.dtype, lambda first, last: values[first:last], **place)


def _read_73(request: Request) -> Volume:
    """Read a file of version 7.3: the axes of its datasets are in reverse order."""
    import h5py

    file = request.files.enter_context(h5py.File(request.path, "r"))

    def is_array(name: str) -> bool:
        kind = file[name].attrs.get("MATLAB_class", b"")
        return kind in map(str.encode, NUMBERS) and len(file[name].shape) == 3

    names = [name for name in file if isinstance(file[name], h5py.Dataset) and is_array(name)]
    values = file[choose_member(request, names, "array of three axes")]
    check_stored(values, request)
    stated = {key: np.transpose(file[key][()]) for key in PLACE if key in file}
    return volume_of(values, *_placed(stated, values.shape, request))


def _placed(
    stated: dict[str, Any], shape: tuple[int, ...], request: Request
) -> tuple[list[int], dict[str, Any]]:
    """Return axes and place of an array whose axes are in reverse order."""
    space, place = placed(Axes.named([""] * 3), stated, shape, request.axes[::-1])
    return space, place | {"notes": (ORDER,) if request.axes == "xyz" else ()}
