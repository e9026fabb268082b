"""HDF5 files, with h5py: a dataset of three axes, (z, y, x) unless ``--axes`` says otherwise."""

from __future__ import annotations

import os
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError
from ..regular import check_beside
from ..volume import Request, Volume
from .choosing import choose_member
from .stored import place_of, without_gaps


def read_hdf5(request: Request) -> Volume:
    """Read ``FILE.h5:/DATASET``; without a name the only dataset of three axes."""
    # HDF5 asks when it is loaded where raw data files are; this process reads no other file
    os.environ["HDF5_EXTFILE_PREFIX"] = str(request.path.absolute().parent)
    import h5py

    file = request.files.enter_context(h5py.File(request.path, "r"))
    found: list[str] = []

    def note(name: str, entry: Any) -> None:
        if isinstance(entry, h5py.Dataset) and (entry.ndim == 3 or name == request.member):
            found.append(f"/{name}")

    file.visititems(note)
    values = _open(file, choose_member(request, found, "3D dataset"), request)
    read_box = without_gaps(values.__getitem__, *_absent(values), values.fillvalue)

    def read(first: int, last: int) -> NDArray[Any]:
        return np.asarray(read_box((slice(first, last), slice(None), slice(None))))

    place = place_of(dict(values.attrs), request.axes)
    about = {"chunks": values.chunks, "read_box": read_box, "packed": values.id.get_storage_size()}
    return Volume(values.shape, values.dtype, read, *place, **about)


def _open(file: Any, name: str, request: Request) -> Any:
    """Return a dataset whose raw data files, if there are any, lie beside the file."""
    values = file[name]
    if values.is_virtual:
        raise FileError(
            f"{request.path}:{name} is a virtual dataset, put together of others: save its values "
            "as a dataset of their own"
        )
    for raw, _, _ in values.external or ():
        check_beside(request.path, raw)
    return values


def _absent(values: Any) -> tuple[int, int]:
    """Return how many chunks of a dataset are not stored, and how many it has."""
    if not values.chunks:
        return 0, 1
    total = prod(-(-size // chunk) for size, chunk in zip(values.shape, values.chunks))
    return total - values.id.get_num_chunks(), total
