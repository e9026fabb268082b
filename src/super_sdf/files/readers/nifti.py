"""NIfTI files, with nibabel: arrays (x, y, z), x fastest; world coordinates are RAS."""

from __future__ import annotations

import gzip
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import GridError
from ..unpacking import PIECE
from ..volume import Request, Volume, from_affine, reversed_axes


def read_nifti(request: Request) -> Volume:
    """Read a ``.nii`` or ``.nii.gz`` file.

    The affine is nibabel's: the sform if there is one, else the qform. Values are scaled by the
    slope and intercept of the header.
    """
    import nibabel

    is_packed = request.path.suffix.lower() == ".gz"
    opened: Any = gzip.open if is_packed else open
    stream = request.files.enter_context(opened(request.path, "rb"))
    holder = nibabel.FileHolder(fileobj=stream)
    image = nibabel.Nifti1Image.from_file_map({"header": holder, "image": holder}, mmap=False)
    proxy, shape = image.dataobj, image.shape
    if len(shape) < 3 or any(size != 1 for size in shape[3:]):
        raise GridError(f"{request.path} has shape {shape}: give a file of three axes (x, y, z)")
    rest = (0,) * (len(shape) - 3)

    def read(first: int, last: int) -> NDArray[Any]:
        planes = np.asarray(proxy[(..., slice(first, last), *rest)]).T
        while last == shape[2] and stream.read(PIECE):
            pass  # at its end gzip compares the checksum
        return planes

    spacing, origin, direction = from_affine(image.affine)
    spacing, direction = reversed_axes(spacing, direction)
    return Volume(shape[2::-1], read(0, 1).dtype, read, spacing, origin, direction)
