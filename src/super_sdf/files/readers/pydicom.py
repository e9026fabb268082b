"""Folders of DICOM slices, with pydicom: one series, sorted by position; coordinates are LPS.

Not with SimpleITK, which reads the frames of an enhanced image in the order of the file and without
a place, and takes missing slices for evenly spaced ones.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import GridError
from ...options import LPS
from ..regular import check_beside
from ..volume import Request, Volume, triple

EVEN = 0.01  # share of the spacing by which slices may be off
PARALLEL = 1e-4  # by which components of directions may differ


class _Slice(NamedTuple):
    """A slice: a file and the frame in it, its place, and how its values are scaled."""

    path: Path
    frame: int
    shape: tuple[int, int]
    corner: NDArray[np.float64]
    across: NDArray[np.float64]  # world directions along a row and down a column
    spacing: NDArray[np.float64]  # of rows and of columns
    scale: tuple[float, float]

    def read(self) -> NDArray[Any]:
        from pydicom.pixels.utils import pixel_array

        return np.asarray(pixel_array(self.path, index=self.frame))


def read_dicom(request: Request) -> Volume:
    """Read ``FOLDER``, or ``FOLDER:SERIES`` by the UID of one of several series.

    The slices must have one size, spacing and direction, and lie in even steps.
    """
    import pydicom

    series: dict[str, list[tuple[Path, Any]]] = {}
    for name in sorted(os.listdir(request.path)):
        if (request.path / name).is_file():
            path = check_beside(request.path, name)
            with suppress(pydicom.errors.InvalidDicomError):
                header = pydicom.dcmread(path, stop_before_pixels=True)
                if "Rows" in header:
                    uid = str(header.get("SeriesInstanceUID", ""))
                    series.setdefault(uid, []).append((path, header))
    slices = list(_slices(series[request.choose(list(series), "series of DICOM images")]))
    first = slices[0]
    normal = np.cross(*first.across)
    slices.sort(key=lambda each: float(each.corner @ normal))
    for each in slices:
        same = each.shape == first.shape and np.allclose(each.spacing, first.spacing, rtol=1e-4)
        if not same or not np.allclose(each.across, first.across, atol=PARALLEL):
            said = f"{each.path.name} has another size, spacing or direction than {first.path.name}"
            raise GridError(f"{said}: put the slices of one volume into a folder")
    if len(slices) == 1:
        raise GridError(f"{first.path.name} is its only slice: give the folder of a series")
    corners = np.array([each.corner for each in slices])
    shift = (corners[-1] - corners[0]) / (len(slices) - 1)
    off = np.linalg.norm(corners - corners[0] - np.outer(np.arange(len(slices)), shift), axis=1)
    step = float(np.linalg.norm(shift))
    if not off.max() < EVEN * step:
        raise GridError(
            f"{slices[int(off.argmax())].path.name} is {off.max():.4g} mm off from even steps of "
            f"{step:.6g}: put all slices of one volume (one time, one echo) into a folder, or "
            "resample the series"
        )
    scales = np.array([each.scale for each in slices])
    is_plain, is_whole = (scales == (1, 0)).all(), (scales == np.rint(scales)).all()
    dtype = slices[0].read().dtype if is_plain else np.dtype(np.int32 if is_whole else np.float32)

    def load() -> NDArray[Any]:
        planes = np.empty((len(slices), *first.shape), dtype)
        for plane, each in zip(planes, slices):
            plane[:] = each.read() if is_plain else each.read() * each.scale[0] + each.scale[1]
        return planes.T

    direction = np.column_stack([*first.across, shift / step])
    spacing = triple((*first.spacing[::-1], step))
    shape = (*first.shape[::-1], len(slices))
    return Volume(load, shape, dtype, spacing, triple(corners[0]), direction, space=LPS)


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
            groups = [frame, *shared, header]
            corner = _stated(groups, "PlanePositionSequence", "ImagePositionPatient")
            across = _stated(groups, "PlaneOrientationSequence", "ImageOrientationPatient")
            steps = _stated(groups, "PixelMeasuresSequence", "PixelSpacing")
            if not (corner and across and steps):
                raise GridError(f"{path.name} states no place: it is no slice of a volume")
            slope, intercept = (
                _stated(groups, "PixelValueTransformationSequence", f"Rescale{name}")
                for name in ("Slope", "Intercept")
            )
            place = (np.array(numbers, np.float64) for numbers in (corner, across, steps))
            corner, across, steps = place
            scale = (1.0 if slope is None else float(slope), float(intercept or 0))
            shape = (header.Rows, header.Columns)
            yield _Slice(path, index, shape, corner, across.reshape(2, 3), steps, scale)


def _stated(groups: list[Any], sequence: str, name: str) -> Any:
    """Return an element of the first group that has it, in a sequence or plainly; else None."""
    among = (each for group in groups for each in (*group.get(sequence, ()), group))
    return next((each[name].value for each in among if name in each), None)
