"""TIFF stacks, with tifffile: arrays (z, y, x), a page per z.

Spacing is read where ImageJ's metadata, or its like by tifffile, or OME's states it for all three
axes; ImageJ states an origin, too.
"""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

from ...errors import GridError
from ..formats import check_beside
from . import Axis, Request, Volume, placed


def read_tiff(request: Request) -> Volume:
    """Read the first series of a ``.tif`` file: pages of one size, or an ImageJ or OME stack."""
    import tifffile

    # not as a file of MicroManager, whose other files would be opened
    opened = tifffile.TiffFile(request.path, is_mmstack=False, is_ndtiff=False)
    file = request.files.enter_context(opened)
    ome = ElementTree.fromstring(file.ome_metadata or "") if file.is_ome else None
    for element in () if ome is None else ome.iter():
        named = element.get("FileName") or element.get("MetadataFile")
        if named and named != request.path.name:
            check_beside(request.path, named)
    series = file.series[0]
    shape, names = series.shape, series.axes.lower()
    if len(shape) < 3 or "s" in names:
        said = f"{request.path} has axes {series.axes} of shape {shape}"
        raise GridError(f"{said}: give a stack of three axes (z, y, x), without colours")
    if request.axes != "zyx" or not {*"xyz"} <= {*names}:  # pages are z, whatever they are called
        names = names[:-3] + request.axes
    stated = _imagej_axes(file) if ome is None else _ome_axes(ome)
    axes, order = [stated.get(name, Axis(name)) for name in names], [n for n in names if n in "xyz"]
    place = placed(request, shape, {}, axes, "".join(order))
    return Volume(lambda index: series.asarray()[index], shape, series.dtype, **place)


def _imagej_axes(file: Any) -> dict[str, Axis]:
    """Return the axes of an ImageJ stack by their names, with its defaults; none if not stated."""
    metadata: dict[str, Any] = file.imagej_metadata or (file.shaped_metadata or ({},))[0]
    tags = {tag.name: tag.value for tag in file.pages[0].tags}
    resolution = [tags.get(name, (0, 1)) for name in ("XResolution", "YResolution")]
    # ImageJ writes letters beyond ASCII by their numbers
    unit = str(metadata.get("unit") or "").encode("ascii", "backslashreplace")
    is_stated = "spacing" in metadata or (unit and not unit.startswith(b"pixel"))
    if not is_stated or not all(pixels for pixels, _ in resolution):
        return {}
    steps = [count / pixels for pixels, count in resolution]
    steps.append(abs(float(metadata.get("spacing") or 1)))
    starts = [float(metadata.get(f"{axis}origin") or 0) for axis in "xyz"]  # in pixels
    places = [-start * step if any(starts) else None for start, step in zip(starts, steps)]
    stated = zip("xyz", [unit.decode("unicode_escape")] * 3, steps, places)
    return {name: Axis(name, *others) for name, *others in stated}


def _ome_axes(ome: ElementTree.Element) -> dict[str, Axis]:
    """Return those axes by their names whose spacing the metadata of OME states."""
    about: dict[str, str] = getattr(ome.find(".//{*}Pixels"), "attrib", {})
    sizes = {axis: float(about.get(f"PhysicalSize{axis.upper()}") or 0) for axis in "xyz"}
    units = {axis: about.get(f"PhysicalSize{axis.upper()}Unit", "µm") for axis in "xyz"}
    return {axis: Axis(axis, units[axis], size) for axis, size in sizes.items() if size > 0}
