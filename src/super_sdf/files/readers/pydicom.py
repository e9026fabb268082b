"""DICOM images and segmentations, with pydicom; coordinates are LPS.

Not with SimpleITK, which reads the frames of an enhanced image in the order of the file and without
a place, and takes missing slices for evenly spaced ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from ..formats import check_beside
from . import LABELS, Index, Names, Request, Volume, triple

EVEN, EVEN_FRAMES = 0.01, 0.1  # of the step, by which slices, and frames of segments, may be off
PARALLEL = 1e-4  # by which components of directions may differ
PREAMBLE = 128  # bytes before the mark DICM
BEYOND = 2  # empty slices on both sides of those that a segmentation stores
BITS, LABEL_MAP = "1.2.840.10008.5.1.4.1.1.66.4", "1.2.840.10008.5.1.4.1.1.66.7"
"""The two classes of segmentations: a frame is of one segment, or holds the numbers of all."""
STATED = (
    *("ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing"),
    *("RescaleSlope", "RescaleIntercept"),
    *("ReferencedSegmentNumber", "SpacingBetweenSlices", "SliceThickness"),
)
"""Of a frame, or of all, in the header or in groups."""
Use = Callable[[NDArray[Any], "_Frame", NDArray[Any]], None]


class _Frame(NamedTuple):
    """A slice: the frame of a file, where it is, and how its values are scaled."""

    path: Path
    number: int
    shape: tuple[int, int]
    corner: NDArray[np.float64]
    across: NDArray[np.float64]  # world directions along a row and down a column
    spacing: NDArray[np.float64]  # of rows and of columns
    scale: tuple[float, float]
    segment: float  # its number, 0 if none is stated, as the next two
    between: float  # spacing between slices
    thickness: float


def read_dicom(request: Request) -> Volume:
    """Read ``FOLDER``, a file of several frames, or ``FOLDER:NAME``.

    The name is the UID of one of several series, or the label of a segment of a segmentation.
    """
    series = _images_in(request.path)
    segments = {
        uid: {int(each.SegmentNumber): str(each.SegmentLabel) for each in header.SegmentSequence}
        for uid, ((_, header), *_) in series.items()
        if header.get("SOPClassUID") in (BITS, LABEL_MAP)
    }
    named = {name: uid for uid, found in segments.items() for name in found.values()}
    name = request.choose([*series, *(named if request.member else ())], "series of DICOM images")
    images = series[named.get(name, name)]
    frames, labels = list(_frames(images)), segments.get(named.get(name, name))
    if labels is None:
        return _of_images(frames)
    if len(images) > 1:
        raise GridError(f"{name} is in several segmentations: give one of their files")
    chosen = [number for number, label in labels.items() if label == name or len(labels) == 1]
    return _of_segments(frames, images[0][1], labels, chosen)


def _images_in(path: Path) -> dict[str, list[tuple[Path, Any]]]:
    """Return the files and headers of each series in a folder, or of a file."""
    import pydicom

    series: dict[str, list[tuple[Path, Any]]] = {}
    names = [x.name for x in path.glob("[!.]*") if not x.is_dir()] if path.is_dir() else []
    for file in [check_beside(path, name) for name in sorted(names)] if path.is_dir() else [path]:
        with file.open("rb") as opened:
            start = opened.read(PREAMBLE + 4)
        is_dicom = start[PREAMBLE:] == b"DICM"
        header: Any = pydicom.dcmread(file, stop_before_pixels=True) if is_dicom else {}
        if "Rows" in header:
            series.setdefault(str(header.get("SeriesInstanceUID", "")), []).append((file, header))
            continue
        # a folder may hold other files, too, and other documents of DICOM
        kind = header.file_meta.get("MediaStorageSOPClassUID") if is_dicom else None
        is_other = "Image" not in kind.name if kind else not is_dicom and any(start)
        if (file.suffix.lower() == ".dcm" and not kind) or not is_other:
            raise FileError(f"{file} is damaged, or no DICOM file: replace it, or remove it")
    return series


def _frames(images: list[tuple[Path, Any]]) -> Iterator[_Frame]:
    """Yield the frames of images; GridError if they are no slices of a volume."""
    for path, header in images:
        if header.get("SamplesPerPixel", 1) != 1 or "ModalityLUTSequence" in header:
            raise GridError(f"{path.name} has colours or a table of values: give grey images")
        frames = header.get("PerFrameFunctionalGroupsSequence") or [header]
        if len(frames) != int(header.get("NumberOfFrames") or 1):
            raise GridError(f"{path.name} has frames without a place each: save it as NIfTI")
        shared = header.get("SharedFunctionalGroupsSequence") or ()
        for number, frame in enumerate(frames):
            groups = () if frame is header else (*shared, frame)
            stated = {each.keyword: each.value for group in groups for each in group.iterall()}
            values = [stated.get(name, header.get(name)) for name in STATED]
            if not all(values[:3]):
                raise GridError(f"{path.name} states no place: it is no slice of a volume")
            corner, across, steps = (np.array(numbers, np.float64) for numbers in values[:3])
            slope, intercept, *others = (float(number or 0) for number in values[3:])
            scale = slope if values[3] is not None else 1.0, intercept
            about: Any = corner, across.reshape(2, 3), steps, scale, *others
            yield _Frame(path, number, (header.Rows, header.Columns), *about)


def _pixels(frame: _Frame) -> NDArray[Any]:
    """Return the values of all frames in the file of one: FileError names it if it is damaged."""
    from pydicom import dcmread
    from pydicom.pixels.utils import get_expected_length, pixel_array

    try:
        image = dcmread(frame.path)
        is_packed = image.file_meta.TransferSyntaxUID.is_compressed
        if not is_packed and len(image.PixelData) < get_expected_length(image):
            raise EOFError("it is truncated")  # of single bits pydicom takes the rest for 0
        return np.asarray(pixel_array(image)).reshape(-1, *frame.shape)
    except Exception as error:
        raise FileError(f"{frame.path} cannot be read: {' '.join(str(error).split())}") from error


def _heights(frames: list[_Frame]) -> NDArray[np.float64]:
    """Return the heights of frames, which must be alike, along their normal."""
    first = frames[0]
    for each in frames:
        same = each.shape == first.shape and np.allclose(each.spacing, first.spacing, rtol=1e-4)
        if not same or not np.allclose(each.across, first.across, atol=PARALLEL):
            said = f"{each.path.name} has another size, spacing or direction than {first.path.name}"
            raise GridError(f"{said}: put the slices of one volume into a folder")
    return np.array([each.corner @ np.cross(*first.across) for each in frames])


def _volume(
    frames: list[_Frame], planes: NDArray[Any], step: float, use: Use, dtype: Any, **more: Any
) -> Volume:
    """Return the volume of frames, with as many empty planes beyond the last as before the first.

    ``use`` gets a plane, which is 0 at first, a frame in it, and the values of the frame.
    """
    first, last = frames[int(planes.argmin())], frames[int(planes.argmax())]
    normal, lean = np.cross(*first.across), last.corner - first.corner
    shift = step * (normal if first is last else lean / (lean @ normal))  # to the next plane
    origin = first.corner - planes.min() * shift
    off = [float(np.linalg.norm(f.corner - origin - n * shift)) for f, n in zip(frames, planes)]
    if not max(off) < (EVEN_FRAMES if more else EVEN) * step:
        said = f"{frames[int(np.argmax(off))].path.name} is {max(off):.4g} mm off from even steps"
        one = "put all slices of one volume (one time, one echo) into a folder"
        raise GridError(f"{said} of {step:.6g}: {one}, or resample the series")
    shape = int(planes.max() + planes.min()) + 1, *first.shape

    def load(index: Index) -> NDArray[Any]:
        whole, pixels = np.zeros(shape, dtype), dict[Path, NDArray[Any]]()
        for plane, frame in zip(planes, frames):
            if frame.path not in pixels:
                pixels = {frame.path: _pixels(frame)}
            use(whole[plane], frame, pixels[frame.path][frame.number])
        return whole.T

    length = float(np.linalg.norm(shift))
    direction = np.column_stack([*first.across, shift / length])
    place = triple((*first.spacing[::-1], length)), triple(origin), direction
    return Volume(load, shape[::-1], dtype, *place, space="LPS", **more)


def _of_images(frames: list[_Frame]) -> Volume:
    """Return slices of one size, spacing and direction, which lie in even steps, as a volume."""
    heights, count = _heights(frames), len(frames)
    if count == 1:
        raise GridError(f"{frames[0].path.name} is its only slice: give the folder of a series")
    scales = np.array([each.scale for each in frames])
    is_plain, is_whole = (scales == (1, 0)).all(), (scales == np.rint(scales)).all()
    dtype = _pixels(frames[0]).dtype if is_plain else np.dtype(np.int32 if is_whole else np.float32)

    def use(plane: NDArray[Any], frame: _Frame, values: NDArray[Any]) -> None:
        plane[:] = values if is_plain else values * frame.scale[0] + frame.scale[1]

    step, planes = float(np.ptp(heights)) / (count - 1), heights.argsort().argsort()
    return _volume(frames, planes, step, use, dtype)


def _of_segments(
    frames: list[_Frame], header: Any, labels: dict[int, str], chosen: list[int]
) -> Volume:
    """Return the numbers of the segments, or 1 in those ``chosen``; else 0."""
    heights = _heights(frames)
    gaps = np.diff(np.unique(heights.round(4)))
    step = frames[0].between or (float(gaps.min()) if len(gaps) else frames[0].thickness)
    if not step > 0:
        raise GridError("it states neither the spacing between slices nor their thickness")
    planes = np.rint((heights - heights.min()) / step).astype(int) + BEYOND
    is_map, most = header.SOPClassUID == LABEL_MAP, header.get("MaximumFractionalValue") or 1

    def use(plane: NDArray[Any], frame: _Frame, values: NDArray[Any]) -> None:
        if is_map:
            plane[:] = np.isin(values, chosen) if chosen else values
        elif not chosen or frame.segment in chosen:
            inside = values > most / 2  # of fractions
            if plane[inside].any():
                said = f"{frame.path}:{labels[int(frame.segment)]}"
                raise GridError(f"its segments overlap: give one of them, {said}")
            plane[inside] = 1 if chosen else frame.segment

    names: Names = {1 if chosen else n: (labels[n], None) for n in chosen or labels}
    dtype = np.dtype(np.uint8 if chosen or max(labels) < 256 else np.uint16)
    return _volume(frames, planes, step, use, dtype, hint="" if chosen else LABELS, names=names)
