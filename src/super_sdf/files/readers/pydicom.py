"""DICOM images and segmentations, with pydicom; coordinates are LPS.

Not with SimpleITK, which reads the frames of an enhanced image in the order of the file and without
a place, and takes missing slices for evenly spaced ones.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from ...options import LPS
from ..formats import check_beside
from . import DENSITY, LABELS, MOST_NAMED, Index, Names, Request, Volume, triple

EVEN = 0.01  # share of the spacing by which slices may be off
PARALLEL = 1e-4  # by which components of directions may differ
PREAMBLE = 128  # bytes before the mark DICM, mostly 0
BEYOND = 2  # empty slices on both sides of those that a segmentation stores
BITS, LABEL_MAP = "1.2.840.10008.5.1.4.1.1.66.4", "1.2.840.10008.5.1.4.1.1.66.7"
"""The two classes of segmentations: a frame is of one segment, or holds the numbers of all."""
Image = tuple[Path, Any]  # a file and its header


class _Slice(NamedTuple):
    """A slice: a file and the frame in it, its place, and how its values are scaled."""

    path: Path
    frame: int
    shape: tuple[int, int]
    corner: NDArray[np.float64]
    across: NDArray[np.float64]  # world directions along a row and down a column
    spacing: NDArray[np.float64]  # of rows and of columns
    scale: tuple[float, float]
    segment: int

    def place(self, origin: Any, step: float, normal: Any) -> dict[str, Any]:
        """Return what a ``Volume`` says of the place of slices that begin at an origin."""
        spacing = triple((*self.spacing[::-1], step))
        direction = np.column_stack([*self.across, normal])
        return {"spacing": spacing, "origin": triple(origin), "direction": direction, "space": LPS}


def read_dicom(request: Request) -> Volume:
    """Read ``FOLDER``, a file of several frames, or ``FOLDER:NAME``.

    The name is the UID of one of several series, or the label of a segment of a segmentation.
    """
    series, notes = _images_in(request.path)
    segments = {
        uid: {int(each.SegmentNumber): str(each.SegmentLabel) for each in header.SegmentSequence}
        for uid, ((_, header), *_) in series.items()
        if header.get("SOPClassUID") in (BITS, LABEL_MAP)
    }
    named = {name: uid for uid, found in segments.items() for name in found.values()}
    names = [*series, *(named if request.member else ())]
    name = request.choose(names, "series of DICOM images")
    uid = named.get(name, name)
    if uid not in segments:
        return _of_slices(list(_slices(series[uid])), notes)
    if len(series[uid]) > 1:
        raise GridError(f"{uid} is several segmentations: give one of its files")
    found = segments[uid]
    chosen = [number for number, label in found.items() if label == name or len(found) == 1]
    return _of_segments(*series[uid][0], found, chosen, notes)


def _images_in(path: Path) -> tuple[dict[str, list[Image]], tuple[str, ...]]:
    """Return the images of each series in a folder, or of a file, and notes on what is left out."""
    import pydicom

    series: dict[str, list[Image]] = {}
    inner = sorted(each.name for each in path.glob("*") if each.is_dir())
    names = sorted({*os.listdir(path)} - {*inner}) if path.is_dir() else [path.name]
    for name in names:
        file = check_beside(path, name) if path.is_dir() else path
        with file.open("rb") as opened:
            start = opened.read(PREAMBLE + 4)
        if start[PREAMBLE:] != b"DICM":
            if file.suffix.lower() == ".dcm" or not any(start):
                raise FileError(f"{file} is damaged, or no DICOM file: replace it, or remove it")
            continue
        header = pydicom.dcmread(file, stop_before_pixels=True)
        if "Rows" in header:
            series.setdefault(str(header.get("SeriesInstanceUID", "")), []).append((file, header))
            continue
        kind = header.file_meta.get("MediaStorageSOPClassUID")
        if not kind or "Image" in kind.name or kind in (BITS, LABEL_MAP):
            raise FileError(f"{file} is damaged: it has no rows; replace it")
    listed = ", ".join(inner[:MOST_NAMED])
    if inner and not series:
        raise FileError(f"{path} holds no DICOM images, but folders: give one of them ({listed})")
    return series, (f"folders in it are not read: {listed}",) * bool(inner)


def _pixels(path: Path, frame: int | None = None) -> NDArray[Any]:
    """Return the values of a frame, or of all: FileError names the file that is damaged, say."""
    from pydicom.pixels.utils import pixel_array

    try:
        return np.asarray(pixel_array(path, index=frame))
    except MemoryError:
        raise
    except Exception as error:
        raise FileError(f"{path} cannot be read: {' '.join(str(error).split())}") from error


def _of_slices(slices: list[_Slice], notes: tuple[str, ...]) -> Volume:
    """Return slices of one size, spacing and direction, which lie in even steps, as a volume."""
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
    dtype = np.dtype(np.int32 if is_whole else np.float32)
    dtype = _pixels(first.path, first.frame).dtype if is_plain else dtype

    def load(index: Index) -> NDArray[Any]:
        planes = np.empty((len(slices), *first.shape), dtype)
        for plane, each in zip(planes, slices):
            values = _pixels(each.path, each.frame)
            plane[:] = values if is_plain else values * each.scale[0] + each.scale[1]
        return planes.T

    place = first.place(corners[0], step, shift / step)
    return Volume(load, (*first.shape[::-1], len(slices)), dtype, **place, notes=notes)


def _of_segments(
    path: Path, header: Any, labels: dict[int, str], chosen: list[int], notes: tuple[str, ...]
) -> Volume:
    """Return the numbers of the segments, or 1 (or the fractions) in those ``chosen``; else 0."""
    frames = list(_slices([(path, header)]))
    first = frames[0]
    normal = np.cross(*first.across)
    heights = np.array([each.corner @ normal for each in frames])
    groups = [*_items(header.SharedFunctionalGroupsSequence), header]
    between, thick = (_stated(groups, n) for n in ("SpacingBetweenSlices", "SliceThickness"))
    gaps = np.diff(np.unique(heights.round(4)))
    step = float(between or (gaps.min() if len(gaps) else thick) or 0)
    if not step > 0:
        raise GridError("it states neither the spacing between slices nor their thickness")
    places = (heights - heights.min()) / step
    numbers = np.rint(places).astype(int)
    if (off := np.abs(places - numbers).max()) > 10 * EVEN:
        raise GridError(f"its frames are {off * step:.4g} mm off from even steps of {step:.6g}")
    is_map, most = header.SOPClassUID == LABEL_MAP, header.get("MaximumFractionalValue")
    is_fraction = bool(chosen) and header.get("SegmentationType") == "FRACTIONAL" and most
    kind = np.float32 if is_fraction else np.uint8 if chosen or max(labels) < 256 else np.uint16
    shape = (int(numbers.max()) + 1 + 2 * BEYOND, *first.shape)

    def load(index: Index) -> NDArray[Any]:
        planes = np.zeros(shape, kind)
        pixels = _pixels(path).reshape(-1, *first.shape)  # frames need not be whole bytes
        for number, each, values in zip(numbers + BEYOND, frames, pixels):
            plane = planes[number]
            if is_map:
                plane[:] = np.isin(values, chosen) if chosen else values
            elif is_fraction and each.segment in chosen:
                plane[:] = values / most
            elif not chosen or each.segment in chosen:
                inside = values > (most or 1) / 2
                if plane[inside].any():
                    label = labels[each.segment]
                    raise GridError(f"its segments overlap: give one of them, {path}:{label}")
                plane[inside] = 1 if chosen else each.segment
        return planes.T

    origin = first.corner + normal * (heights.min() - heights[0] - BEYOND * step)
    names: Names = {number: (label, None) for number, label in labels.items()}
    return Volume(
        *(load, shape[::-1], np.dtype(kind)),
        **first.place(origin, step, normal),
        notes=notes,
        hint=DENSITY if is_fraction else "" if chosen else LABELS,
        names={1: names[chosen[0]]} if chosen else names,
        about={"segments": list(labels.values())},
    )


def _slices(images: list[Image]) -> Iterator[_Slice]:
    """Yield the slices of images, one for each frame."""
    for path, header in images:
        if header.get("SamplesPerPixel", 1) != 1 or "ModalityLUTSequence" in header:
            raise GridError(f"{path.name} has colours or a table of values: give grey images")
        frames = header.get("PerFrameFunctionalGroupsSequence") or [header]
        if len(frames) != int(header.get("NumberOfFrames") or 1):
            raise GridError(
                f"{path.name} has {header.NumberOfFrames} frames without a place each: save it as "
                "an enhanced image, or as NIfTI"
            )
        shape = header.Rows, header.Columns
        shared = _items(header.get("SharedFunctionalGroupsSequence"))
        for index, frame in enumerate(frames):
            groups = [*_items([frame] if frame is not header else ()), *shared, header]
            names = "ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing"
            place = [_stated(groups, name) for name in names]
            if not all(place):
                raise GridError(f"{path.name} states no place: it is no slice of a volume")
            corner, across, steps = (np.array(numbers, np.float64) for numbers in place)
            slope, intercept = _stated(groups, "RescaleSlope"), _stated(groups, "RescaleIntercept")
            scale = 1.0 if slope is None else float(slope), float(intercept or 0)
            segment = int(_stated(groups, "ReferencedSegmentNumber") or 0)
            about = shape, corner, across.reshape(2, 3), steps, scale, segment
            yield _Slice(path, index, *about)


def _items(groups: Sequence[Any] | None) -> list[Any]:
    """Return what the sequences of functional groups hold."""
    each_of = (each for group in groups or () for each in group if each.VR == "SQ")
    return [item for each in each_of for item in each.value or ()]


def _stated(groups: list[Any], name: str) -> Any:
    """Return an element of the first group that has it, else None."""
    return next((group[name].value for group in groups if name in group), None)
