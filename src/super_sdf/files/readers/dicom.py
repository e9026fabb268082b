"""Folders of DICOM slices, with pydicom: one series, sorted by position; coordinates are LPS.

Only headers are read at first; a slice is unpacked when its plane is asked for.
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
from ..regular import check_beside
from ..volume import Request, Volume

EVEN = 0.01  # share of the spacing by which slices may be off
PARALLEL = 1e-4  # by which components of directions may differ


class Slice(NamedTuple):
    """A slice: a file and the frame in it, its place, and how its values are scaled.

    ``across``, (2, 3), has the directions of the axes along a row and along a column; ``spacing``
    is that of rows, and of columns; ``scale`` is slope and intercept.
    """

    path: Path
    frame: int
    shape: tuple[int, int]
    corner: NDArray[np.float64]
    across: NDArray[np.float64]
    spacing: tuple[float, float]
    scale: tuple[float, float]

    def read(self) -> NDArray[Any]:
        """Return its values as they are stored."""
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
    return Volume(shape, dtype, read, (step, *first.spacing), origin, direction)


def _series_in(folder: Path) -> dict[str, list[tuple[Path, Any]]]:
    """Return the images of a folder, headers only, by the UID of their series."""
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


def _slices(images: list[tuple[Path, Any]]) -> Iterator[Slice]:
    """Yield the slices of grey images, each of which may have several frames."""
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


def _slice(path: Path, index: int, header: Any, groups: list[Any]) -> Slice:
    """Return a frame of an image; what is stated of it is in the first group that has it."""
    corner = _stated(groups, "PlanePositionSequence", "ImagePositionPatient")
    across = _stated(groups, "PlaneOrientationSequence", "ImageOrientationPatient")
    steps = _stated(groups, "PixelMeasuresSequence", "PixelSpacing")
    if not (corner and across and steps):
        raise GridError(f"{path.name} states no place: it is no slice of a volume")
    slope, intercept = (
        _stated(groups, "PixelValueTransformationSequence", f"Rescale{name}")
        for name in ("Slope", "Intercept")
    )
    return Slice(
        *(path, index, (header.Rows, header.Columns), np.array(corner, np.float64)),
        np.array(across, np.float64).reshape(2, 3),
        (float(steps[0]), float(steps[1])),
        (1.0 if slope is None else float(slope), float(intercept or 0)),
    )


def _stated(groups: list[Any], sequence: str, name: str) -> Any:
    """Return an element of the first group that has it, in a sequence or plainly; else None."""
    among = (each for group in groups for each in (*group.get(sequence, ()), group))
    return next((each[name].value for each in among if name in each), None)


def _normal(each: Slice) -> NDArray[np.float64]:
    normal: NDArray[np.float64] = np.cross(*each.across)
    return normal


def _sorted(slices: list[Slice]) -> tuple[list[Slice], float]:
    """Return slices in the order of their places along their normal, and the step."""
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


def _check_steps(slices: list[Slice], steps: NDArray[np.float64], step: float) -> None:
    """Raise GridError unless slices follow one another in even steps."""
    if not len(steps):
        raise GridError(f"{slices[0].path.name} is its only slice: give the folder of a series")
    off = np.abs(steps - step)
    worst = int(off.argmax())
    nearest = int(steps.argmin())
    if steps[nearest] <= EVEN * step:
        raise GridError(
            f"{_named(slices, nearest)} are at one place: put the slices of one volume (one time, "
            "one echo) into a folder"
        )
    if off[worst] > EVEN * step:
        raise GridError(
            f"{_named(slices, worst)} are {steps[worst]:.6g} mm apart, others {step:.6g}: add the "
            "slices that are missing, or resample the series in even steps"
        )


def _named(slices: list[Slice], first: int) -> str:
    return f"{slices[first].path.name} and {slices[first + 1].path.name}"
