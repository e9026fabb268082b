"""NIfTI files, with nibabel: arrays (x, y, z), x fastest; world coordinates are RAS.

The extensions after the header are passed over: nibabel loads as much as they claim.
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
from ..headers import ArrayHeader
from ..unpacking import PIECE
from ..volume import XYZ, Request, Volume, from_affine, reversed_axes

SIZES = 348, 540  # bytes of the headers of NIfTI-1 and NIfTI-2
UNITS = {1: "metre", 3: "micrometre"}  # of lengths, but for millimetres
ASTRAY = 0.1  # of a voxel: how far sform and qform may place a corner apart without a note
MOST_DEFLATED = 1100  # deflate reaches 1,030 on zeros


def read_nifti(request: Request) -> Volume:
    """Read a ``.nii`` or ``.nii.gz`` file, of NIfTI-1 or NIfTI-2.

    The affine is nibabel's: the sform if there is one, else the qform. Without both the axes of the
    array are x, y and z, as ITK and method 1 of the standard have it; nibabel mirrors x. Values are
    scaled by the slope and intercept of the header.
    """
    import nibabel

    stream = opened(request, request.path)
    header = _header(nibabel, stream)
    place, notes = place_of(header)
    return proxied(request.path, stream, header, place, notes)


def opened(request: Request, path: Path) -> Any:
    """Return the stream of a file, unpacked if its name says that it is packed with gzip."""
    way: Any = gzip.open if path.suffix.lower() in (".gz", ".mgz") else open
    return request.files.enter_context(way(path, "rb"))


def proxied(
    path: Path, stream: Any, header: Any, place: Any, notes: tuple[str, ...] = ()
) -> Volume:
    """Return the array that a header of nibabel describes, read from a stream.

    Parameters
    ----------
    path : path
        The file of the samples.
    stream, header
        That file, unpacked, and what nibabel made of the header.
    place : tuple
        Spacing, origin and direction of the axes x, y, z.
    notes : tuple of str
        What the file says of the place.
    """
    from nibabel.arrayproxy import ArrayProxy

    size, is_packed = path.stat().st_size, isinstance(stream, gzip.GzipFile)
    shape, start = tuple(map(int, header.get_data_shape())), int(header.get_data_offset())
    proxy = ArrayProxy(stream, header, mmap=False)
    if len(shape) < 3 or any(size != 1 for size in shape[3:]):
        raise GridError(f"{path} has shape {shape}: give a file of three axes (x, y, z)")
    stored = ArrayHeader(shape, header.get_data_dtype(), True, start)
    if min(shape) < 1 or start + stored.size > size * (MOST_DEFLATED if is_packed else 1):
        raise FileError(
            f"{path} is truncated: its header promises {stored} from byte {start:,} on, but the "
            f"file has {size:,}"
        )
    rest = (0,) * (len(shape) - 3)

    def read(first: int, last: int) -> NDArray[Any]:
        planes = np.asarray(proxy[(..., slice(first, last), *rest)]).T
        if last == shape[2] and len(stream.read(PIECE)) == PIECE:  # gzip compares the checksum
            raise FileError(f"{path} goes on after the samples that its header promises")
        return planes

    spacing, origin, direction = place
    spacing, direction = reversed_axes(spacing, direction)
    packed = size if is_packed else None
    return Volume(
        *(shape[2::-1], read(0, 1).dtype, read, spacing, origin, direction),
        packed=packed,
        notes=notes,
    )


def _header(nibabel: Any, stream: Any) -> Any:
    """Return the header of either version, in either order of bytes."""
    start = stream.read(SIZES[0])
    sizes = [int.from_bytes(start[:4], order) for order in ("little", "big")]
    if SIZES[1] in sizes:
        return nibabel.Nifti2Header(start + stream.read(SIZES[1] - SIZES[0]))
    return nibabel.Nifti1Header(start)


def place_of(header: Any) -> tuple[Any, tuple[str, ...]]:
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
