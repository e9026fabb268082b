"""HDF5 files, with h5py: a dataset of three axes, (z, y, x) unless ``--axes`` says otherwise."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..volume import Request, Volume
from .choosing import choose_member
from .stored import place_of


def read_hdf5(request: Request) -> Volume:
    """Read ``FILE.h5:/DATASET``; without a name the only dataset of three axes."""
    import h5py

    file = request.files.enter_context(h5py.File(request.path, "r"))
    found: list[str] = []

    def note(name: str, entry: Any) -> None:
        if isinstance(entry, h5py.Dataset) and (entry.ndim == 3 or name == request.member):
            found.append(f"/{name}")

    file.visititems(note)
    values = file[choose_member(request, found, "3D dataset")]

    def read(first: int, last: int) -> NDArray[Any]:
        return np.asarray(values[first:last])

    place = place_of(dict(values.attrs), request.axes)
    chunked = {"chunks": values.chunks, "read_box": values.__getitem__} if values.chunks else {}
    return Volume(values.shape, values.dtype, read, *place, **chunked)
