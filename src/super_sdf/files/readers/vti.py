"""VTK image data, with VTK: arrays (z, y, x) in C order, with extent, origin and direction.

The extent need not begin at 0: sample (i, j, k) of the extent is at
``origin + direction @ (spacing * (i, j, k))``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError
from ..volume import ImageLattice, Request, Volume
from .choosing import choose_member
from .silence import discarded_stderr

ERROR = "ERROR:"  # begins each error that VTK prints


def read_vti(request: Request) -> Volume:
    """Read the point data of a ``.vti`` file; cell data if there is no other."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLImageDataReader

    reader = vtkXMLImageDataReader()
    reader.SetFileName(str(request.path))
    with _raised_errors(request):
        if not reader.CanReadFile(str(request.path)):
            raise FileError(f"{request.path} is no VTK image data, or damaged")
        reader.UpdateInformation()
    points = _names(reader.GetPointDataArraySelection())
    cells = _names(reader.GetCellDataArraySelection())
    name = choose_member(request, points or cells, "array of points or cells")
    image, of_points = reader.GetOutputInformation(0), bool(points)
    extent = _extent(reader, image)
    spacing, origin = np.array(image.Get(_key("SPACING"))), np.array(image.Get(_key("ORIGIN")))
    lattice = ImageLattice(extent, spacing, origin, _direction(image), of_points)

    def read(first: int, last: int) -> NDArray[Any]:
        part = (*extent[:4], extent[4] + first, extent[4] + last - of_points)
        with _raised_errors(request):
            reader.UpdateExtent(part)
        output = reader.GetOutput()
        data = output.GetPointData() if of_points else output.GetCellData()
        found = data.GetArray(name)
        if found is None or found.GetNumberOfComponents() != 1:
            raise FileError(f"{request.path}:{name} is no array of numbers")
        # the reader may return more planes than it was asked for
        start = output.GetExtent()[4] - extent[4]
        values = vtk_to_numpy(found).reshape(-1, *lattice.shape[1:])
        planes: NDArray[Any] = values[first - start : last - start]
        return planes

    dtype = read(0, 1).dtype
    return lattice.volume(dtype, read, request.planes_at_once(lattice.shape, dtype))


def _key(name: str) -> Any:
    """Return a key of VTK's information objects."""
    from vtkmodules.vtkCommonDataModel import vtkDataObject

    return getattr(vtkDataObject, name)()


def _extent(reader: Any, image: Any) -> tuple[int, ...]:
    """Return the first and last index on each axis: x, y, z."""
    extent: tuple[int, ...] = image.Get(reader.GetExecutive().WHOLE_EXTENT())
    return extent


def _direction(image: Any) -> NDArray[np.float64]:
    """Return the direction matrix; files of version 1 have none."""
    found = image.Get(_key("DIRECTION"))
    return np.reshape(found, (3, 3)) if found else np.eye(3)


def _names(selection: Any) -> list[str]:
    """Return the names of the arrays of a selection."""
    return [selection.GetArrayName(i) for i in range(selection.GetNumberOfArrays())]


@contextmanager
def _raised_errors(request: Request) -> Iterator[None]:
    """Raise FileError for the first error that VTK would print to stderr; print nothing."""
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow

    shown, window = vtkOutputWindow.GetInstance(), vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(window)
    try:
        with discarded_stderr():  # VTK's log
            yield
    finally:
        vtkOutputWindow.SetInstance(shown)
    text = window.GetOutput()
    if ERROR in text:
        reason = " ".join(text[text.index(ERROR) :].split()).split("): ")[1:2] or ["damaged"]
        raise FileError(f"{request.path} cannot be read by VTK: {reason[0][:200]}")
