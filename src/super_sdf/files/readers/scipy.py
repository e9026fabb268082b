"""NetCDF and MATLAB's files, with SciPy; those that are HDF5, with h5py."""

from __future__ import annotations

from typing import Any

from ...errors import FileError
from ..volume import PLACE, Request, Volume, of_array
from .axes import Axis, measured, placed, stored
from .h5py import may_be_grid, read_hdf5, volume_of

INTEGERS = tuple(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))
NUMBERS = ("double", "single", "logical", *INTEGERS)  # of MATLAB
ORDER = (
    "its axes are taken as x, y, z, the order of ndgrid; of an array in the order of meshgrid, "
    "which is y, x, z, save permute(V, [2 1 3])"
)


def read_netcdf(request: Request) -> Volume:
    """Read ``FILE.nc:/VARIABLE``; without a name the only variable of three axes."""
    import h5py
    from scipy.io import netcdf_file

    if h5py.is_hdf5(request.path):
        return read_hdf5(request)
    file = request.files.enter_context(netcdf_file(request.path, mmap=False))
    variables = file.variables
    names = [f"/{name}" for name, values in variables.items() if may_be_grid(values.shape)]
    values = variables[request.choose(names, "variable of three axes")[1:]]
    about = values._attributes
    axes = []
    for name in values.dimensions:
        scale = variables.get(name)
        axes.append(Axis(name) if scale is None else measured(name, scale.data, scale._attributes))
    place = placed(axes, about, values.shape, request.axes)
    return Volume(*stored(values.data, about), **place)


def read_mat(request: Request) -> Volume:
    """Read ``FILE.mat:VARIABLE``; without a name the only array of three axes.

    Variables ``spacing``, ``origin`` and ``direction`` beside it are its place, as in ``.npz``. In
    files of version 7.3, which are HDF5, the axes of all are in reverse order.
    """
    import h5py
    from scipy.io import loadmat, whosmat

    def place(stated: dict[str, Any], shape: tuple[int, ...]) -> dict[str, Any]:
        found = placed([Axis()] * 3, stated, shape, request.axes[::-1])
        return found | {"notes": (ORDER,) if request.axes == "xyz" else ()}

    what = "array of three axes"
    if h5py.is_hdf5(request.path):
        file = request.files.enter_context(h5py.File(request.path, "r"))
        kinds = [kind.encode() for kind in NUMBERS]
        names = [
            name
            for name, entry in file.items()
            if isinstance(entry, h5py.Dataset)
            and len(entry.shape or ()) == 3
            and entry.attrs.get("MATLAB_class", b"") in kinds
        ]
        dataset = file[request.choose(names, what)]
        stated = {key: file[key][()].T for key in PLACE if key in file}
        return volume_of(dataset, place(stated, dataset.shape))
    listed = whosmat(request.path)
    shapes = {name: shape for name, shape, kind in listed if len(shape) == 3 and kind in NUMBERS}
    name = request.choose(list(shapes), what)
    variables = loadmat(request.path, variable_names=[name, *PLACE])
    stated = {key: variables[key] for key in PLACE if key in variables}
    values = variables[name].T  # planes of the last axis are contiguous
    if values.shape[::-1] != shapes[name]:
        raise FileError(f"it is damaged: {name} has shape {values.shape[::-1]}")
    return Volume(*of_array(values), **place(stated, values.shape))
