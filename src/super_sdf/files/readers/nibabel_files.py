"""FreeSurfer's and Analyze's files, with nibabel: arrays (x, y, z), x fastest.

FreeSurfer states the place, in RAS. Analyze states sizes and spacing only, and not which side is
left; a pair ``.hdr`` and ``.img`` of NIfTI states all.
"""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from ..headers import ArrayHeader
from ..regular import check_beside
from ..volume import XYZ, Request, Volume, from_affine, reversed_axes
from .nifti import HEADER, MOST_DEFLATED

HEADER_MGH = 284  # bytes
PAIRS = (".img", ".IMG", ".img.gz")
NO_PLACE = (
    "Analyze files state no place and not which side is left: x, y and z are taken as stored, from "
    "0 on"
)


def read_mgh(request: Request) -> Volume:
    """Read a ``.mgh`` or ``.mgz`` file of FreeSurfer."""
    from nibabel.freesurfer.mghformat import MGHHeader

    stream = _open(request, request.path, request.path.suffix.lower() == ".mgz")
    header = MGHHeader(stream.read(HEADER_MGH))
    return _volume(request.path, stream, header, from_affine(header.get_affine()))


def read_analyze(request: Request) -> Volume:
    """Read a ``.hdr`` file and the ``.img`` file beside it, of Analyze or NIfTI."""
    import nibabel

    head = request.path.read_bytes()[:HEADER]
    beside = [request.path.with_suffix(end) for end in PAIRS]
    path = next((other for other in beside if other.exists()), beside[0])
    path = check_beside(request.path, path.name)
    stream = _open(request, path, path.suffix == ".gz")
    if head[344:347] == b"ni1":
        pair = nibabel.nifti1.Nifti1PairHeader(head)
        return _volume(path, stream, pair, from_affine(pair.get_best_affine()))
    header = nibabel.Spm2AnalyzeHeader(head)
    spacing = tuple(float(step) for step in header.get_zooms()[:3])
    return _volume(path, stream, header, (spacing, None, XYZ), (NO_PLACE,))


def _open(request: Request, path: Path, is_packed: bool) -> Any:
    """Return the stream of a file, unpacked."""
    opened: Any = gzip.open if is_packed else open
    return request.files.enter_context(opened(path, "rb"))


def _volume(
    path: Path, stream: Any, header: Any, place: tuple[Any, Any, Any], notes: tuple[str, ...] = ()
) -> Volume:
    """Return the array that a header of nibabel describes, read from a stream."""
    from nibabel.arrayproxy import ArrayProxy

    shape, start = header.get_data_shape(), int(header.get_data_offset())
    if len(shape) < 3 or any(size != 1 for size in shape[3:]):
        raise GridError(f"{path} has shape {shape}: give a file of three axes (x, y, z)")
    stored, size = ArrayHeader(shape, header.get_data_dtype(), True, start), path.stat().st_size
    is_packed = isinstance(stream, gzip.GzipFile)
    if min(shape) < 1 or start + stored.size > size * (MOST_DEFLATED if is_packed else 1):
        raise FileError(
            f"{path} is truncated: its header promises {stored} from byte {start:,} on, but the "
            f"file has {size:,}"
        )
    proxy, rest = ArrayProxy(stream, header, mmap=False), (0,) * (len(shape) - 3)

    def read(first: int, last: int) -> NDArray[Any]:
        planes = np.asarray(proxy[(..., slice(first, last), *rest)]).T
        if last == shape[2] and is_packed:  # the checksum is compared at the end
            while stream.read(1 << 20):
                pass
        return planes

    spacing, origin, direction = place
    spacing, direction = reversed_axes(spacing, direction)
    about: dict[str, Any] = {"notes": notes, "packed": size if is_packed else None}
    return Volume(shape[2::-1], read(0, 1).dtype, read, spacing, origin, direction, **about)
