"""HDF5, and what is made of it: NetCDF and MATLAB, whose older files SciPy reads.

Axes are (z, y, x) unless dimension labels, scales, ``axistags`` or ``--axes`` say otherwise.
"""

from __future__ import annotations

import json
import re
from typing import Any

from ...errors import FileError
from . import PLACE, Axis, Request, Volume, measured, placed, stored, triple

INTEGERS = tuple(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))
NUMBERS = ("double", "single", "logical", *INTEGERS)  # of MATLAB
IMARIS = "DataSetInfo/Image"  # where Imaris states sizes
SIZES = re.compile("resolution|offset|voxel|pixel|extent|ext(min|max)[0-9]|size", re.I)
ORDER = "its axes are taken as x, y, z, the order of ndgrid; of meshgrid save permute(V, [2 1 3])"


def read_hdf5(request: Request) -> Volume:
    """Read ``FILE.h5:/DATASET``; without a name the only dataset of three axes."""
    datasets = _datasets_in(request)
    if (image := "/ITKImage/0/") + "VoxelData" in datasets:  # in LPS, with a direction a row
        spacing, origin, directions = (
            datasets[image + name][:] for name in ("Spacing", "Origin", "Directions")
        )
        world = triple(spacing[::-1]), triple(origin), directions.T[:, ::-1]
        return Volume(*_stored(datasets[image + "VoxelData"]), *world, space="LPS")
    shapes = {name: values.shape or () for name, values in datasets.items()}
    values = datasets[request.choose_array(shapes)]
    axes, beside = _axes(values), values.file.get(IMARIS, values).attrs
    place = placed(request, values.shape, values.attrs, axes)
    if not any(axis.name for axis in axes):
        order = ", ".join(place["axes"])
        place["notes"] += (f"its axes have no names: taken as {order} (--axes is another order)",)
    listed = ", ".join(sorted(str(name) for name in beside if SIZES.search(name)))
    if place["spacing"] is None and listed:
        place["notes"] += (f"{listed}: not read (give --spacing and --origin)",)
    return Volume(*_stored(values), **place)


def _datasets_in(request: Request) -> dict[str, Any]:
    """Return the datasets of a file by their paths, without links to other files."""
    import h5py

    file, names = request.files.enter_context(h5py.File(request.path, "r")), list[str]()
    file.visit(names.append)
    entries = {f"/{name}": file[name] for name in names}
    return {name: each for name, each in entries.items() if isinstance(each, h5py.Dataset)}


def _axes(values: Any) -> list[Axis]:
    """Return what a dataset says of its axes: by ``axistags``, as of ilastik, or scales."""
    tags = json.loads(values.attrs.get("axistags", "{}")).get("axes", ())
    if len(tags) == values.ndim:
        steps = (float(tag.get("resolution") or 0) or None for tag in tags)
        return [Axis(str(tag.get("key", "")), step=step) for tag, step in zip(tags, steps)]
    axes = []
    for dim, count in zip(values.dims, values.shape):
        scale = _check_own(dim[0]) if len(dim) else None
        name = dim.label or str(getattr(scale, "name", "")).rsplit("/", 1)[-1]
        axes.append(measured(name, count, scale))
    return axes


def _check_own(values: Any) -> Any:
    """Return a dataset; FileError if its numbers are in other files, which may be any."""
    if getattr(values, "is_virtual", False) or getattr(values, "external", None):
        raise FileError(f"the numbers of {values.name} are in other files: save them in this one")
    return values


def _stored(values: Any) -> tuple[Any, Any, Any]:
    """Return how a ``Volume`` loads a dataset, or an array."""
    return stored(_check_own(values), getattr(values, "attrs", {}))


def read_netcdf(request: Request) -> Volume:
    """Read ``FILE.nc:/VARIABLE``; without a name the only variable of three axes."""
    import h5py
    from scipy.io import netcdf_file

    if h5py.is_hdf5(request.path):
        return read_hdf5(request)
    variables = request.files.enter_context(netcdf_file(request.path, mmap=False)).variables
    shapes = {f"/{name}": values.shape for name, values in variables.items()}
    values = variables[request.choose_array(shapes)[1:]]
    scales = map(variables.get, values.dimensions)
    axes = list(map(measured, values.dimensions, values.shape, scales))
    place = placed(request, values.shape, values._attributes, axes)
    return Volume(*stored(values.data, values._attributes), **place)


def read_mat(request: Request) -> Volume:
    """Read ``FILE.mat:VARIABLE``; without a name the only array of three axes.

    Variables ``spacing``, ``origin`` and ``direction`` beside it are its place, as in ``.npz``. In
    files of version 7.3, which are HDF5, the axes of all are in reverse order.
    """
    import h5py
    from scipy.io import loadmat, whosmat

    if is_hdf5 := h5py.is_hdf5(request.path):
        found = {name[1:]: values for name, values in _datasets_in(request).items()}
        kinds = {name: each.attrs.get("MATLAB_class", b"").decode() for name, each in found.items()}
        listed = [(name, found[name].shape or (), kind) for name, kind in kinds.items()]
    else:
        listed = whosmat(request.path)
    shapes = {name: shape for name, shape, kind in listed if kind in NUMBERS and "/" not in name}
    name = request.choose_array(shapes)
    if not is_hdf5:  # planes of the last axis are contiguous
        loaded = loadmat(request.path, variable_names=[name, *PLACE])
        found = {key: loaded[key].T for key in (name, *PLACE) if key in loaded}
    stated = {key: _check_own(found[key])[()].T for key in PLACE if key in found}
    place = placed(request, found[name].shape, stated, order=request.axes[::-1])
    place["notes"] = (ORDER,) if request.axes == "xyz" else ()
    return Volume(*_stored(found[name]), **place)
