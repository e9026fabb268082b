"""TIFF stacks, with tifffile: arrays (z, y, x), a page per z.

Spacing and origin are read where ImageJ or OME metadata states them for all three axes.
"""

from __future__ import annotations

import re
from math import prod
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ...arrays import Triple
from ...errors import FileError, GridError
from ..regular import check_beside
from ..volume import Request, Volume, axes_direction, in_array_order
from .stored import without_gaps


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
    spacing = _ome_spacing(file) or _imagej_spacing(file)
    segments = [page.databytecounts for page in series.pages if page is not None]
    if spacing is not None:
        spacing = in_array_order(spacing, request.axes)
    direction = axes_direction(request.axes)
    read = _reader(request, series)
    absent = sum(size == 0 for sizes in segments for size in sizes)
    read_box = without_gaps(
        lambda box: read(box[0].start, box[0].stop)[:, box[1], box[2]],
        *(absent, sum(map(len, segments))),
        series.keyframe.nodata,
    )
    packed = sum(map(sum, segments))
    about: dict[str, Any] = {"read_box": read_box, "packed": packed}
    return Volume(series.shape, np.dtype(series.dtype), read, spacing, None, direction, **about)


def _check_other_files(file: Any, request: Request) -> None:
    """Raise FileError unless the files that OME metadata names lie beside the file."""
    if not file.is_ome:
        return
    for element in ElementTree.fromstring(file.ome_metadata).iter():
        named = element.get("FileName") or element.get("MetadataFile")
        if named and named != request.path.name:
            check_beside(request.path, named)


def _reader(request: Request, series: Any) -> Any:
    """Return a function that reads planes: pages if each is a plane, else from the whole array."""
    pages, shape = series.pages, series.shape
    if len(pages) == shape[0] and tuple(pages[0].shape) == tuple(shape[1:]):

        def read_pages(first: int, last: int) -> NDArray[Any]:
            _check_pages(request, series, first, last)
            return np.stack([pages[i].asarray() for i in range(first, last)])

        return read_pages
    request.check_loads(prod(shape) * np.dtype(series.dtype).itemsize, "tifffile")
    whole = series.asarray()

    def read(first: int, last: int) -> NDArray[Any]:
        planes: NDArray[Any] = whole[first:last]
        return planes

    return read


def _check_pages(request: Request, series: Any, first: int, last: int) -> None:
    """Raise FileError if a page is missing."""
    missing = [i for i in range(first, last) if series.pages[i] is None]
    if missing:
        raise FileError(f"{request.path} has no page {missing[0]}: it is damaged")


def _imagej_spacing(file: Any) -> Triple | None:
    """Return the spacing x, y, z of an ImageJ stack, in its unit; None if it is not stated."""
    found = file.imagej_metadata or {}
    tags = file.pages[0].tags
    if "spacing" not in found or "XResolution" not in tags or "YResolution" not in tags:
        return None
    x, y = (_per_pixel(tags[name].value) for name in ("XResolution", "YResolution"))
    z = abs(float(found["spacing"]))
    return (x, y, z) if x > 0 and y > 0 and z > 0 else None


def _per_pixel(resolution: tuple[int, int]) -> float:
    """Return the size of a pixel from pixels per unit, a fraction."""
    pixels, units = resolution
    return units / pixels if pixels else 0.0


def _ome_spacing(file: Any) -> Triple | None:
    """Return the spacing x, y, z of an OME stack, in its unit; None if it is not stated."""
    if not file.is_ome:
        return None
    text = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", file.ome_metadata)
    pixels = ElementTree.fromstring(re.sub(r"\s\w+:(?=\w+=)", " ", text)).find(".//Pixels")
    sizes = [] if pixels is None else [pixels.get(f"PhysicalSize{axis}") for axis in "XYZ"]
    if len(sizes) < 3 or pixels is None or None in sizes:
        return None
    units = {pixels.get(f"PhysicalSize{axis}Unit", "µm") for axis in "XYZ"}
    if len(units) > 1:
        raise GridError(f"its axes have sizes in different units, {', '.join(sorted(units))}")
    x, y, z = (float(size or 0) for size in sizes)
    return x, y, z
