"""NIfTI files, with nibabel: arrays (x, y, z), x fastest; world coordinates are RAS.

The extensions after the header are passed over: nibabel loads as much as they claim.
"""

from __future__ import annotations

import gzip
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from ..headers import ArrayHeader
from ..unpacking import PIECE
from ..volume import Request, Volume, from_affine, reversed_axes

HEADER = 348  # bytes
MOST_DEFLATED = 1100  # deflate reaches 1,030 on zeros


def read_nifti(request: Request) -> Volume:
    """Read a ``.nii`` or ``.nii.gz`` file.

    The affine is nibabel's: the sform if there is one, else the qform. Values are scaled by the
    slope and intercept of the header.
    """
    import nibabel

    size, is_packed = request.path.stat().st_size, request.path.suffix.lower() == ".gz"
    opened: Any = gzip.open if is_packed else open
    stream = request.files.enter_context(opened(request.path, "rb"))
    header = nibabel.Nifti1Header(stream.read(HEADER))
    shape, start = header.get_data_shape(), header.get_data_offset()
    proxy = nibabel.arrayproxy.ArrayProxy(stream, header, mmap=False)
    if len(shape) < 3 or any(size != 1 for size in shape[3:]):
        raise GridError(f"{request.path} has shape {shape}: give a file of three axes (x, y, z)")
    stored = ArrayHeader(shape, header.get_data_dtype(), True, start)
    if min(shape) < 1 or start + stored.size > size * (MOST_DEFLATED if is_packed else 1):
        raise FileError(
            f"{request.path} is truncated: its header promises {stored} from byte {start:,} on, "
            f"but the file has {size:,}"
        )
    rest = (0,) * (len(shape) - 3)

    def read(first: int, last: int) -> NDArray[Any]:
        planes = np.asarray(proxy[(..., slice(first, last), *rest)]).T
        if last == shape[2] and len(stream.read(PIECE)) == PIECE:  # gzip compares the checksum
            raise FileError(f"{request.path} goes on after the samples that its header promises")
        return planes

    spacing, origin, direction = from_affine(header.get_best_affine())
    spacing, direction = reversed_axes(spacing, direction)
    place, dtype = (spacing, origin, direction), read(0, 1).dtype
    return Volume(shape[2::-1], dtype, read, *place, packed=size if is_packed else None)
