"""HDF5, NetCDF and MATLAB's files: an array of three axes, besides some of length 1.

HDF5 and what is made of it (NetCDF 4, MATLAB 7.3) with h5py, the others with SciPy. Axes are
(z, y, x) unless dimension labels, scales, ``axistags`` or ``--axes`` say otherwise.
"""

from __future__ import annotations

import json
import os
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError
from ...options import LPS
from ..regular import check_beside
from ..volume import PLACE, Box, Request, Volume, reversed_axes
from .axes import Axes, along, placed, unscaled, without_gaps

NO_COORDINATES = b"This is a netCDF dimension but not a netCDF variable"
INTEGERS = tuple(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))
NUMBERS = ("double", "single", "logical", *INTEGERS)  # of MATLAB
ORDER = (
    "its axes are taken as x, y, z, the order of ndgrid; of an array in the order of meshgrid, "
    "which is y, x, z, save permute(V, [2 1 3])"
)
Coordinates = tuple[NDArray[Any] | None, dict[str, Any]]


def read_hdf5(request: Request) -> Volume:
    """Read ``FILE.h5:/DATASET``; without a name the only dataset of three axes."""
    # HDF5 asks when it is loaded where raw data files are; this process reads no other file
    os.environ["HDF5_EXTFILE_PREFIX"] = str(request.path.absolute().parent)
    import h5py

    file = request.files.enter_context(h5py.File(request.path, "r"))
    names: list[str] = []
    asked = (request.member or "").strip("/")

    def note(name: str, entry: Any) -> None:
        if isinstance(entry, h5py.Dataset) and (name == asked or _may_be_grid(entry.shape)):
            names.append(f"/{name}")

    file.visititems(note)
    if "ITKImage" in file:  # in LPS, with a direction a row
        image = file["ITKImage/0"]
        values, space = image["VoxelData"], list(range(3))
        spacing, direction = reversed_axes(image["Spacing"][:], image["Directions"][:].T)
        origin = tuple(image["Origin"][:].tolist())
        place: dict[str, Any] = {"spacing": spacing, "origin": origin, "direction": direction}
        place["space"] = LPS
        _check_stored(values, request)
    else:
        values = file[request.choose(names, "3D dataset")]
        _check_stored(values, request)
        axes = _axes(values, request)
        space, place = placed(axes, dict(values.attrs), values.shape, request.axes)
    return _volume_of(values, space, place)


def read_netcdf(request: Request) -> Volume:
    """Read ``FILE.nc:/VARIABLE``; without a name the only variable of three axes."""
    import h5py

    return read_hdf5(request) if h5py.is_hdf5(request.path) else _read_classic(request)


def read_mat(request: Request) -> Volume:
    """Read ``FILE.mat:VARIABLE``; without a name the only array of three axes.

    Variables ``spacing``, ``origin`` and ``direction`` beside it are its place, as in ``.npz``.
    """
    import h5py

    return (_read_73 if h5py.is_hdf5(request.path) else _read_5)(request)


def _volume_of(values: Any, space: list[int], place: dict[str, Any]) -> Volume:
    def stored(box: Box) -> NDArray[Any]:
        return np.asarray(values[along(space, box, values.ndim)])

    absent = total = 0
    if values.chunks:
        total = prod(-(-size // chunk) for size, chunk in zip(values.shape, values.chunks))
        absent = total - values.id.get_num_chunks()
    whole = without_gaps(stored, absent, total, values.fillvalue)
    read_box, dtype = unscaled(whole, values.dtype, dict(values.attrs))
    return Volume(
        tuple(values.shape[axis] for axis in space),
        dtype,
        **place,
        chunks=tuple(values.chunks[axis] for axis in space) if values.chunks else None,
        read_box=read_box,
        packed=values.id.get_storage_size(),
    )


def _may_be_grid(shape: tuple[int, ...] | None) -> bool:
    return shape is not None and len(shape) >= 3 >= sum(count > 1 for count in shape)


def _axes(values: Any, request: Request) -> Axes:
    """Return what a dataset says of its axes: by ``axistags``, as of ilastik, or scales."""
    tags = json.loads(values.attrs.get("axistags", "{}")).get("axes", ())
    if len(tags) == values.ndim:
        keys = [str(tag.get("key", "")) for tag in tags]
        steps = tuple(float(tag.get("resolution") or 0) or None for tag in tags)
        return Axes.named(keys, steps=steps)
    scales = [dim[0] if len(dim) else None for dim in values.dims]
    names = [
        dim.label or ("" if scale is None else (scale.name or "").rsplit("/", 1)[-1])
        for dim, scale in zip(values.dims, scales)
    ]

    def coordinates(axis: int) -> Coordinates:
        scale: Any = scales[axis]
        if scale is None or scale.shape != (values.shape[axis],):
            return None, {}
        _check_stored(scale, request)
        about = dict(scale.attrs)
        return (None if NO_COORDINATES in bytes(about.get("NAME", b"")) else scale[:]), about

    return Axes.of_coordinates(names, values.shape, coordinates)


def _check_stored(values: Any, request: Request) -> None:
    """Raise FileError if the numbers of a dataset come from files that lie elsewhere."""
    if values.is_virtual:
        raise FileError(
            f"{request.path}:{values.name} is a virtual dataset, put together of others: save its "
            "values as a dataset of their own"
        )
    for raw, _, _ in values.external or ():
        check_beside(request.path, raw)


def _read_classic(request: Request) -> Volume:
    from scipy.io import netcdf_file

    variables = request.files.enter_context(netcdf_file(request.path, mmap=True)).variables
    names = [f"/{name}" for name, values in variables.items() if _may_be_grid(values.shape)]
    values = variables[request.choose(names, "variable of three axes")[1:]]
    about = vars(values)["_attributes"]

    def coordinates(axis: int) -> Coordinates:
        scale = variables.get(values.dimensions[axis])
        return (None, {}) if scale is None else (np.array(scale.data), vars(scale)["_attributes"])

    axes = Axes.of_coordinates(values.dimensions, values.shape, coordinates)
    space, place = placed(axes, about, values.shape, request.axes)

    def stored(box: Box) -> NDArray[Any]:
        samples: NDArray[Any] = values.data[along(space, box, len(values.shape))]
        return samples

    read_box, dtype = unscaled(stored, values.data.dtype, about)
    return Volume(tuple(values.shape[axis] for axis in space), dtype, read_box=read_box, **place)


def _read_5(request: Request) -> Volume:
    from scipy.io import loadmat, whosmat

    listed = whosmat(request.path)
    arrays = {name: shape for name, shape, kind in listed if len(shape) == 3 and kind in NUMBERS}
    name = request.choose(list(arrays), "array of three axes")
    request.check_loads(8 * prod(arrays[name]), "SciPy")
    variables = loadmat(request.path, variable_names=[name, *PLACE])
    values = variables[name].T  # planes of the last axis are contiguous
    stated = {key: variables[key] for key in PLACE if key in variables}
    _, place = _placed_of_mat(stated, values.shape, request)
    return Volume(values.shape, values.dtype, lambda first, last: values[first:last], **place)


def _read_73(request: Request) -> Volume:
    """Read a MATLAB file of version 7.3: the axes of its datasets are in reverse order."""
    import h5py

    file = request.files.enter_context(h5py.File(request.path, "r"))

    def is_array(name: str) -> bool:
        kind = file[name].attrs.get("MATLAB_class", b"")
        return kind in map(str.encode, NUMBERS) and len(file[name].shape) == 3

    names = [name for name in file if isinstance(file[name], h5py.Dataset) and is_array(name)]
    values = file[request.choose(names, "array of three axes")]
    _check_stored(values, request)
    stated = {key: np.transpose(file[key][()]) for key in PLACE if key in file}
    return _volume_of(values, *_placed_of_mat(stated, values.shape, request))


def _placed_of_mat(
    stated: dict[str, Any], shape: tuple[int, ...], request: Request
) -> tuple[list[int], dict[str, Any]]:
    space, place = placed(Axes.named([""] * 3), stated, shape, request.axes[::-1])
    return space, place | {"notes": (ORDER,) if request.axes == "xyz" else ()}
