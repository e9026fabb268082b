"""HDF5 files, with h5py: a dataset of three axes, besides some of length 1.

They are (z, y, x) unless dimension labels, scales, ``axistags`` or ``--axes`` say otherwise.
"""

from __future__ import annotations

import json
import os
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError
from ..boxes import Box
from ..regular import check_beside
from ..volume import Request, Volume, reversed_axes
from .axes import Axes
from .choosing import choose_member
from .stored import along, placed, unscaled, without_gaps

NO_COORDINATES = b"This is a netCDF dimension but not a netCDF variable"


def read_hdf5(request: Request) -> Volume:
    """Read ``FILE.h5:/DATASET``; without a name the only dataset of three axes."""
    # HDF5 asks when it is loaded where raw data files are; this process reads no other file
    os.environ["HDF5_EXTFILE_PREFIX"] = str(request.path.absolute().parent)
    import h5py

    file = request.files.enter_context(h5py.File(request.path, "r"))
    found: list[str] = []

    asked = (request.member or "").strip("/")

    def note(name: str, entry: Any) -> None:
        if isinstance(entry, h5py.Dataset) and (name == asked or may_be_grid(entry.shape)):
            found.append(f"/{name}")

    file.visititems(note)
    if "ITKImage" in file:
        return _read_itk(file, request)
    values = file[choose_member(request, found, "3D dataset")]
    check_stored(values, request)
    return volume_of(
        values, *placed(_axes(values, request), dict(values.attrs), values.shape, request.axes)
    )


def _read_itk(file: Any, request: Request) -> Volume:
    """Read an image that ITK wrote: in LPS, with a direction a row."""
    image = file["ITKImage/0"]
    check_stored(image["VoxelData"], request)
    spacing, direction = reversed_axes(image["Spacing"][:], image["Directions"][:].T)
    origin = tuple(image["Origin"][:].tolist())
    place = {"spacing": spacing, "origin": origin, "direction": direction}
    return volume_of(image["VoxelData"], list(range(3)), place)


def volume_of(values: Any, space: list[int], place: dict[str, Any]) -> Volume:
    """Return the volume of a dataset: its axes in space and their place; others have length 1."""
    shape = tuple(values.shape[axis] for axis in space)

    def stored(box: Box) -> NDArray[Any]:
        return np.asarray(values[along(space, box, values.ndim)])

    whole = without_gaps(stored, *_absent(values), values.fillvalue)
    read_box, dtype = unscaled(whole, values.dtype, dict(values.attrs))

    def read(first: int, last: int) -> NDArray[Any]:
        return read_box((slice(first, last), slice(0, shape[1]), slice(0, shape[2])))

    chunks = tuple(values.chunks[axis] for axis in space) if values.chunks else None
    about = {"chunks": chunks, "read_box": read_box, "packed": values.id.get_storage_size()}
    return Volume(shape, dtype, read, **place, **about)


def may_be_grid(shape: tuple[int, ...] | None) -> bool:
    """Return whether a dataset has three axes, besides some of length 1."""
    return shape is not None and len(shape) >= 3 >= sum(count > 1 for count in shape)


def _axes(values: Any, request: Request) -> Axes:
    """Return what a dataset says of its axes: by ``axistags``, as ilastik writes them, or scales.

    An axis has the name of its label, or of the first scale that is attached to it.
    """
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

    def coordinates(axis: int) -> tuple[NDArray[Any] | None, dict[str, Any]]:
        return _coordinates(scales[axis], values.shape[axis], request)

    return Axes.of_coordinates(names, values.shape, coordinates)


def _coordinates(
    scale: Any, count: int, request: Request
) -> tuple[NDArray[Any] | None, dict[str, Any]]:
    """Return the coordinates in a dimension scale, None if it has only a name, and attributes."""
    if scale is None or scale.shape != (count,):
        return None, {}
    check_stored(scale, request)
    about = dict(scale.attrs)
    return (None if NO_COORDINATES in bytes(about.get("NAME", b"")) else scale[:]), about


def check_stored(values: Any, request: Request) -> None:
    """Raise FileError if the numbers of a dataset come from files that lie elsewhere."""
    if values.is_virtual:
        raise FileError(
            f"{request.path}:{values.name} is a virtual dataset, put together of others: save its "
            "values as a dataset of their own"
        )
    for raw, _, _ in values.external or ():
        check_beside(request.path, raw)


def _absent(values: Any) -> tuple[int, int]:
    """Return how many chunks of a dataset are not stored, and how many it has."""
    if not values.chunks:
        return 0, 1
    total = prod(-(-size // chunk) for size, chunk in zip(values.shape, values.chunks))
    return total - values.id.get_num_chunks(), total
