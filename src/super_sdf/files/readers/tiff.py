"""TIFF stacks, with tifffile: arrays (z, y, x), a page per z.

Spacing is read where ImageJ's metadata, or its like by tifffile, or OME's states it for all three
axes; ImageJ states an origin, too.
"""

from __future__ import annotations

import re
from math import prod
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from ..regular import check_beside
from ..volume import Planes, Request, Volume
from .axes import Axes, placed, without_gaps

Stated = tuple[str, float | None, float | None]  # of an axis: unit, step, start


def read_tiff(request: Request) -> Volume:
    """Read the first series of a ``.tif`` file: pages of one size, or an ImageJ or OME stack."""
    import tifffile

    # not as a file of MicroManager, whose other files would be opened
    opened = tifffile.TiffFile(request.path, is_mmstack=False, is_ndtiff=False)
    file = request.files.enter_context(opened)
    _check_other_files(file, request)
    series = file.series[0]
    if len(series.shape) != 3 or "S" in series.axes:
        raise GridError(
            f"{request.path} has axes {series.axes} of shape {series.shape}: give a stack of "
            "three axes (z, y, x), without channels"
        )
    axes, notes = _axes(file, series, request.axes)
    _, place = placed(axes, {}, series.shape, request.axes)
    segments = [page.databytecounts for page in series.pages if page is not None]
    place["notes"] += notes
    read = _reader(request, series)
    absent = sum(size == 0 for sizes in segments for size in sizes)
    read_box = without_gaps(
        lambda box: read(box[0].start, box[0].stop)[:, box[1], box[2]],
        *(absent, sum(map(len, segments))),
        series.keyframe.nodata,
    )
    packed = sum(map(sum, segments))
    return Volume(series.shape, np.dtype(series.dtype), read_box=read_box, packed=packed, **place)


def _check_other_files(file: Any, request: Request) -> None:
    if not file.is_ome:
        return
    for element in ElementTree.fromstring(file.ome_metadata).iter():
        named = element.get("FileName") or element.get("MetadataFile")
        if named and named != request.path.name:
            check_beside(request.path, named)


def _reader(request: Request, series: Any) -> Planes:
    pages, shape = series.pages, series.shape
    if len(pages) != shape[0] or tuple(pages[0].shape) != tuple(shape[1:]):
        request.check_loads(prod(shape) * np.dtype(series.dtype).itemsize, "tifffile")
        whole: NDArray[Any] = series.asarray()
        return lambda first, last: whole[first:last]

    def read_pages(first: int, last: int) -> NDArray[Any]:
        missing = [i for i in range(first, last) if pages[i] is None]
        if missing:
            raise FileError(f"{request.path} has no page {missing[0]}: it is damaged")
        return np.stack([pages[i].asarray() for i in range(first, last)])

    return read_pages


def _axes(file: Any, series: Any, order: str) -> tuple[Axes, tuple[str, ...]]:
    is_named = order == "zyx" and sorted(series.axes) == ["X", "Y", "Z"]
    names = series.axes.lower() if is_named else order
    stated: dict[str, Stated] = _ome_axes(file) or _imagej_axes(file) or {}
    units, steps, starts = zip(*(stated.get(name, ("", None, None)) for name in names))
    return Axes.named(names, units, steps, starts), (() if stated else _pixel_note(file))


def _imagej_axes(file: Any) -> dict[str, Stated] | None:
    """Return unit, step and start of the axes of an ImageJ stack; None if it is not calibrated.

    What is not stated holds as in ImageJ: a spacing of z of 1, the unit of the resolution, that of
    x for all axes, and origins of 0 beside others, which are in pixels.
    """
    metadata: dict[str, Any] = file.imagej_metadata or (file.shaped_metadata or ({},))[0]
    sizes = _pixel_sizes(file)
    if not sizes or not (file.is_imagej or "spacing" in metadata):
        return None
    unit = str(metadata.get("unit") or _resolution_unit(file))
    if "spacing" not in metadata and "unit" not in metadata and unit:
        return None  # x and y may be those of a print
    # ImageJ writes letters beyond ASCII by their numbers
    units = [
        re.sub(r"\\u([0-9a-fA-F]{4})", lambda number: chr(int(number[1], 16)), each)
        for each in (str(metadata.get(f"{axis}unit") or unit) for axis in "xyz")
    ]
    steps = [*sizes, abs(float(metadata.get("spacing") or 1))]
    is_bare = not any(unit and not unit.startswith("pixel") for unit in units)
    if is_bare and "spacing" not in metadata and sizes == (1, 1):
        return None
    starts = [float(metadata.get(f"{axis}origin") or 0) for axis in "xyz"]
    placed = [-start * step if any(starts) else None for start, step in zip(starts, steps)]
    return dict(zip("xyz", zip(units, steps, placed)))


def _pixel_sizes(file: Any) -> tuple[float, float] | None:
    tags = file.pages[0].tags
    if "XResolution" not in tags or "YResolution" not in tags:
        return None
    stated = (tags[name].value for name in ("XResolution", "YResolution"))  # pixels, units
    x, y = (units / pixels if pixels else 0.0 for pixels, units in stated)
    return (x, y) if x > 0 and y > 0 else None


def _resolution_unit(file: Any) -> str:
    tag = file.pages[0].tags.get("ResolutionUnit")
    number = 2 if tag is None else int(tag.value)  # inches, by the standard
    return {2: "inch", 3: "cm", 4: "mm", 5: "µm"}.get(number, "")


def _pixel_note(file: Any) -> tuple[str, ...]:
    sizes, unit = _pixel_sizes(file), _resolution_unit(file)
    if file.is_ome or not sizes or not unit:
        return ()
    return (
        f"its pixels are {sizes[0]:.6g} x {sizes[1]:.6g} {unit}, but it does not state how far its "
        "pages are apart: no spacing is taken from it (give --spacing X,Y,Z)",
    )


def _ome_axes(file: Any) -> dict[str, Stated] | None:
    if not file.is_ome:
        return None
    text = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", file.ome_metadata)
    pixels = ElementTree.fromstring(re.sub(r"\s\w+:(?=\w+=)", " ", text)).find(".//Pixels")
    if pixels is None:
        return None
    stated: dict[str, Stated] = {}
    for axis in "XYZ":
        size, unit = pixels.get(f"PhysicalSize{axis}"), pixels.get(f"PhysicalSize{axis}Unit", "µm")
        if size and float(size) > 0:
            stated[axis.lower()] = unit, float(size), None
    return stated
