"""NIfTI, FreeSurfer and Analyze files, with nibabel, and folders of DICOM slices, with pydicom.

Arrays of nibabel are (x, y, z), x fastest, and world coordinates RAS. Analyze states sizes and
spacing only, and not which side is left; a pair ``.hdr`` and ``.img`` of NIfTI states all. The
extensions after the header of NIfTI are passed over: nibabel loads as much as they claim.

Of DICOM it is one series, sorted by position; coordinates are LPS. Only headers are read at first;
a slice is unpacked when its plane is asked for.
"""

from __future__ import annotations

import gzip
import os
from collections.abc import Iterator
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from ...options import LPS, RAS
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
    return _proxied(request.path, stream, header, from_affine(header.get_affine()), (), RAS)


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
    way: Any = gzip.open if path.suffix.lower() in (".gz", ".mgz") else open
    return request.files.enter_context(way(path, "rb"))


def _proxied(
    path: Path,
    stream: Any,
    header: Any,
    place: Any,
    notes: tuple[str, ...] = (),
    space: str | None = None,
) -> Volume:
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
        space=space,
    )


def _place_of(header: Any) -> tuple[Any, tuple[str, ...], str | None]:
    """Return the place of the axes x, y, z, notes on what was chosen, and the space if known."""
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
        return (np.abs(header.get_zooms()[:3]), None, XYZ), (*notes, said), None
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
    return from_affine(header.get_best_affine()), notes, RAS


# DICOM

EVEN = 0.01  # share of the spacing by which slices may be off
PARALLEL = 1e-4  # by which components of directions may differ


class _Slice(NamedTuple):
    """A slice: a file and the frame in it, its place, and how its values are scaled."""

    path: Path
    frame: int
    shape: tuple[int, int]
    corner: NDArray[np.float64]
    across: NDArray[np.float64]
    spacing: tuple[float, float]
    scale: tuple[float, float]

    def read(self) -> NDArray[Any]:
        from pydicom.pixels.utils import pixel_array

        return np.asarray(pixel_array(self.path, index=self.frame))


def read_dicom(request: Request) -> Volume:
    """Read ``FOLDER``, or ``FOLDER:SERIES`` by the UID of one of several series."""
    series = _series_in(request.path)
    uid = request.choose(list(series), "series of DICOM images")
    slices, step = _sorted(list(_slices(series[uid])))
    first = slices[0]
    scales = np.array([each.scale for each in slices])
    is_plain, is_whole = (scales == (1, 0)).all(), (scales == np.rint(scales)).all()
    dtype = first.read().dtype if is_plain else np.dtype(np.int32 if is_whole else np.float32)

    def read(start: int, stop: int) -> NDArray[Any]:
        planes = np.stack([each.read() for each in slices[start:stop]])
        if not is_plain:
            slopes, intercepts = scales[start:stop].T[..., None, None]
            planes = planes * slopes + intercepts
        return planes.astype(dtype, copy=False)

    row, column = first.across
    direction = np.column_stack([_normal(first), column, row])
    shape, origin = (len(slices), *first.shape), tuple(first.corner.tolist())
    return Volume(shape, dtype, read, (step, *first.spacing), origin, direction, space=LPS)


def _series_in(folder: Path) -> dict[str, list[tuple[Path, Any]]]:
    import pydicom

    series: dict[str, list[tuple[Path, Any]]] = {}
    for name in sorted(os.listdir(folder)):
        if not (folder / name).is_file():
            continue
        path = check_beside(folder, name)
        with suppress(pydicom.errors.InvalidDicomError):
            header = pydicom.dcmread(path, stop_before_pixels=True)
            if "Rows" in header:
                uid = str(header.get("SeriesInstanceUID", ""))
                series.setdefault(uid, []).append((path, header))
    return series


def _slices(images: list[tuple[Path, Any]]) -> Iterator[_Slice]:
    for path, header in images:
        if header.get("SamplesPerPixel", 1) != 1 or "ModalityLUTSequence" in header:
            raise GridError(f"{path.name} has colours or a table of values: give grey images")
        frames = header.get("PerFrameFunctionalGroupsSequence") or [header]
        if len(frames) != int(header.get("NumberOfFrames") or 1):
            raise GridError(
                f"{path.name} has {header.NumberOfFrames} frames without a place each: save it as "
                "an enhanced image, or as NIfTI"
            )
        shared = list(header.get("SharedFunctionalGroupsSequence") or ())
        for index, frame in enumerate(frames):
            yield _slice(path, index, header, [frame, *shared, header])


def _slice(path: Path, index: int, header: Any, groups: list[Any]) -> _Slice:
    corner = _stated(groups, "PlanePositionSequence", "ImagePositionPatient")
    across = _stated(groups, "PlaneOrientationSequence", "ImageOrientationPatient")
    steps = _stated(groups, "PixelMeasuresSequence", "PixelSpacing")
    if not (corner and across and steps):
        raise GridError(f"{path.name} states no place: it is no slice of a volume")
    slope, intercept = (
        _stated(groups, "PixelValueTransformationSequence", f"Rescale{name}")
        for name in ("Slope", "Intercept")
    )
    return _Slice(
        *(path, index, (header.Rows, header.Columns), np.array(corner, np.float64)),
        np.array(across, np.float64).reshape(2, 3),
        (float(steps[0]), float(steps[1])),
        (1.0 if slope is None else float(slope), float(intercept or 0)),
    )


def _stated(groups: list[Any], sequence: str, name: str) -> Any:
    """Return an element of the first group that has it, in a sequence or plainly; else None."""
    among = (each for group in groups for each in (*group.get(sequence, ()), group))
    return next((each[name].value for each in among if name in each), None)


def _normal(each: _Slice) -> NDArray[np.float64]:
    normal: NDArray[np.float64] = np.cross(*each.across)
    return normal


def _sorted(slices: list[_Slice]) -> tuple[list[_Slice], float]:
    first = slices[0]
    normal = _normal(first)
    slices = sorted(slices, key=lambda each: float(each.corner @ normal))
    corners = np.array([each.corner for each in slices])
    for each in slices:
        same = each.shape == first.shape and np.allclose(each.spacing, first.spacing, rtol=1e-4)
        if not same or not np.allclose(each.across, first.across, atol=PARALLEL):
            raise GridError(
                f"{each.path.name} has another size, spacing or direction than {first.path.name}: "
                "put the slices of one volume into a folder"
            )
    heights = corners @ normal
    steps = np.diff(heights)
    step = float(np.median(steps)) if len(steps) else 0.0
    _check_steps(slices, steps, step)
    step = float(heights[-1] - heights[0]) / len(steps)
    shift = corners - corners[0]
    aside = np.linalg.norm(shift - np.outer(shift @ normal, normal), axis=1).max()
    if aside > EVEN * min(step, *first.spacing) * len(steps):
        raise GridError(
            f"its slices lie up to {aside:.4g} mm beside one another, as with a tilted gantry: "
            "resample them on a grid with right angles"
        )
    return slices, step


def _check_steps(slices: list[_Slice], steps: NDArray[np.float64], step: float) -> None:
    if not len(steps):
        raise GridError(f"{slices[0].path.name} is its only slice: give the folder of a series")
    off = np.abs(steps - step)
    worst, nearest = int(off.argmax()), int(steps.argmin())
    names = [each.path.name for each in slices]
    if steps[nearest] <= EVEN * step:
        raise GridError(
            f"{names[nearest]} and {names[nearest + 1]} are at one place: put the slices of one "
            "volume (one time, one echo) into a folder"
        )
    if off[worst] > EVEN * step:
        raise GridError(
            f"{names[worst]} and {names[worst + 1]} are {steps[worst]:.6g} mm apart, others "
            f"{step:.6g}: add the slices that are missing, or resample the series in even steps"
        )
