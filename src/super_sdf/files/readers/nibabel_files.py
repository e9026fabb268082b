"""NIfTI, FreeSurfer and Analyze files, with nibabel: arrays (x, y, z), x fastest.

World coordinates are RAS. Analyze states sizes and spacing only, and not which side is left; a pair
``.hdr`` and ``.img`` of NIfTI states all. The extensions after the header of NIfTI are passed over:
nibabel loads as much as they claim.
"""

from __future__ import annotations

import gzip
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from ..regular import check_beside
from ..unpacking import PIECE
from ..volume import XYZ, Request, Volume, from_affine, in_words_of, reversed_axes

SIZES = 348, 540  # bytes of the headers of NIfTI-1 and NIfTI-2
HEADER_MGH = 284  # bytes
PAIRS = (".img", ".IMG", ".img.gz")
UNITS = {1: "metre", 3: "micrometre"}  # of lengths, but for millimetres
ASTRAY = 0.1  # of a voxel: how far sform and qform may place a corner apart without a note
MOST_DEFLATED = 1100  # deflate reaches 1,030 on zeros
NO_PLACE = (
    "Analyze files state no place and not which side is left: x, y and z are taken as stored, from "
    "0 on"
)


def read_nifti(request: Request) -> Volume:
    """Read a ``.nii`` or ``.nii.gz`` file, of NIfTI-1 or NIfTI-2.

    The affine is nibabel's: the sform if there is one, else the qform. Without both the axes of the
    array are x, y and z, as ITK and method 1 of the standard have it; nibabel mirrors x. Values are
    scaled by the slope and intercept of the header.
    """
    import nibabel

    stream = _opened(request, request.path)
    start = stream.read(SIZES[0])
    if SIZES[1] in [int.from_bytes(start[:4], order) for order in ("little", "big")]:
        header: Any = nibabel.Nifti2Header(start + stream.read(SIZES[1] - SIZES[0]))
    else:
        header = nibabel.Nifti1Header(start)
    return _proxied(request.path, stream, header, *_place_of(header))


def read_mgh(request: Request) -> Volume:
    """Read a ``.mgh`` or ``.mgz`` file of FreeSurfer."""
    from nibabel.freesurfer.mghformat import MGHHeader

    stream = _opened(request, request.path)
    header = MGHHeader(stream.read(HEADER_MGH))
    return _proxied(request.path, stream, header, from_affine(header.get_affine()))


def read_analyze(request: Request) -> Volume:
    """Read a ``.hdr`` file and the ``.img`` file beside it, of Analyze or NIfTI."""
    import nibabel

    with request.path.open("rb") as file:
        head = file.read(SIZES[0])
    beside = [request.path.with_suffix(end) for end in PAIRS]
    path = next((other for other in beside if other.exists()), beside[0])
    stream = _opened(request, check_beside(request.path, path.name))
    if head[344:347] == b"ni1":
        pair = nibabel.nifti1.Nifti1PairHeader(head)
        return _proxied(path, stream, pair, *_place_of(pair))
    header = nibabel.Spm2AnalyzeHeader(head)
    place = (header.get_zooms()[:3], None, XYZ)
    return _proxied(path, stream, header, place, (NO_PLACE,))


def _opened(request: Request, path: Path) -> Any:
    """Return the stream of a file, unpacked if its name says that it is packed with gzip."""
    way: Any = gzip.open if path.suffix.lower() in (".gz", ".mgz") else open
    return request.files.enter_context(way(path, "rb"))


def _proxied(
    path: Path, stream: Any, header: Any, place: Any, notes: tuple[str, ...] = ()
) -> Volume:
    """Return the array that a header of nibabel describes; ``place`` is that of x, y and z."""
    from nibabel.arrayproxy import ArrayProxy

    size, is_packed = path.stat().st_size, isinstance(stream, gzip.GzipFile)
    shape, start = tuple(map(int, header.get_data_shape())), int(header.get_data_offset())
    proxy, dtype = ArrayProxy(stream, header, mmap=False), header.get_data_dtype()
    if len(shape) < 3 or any(size != 1 for size in shape[3:]):
        raise GridError(f"{path} has shape {shape}: give a file of three axes (x, y, z)")
    end = start + int(np.prod(shape, dtype=object)) * dtype.itemsize
    if min(shape) < 1 or end > size * (MOST_DEFLATED if is_packed else 1):
        raise FileError(
            f"{path} is truncated: its header promises {in_words_of(shape, dtype)} from byte "
            f"{start:,} on, but the file has {size:,}"
        )
    rest = (0,) * (len(shape) - 3)

    def read(first: int, last: int) -> NDArray[Any]:
        planes = np.asarray(proxy[(..., slice(first, last), *rest)]).T
        if last == shape[2] and len(stream.read(PIECE)) == PIECE:  # gzip compares the checksum
            raise FileError(f"{path} goes on after the samples that its header promises")
        return planes

    spacing, origin, direction = place
    spacing, direction = reversed_axes(spacing, direction)
    return Volume(
        *(shape[2::-1], read(0, 1).dtype, read, spacing, origin, direction),
        packed=size if is_packed else None,
        notes=notes,
    )


def _place_of(header: Any) -> tuple[Any, tuple[str, ...]]:
    """Return spacing, origin and direction of the axes x, y, z, and notes on what was chosen."""
    unit = UNITS.get(int(header["xyzt_units"]) & 7)
    notes: tuple[str, ...] = ()
    if unit:
        notes = (f"lengths are in the unit that it states, {unit}",)
    codes = int(header["sform_code"]), int(header["qform_code"])
    if codes == (0, 0):
        said = (
            "it states no place (sform_code and qform_code are 0): its axes are taken as x, y and "
            "z, as ITK does; nibabel would mirror x"
        )
        return (np.abs(header.get_zooms()[:3]), None, XYZ), (*notes, said)
    if min(codes) > 0:
        sizes = header.get_data_shape()[:3]
        corners = np.array(list(product(*((0, size - 1) for size in sizes), [1])))
        off = 0.0
        with suppress(ValueError):  # if the qform is no rotation
            off = np.abs(corners @ (header.get_sform() - header.get_qform()).T).max()
        if off > ASTRAY * min(header.get_zooms()[:3]):
            notes += (
                f"its sform (code {codes[0]}) and qform (code {codes[1]}) place a corner {off:.3g} "
                "apart: the sform is taken, as nibabel does; ITK may take the qform",
            )
    return from_affine(header.get_best_affine()), notes
