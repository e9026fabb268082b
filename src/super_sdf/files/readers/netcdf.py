"""NetCDF files: version 4, which is HDF5, with h5py; the classic versions with SciPy.

A variable of three axes, besides some of length 1, is placed by the coordinates of its axes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..boxes import Box
from ..volume import Request, Volume
from .axes import Axes
from .choosing import choose_member
from .hdf5 import may_be_grid, read_hdf5
from .stored import along, placed, unscaled


def read_netcdf(request: Request) -> Volume:
    """Read ``FILE.nc:/VARIABLE``; without a name the only variable of three axes."""
    import h5py

    return read_hdf5(request) if h5py.is_hdf5(request.path) else _read_classic(request)


def _read_classic(request: Request) -> Volume:
    """Read a file of version 3 or before, whose samples are mapped into memory."""
    from scipy.io import netcdf_file

    variables = request.files.enter_context(netcdf_file(request.path, mmap=True)).variables
    names = [f"/{name}" for name, values in variables.items() if may_be_grid(values.shape)]
    values = variables[choose_member(request, names, "variable of three axes")[1:]]
    about = vars(values)["_attributes"]
    scales = [variables.get(name) for name in values.dimensions]
    space, place = placed(_axes(values, scales), about, values.shape, request.axes)
    shape = tuple(values.shape[axis] for axis in space)

    def stored(box: Box) -> NDArray[Any]:
        samples: NDArray[Any] = values.data[along(space, box, len(values.shape))]
        return samples

    read_box, dtype = unscaled(stored, values.data.dtype, about)

    def read(first: int, last: int) -> NDArray[Any]:
        return read_box((slice(first, last), slice(0, shape[1]), slice(0, shape[2])))

    return Volume(shape, dtype, read, read_box=read_box, **place)


def _axes(values: Any, scales: list[Any]) -> Axes:
    """Return the axes of a variable, with those that hold their coordinates, or None."""
    about = [{} if scale is None else vars(scale)["_attributes"] for scale in scales]

    def found(axis: int) -> tuple[NDArray[Any] | None, dict[str, Any]]:
        scale = scales[axis]
        return (None if scale is None else np.array(scale.data)), about[axis]

    return Axes.of_coordinates(values.dimensions, values.shape, found)
