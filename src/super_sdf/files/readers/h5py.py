"""HDF5, and what is made of it: NetCDF 4 and MATLAB 7.3; an array of three axes.

Axes are (z, y, x) unless dimension labels, scales, ``axistags`` or ``--axes`` say otherwise.
"""

from __future__ import annotations

import json
from math import prod
from typing import Any

from ...errors import FileError
from ...options import LPS
from ..volume import Request, Volume, triple
from .axes import Axis, measured, placed, stored

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
        return volume_of(image["VoxelData"], place)
    values = file[request.choose(names, "3D dataset")]
    return volume_of(values, placed(_axes(values), dict(values.attrs), values.shape, request.axes))


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
            check_own(scale)
            if NO_COORDINATES not in bytes(about.get("NAME", b"")):
                places = scale[:]
        axes.append(measured(name, places, about))
    return axes


def check_own(values: Any) -> None:
    """Raise FileError if the numbers of a dataset are in other files, which may be any."""
    if values.is_virtual or values.external:
        raise FileError(f"the numbers of {values.name} are in other files: save them in this one")


def volume_of(values: Any, place: dict[str, Any]) -> Volume:
    """Return a dataset at its place."""
    check_own(values)
    absent, about = 0, {}
    if values.chunks:
        about = {"chunks": list(values.chunks)}
        total = prod(-(-size // chunk) for size, chunk in zip(values.shape, values.chunks))
        absent = total - values.id.get_num_chunks()
    numbers = stored(values, dict(values.attrs), absent=absent, fill=values.fillvalue)
    return Volume(*numbers, **place, about=about)
