"""HDF5, and what is made of it: NetCDF 4 and MATLAB 7.3; an array of three axes.

Axes are (z, y, x) unless dimension labels, scales, ``axistags`` or ``--axes`` say otherwise.
"""

from __future__ import annotations

import json
import os
from math import prod
from typing import Any

import numpy as np

from ...errors import FileError
from ...options import LPS
from ..regular import check_beside
from ..volume import PLACE, Request, Volume, triple
from .axes import Axis, measured, placed, values_of

NO_COORDINATES = b"This is a netCDF dimension but not a netCDF variable"


def read_hdf5(request: Request) -> Volume:
    """Read ``FILE.h5:/DATASET``; without a name the only dataset of three axes."""
    import h5py

    file = request.files.enter_context(h5py.File(request.path, "r"))
    names: list[str] = []
    asked = (request.member or "").strip("/")

    def note(name: str, entry: Any) -> None:
        if isinstance(entry, h5py.Dataset) and (name == asked or may_be_grid(entry.shape)):
            names.append(f"/{name}")

    file.visititems(note)
    if "ITKImage" in file:  # in LPS, with a direction a row
        image = file["ITKImage/0"]
        place: dict[str, Any] = {
            "spacing": triple(image["Spacing"][:][::-1]),
            "origin": triple(image["Origin"]),
            "direction": image["Directions"][:].T[:, ::-1],
            "space": LPS,
        }
        return _volume_of(request, image["VoxelData"], place)
    values = file[request.choose(names, "3D dataset")]
    axes = _axes(values)
    place = placed(axes, dict(values.attrs), values.shape, request.axes)
    return _volume_of(request, values, place)


def read_mat_73(request: Request, numbers: tuple[str, ...], place: Any) -> Volume:
    """Read a MATLAB file of version 7.3: the axes of its datasets are in reverse order."""
    import h5py

    file = request.files.enter_context(h5py.File(request.path, "r"))
    kinds = [each.encode() for each in numbers]
    names = [
        name
        for name, entry in file.items()
        if isinstance(entry, h5py.Dataset)
        and len(entry.shape or ()) == 3
        and entry.attrs.get("MATLAB_class", b"") in kinds
    ]
    values = file[request.choose(names, "array of three axes")]
    stated = {key: np.transpose(file[key][()]) for key in PLACE if key in file}
    return _volume_of(request, values, place(stated, values.shape))


def may_be_grid(shape: tuple[int, ...] | None) -> bool:
    """Return whether an array has three axes, besides some of length 1."""
    return shape is not None and len(shape) >= 3 >= sum(count > 1 for count in shape)


def _axes(values: Any) -> list[Axis]:
    """Return what a dataset says of its axes: by ``axistags``, as of ilastik, or scales."""
    tags = json.loads(values.attrs.get("axistags", "{}")).get("axes", ())
    if len(tags) == values.ndim:
        return [
            Axis(str(tag.get("key", "")), step=float(tag.get("resolution") or 0) or None)
            for tag in tags
        ]
    axes = []
    for dim, count in zip(values.dims, values.shape):
        scale = dim[0] if len(dim) else None
        name = dim.label or ("" if scale is None else (scale.name or "").rsplit("/", 1)[-1])
        places, about = None, {}
        if scale is not None and scale.shape == (count,):
            about = dict(scale.attrs)
            if scale.is_virtual or scale.external:
                raise FileError(f"its coordinates {scale.name} are in another file: store them")
            if NO_COORDINATES not in bytes(about.get("NAME", b"")):
                places = scale[:]
        axes.append(measured(name, places, about))
    return axes


def _volume_of(request: Request, values: Any, place: dict[str, Any]) -> Volume:
    """Return a dataset whose raw data may be in files beside its own; FileError if elsewhere."""
    import h5py

    if values.is_virtual:
        raise FileError(
            f"{request.path}:{values.name} is a virtual dataset, put together of others: save its "
            "values as a dataset of their own"
        )
    absent = total = 0
    if values.chunks:
        total = prod(-(-size // chunk) for size, chunk in zip(values.shape, values.chunks))
        absent = total - values.id.get_num_chunks()
    about = dict(values.attrs)
    said = values_of(values.dtype, about, None, absent, total, values.fillvalue)
    for raw, _, _ in values.external or ():
        check_beside(request.path, raw)
    if values.external:  # HDF5 takes their names from the current folder, unless told otherwise
        access = h5py.h5p.create(h5py.h5p.DATASET_ACCESS)
        access.set_efile_prefix(os.fsencode(request.path.absolute().parent))
        file, name = values.file.id, values.name.encode()
        values.id.close()
        values = h5py.Dataset(h5py.h5d.open(file, name, access))
    return Volume(values, **place, **said)
