"""Image data of VTK, in files or in memory; and rectilinear grids, if their steps are even."""

from __future__ import annotations

import re
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import FileError, GridError, OptionTypeError, seen
from ..volume import XYZ, Request, Volume, triple

NAME = "the image"  # in memory, in error messages
MARKS = ("vtkGhostType", "vtkValidPointMask")
# Lines of text between the values of arrays: keywords, or name, counts and type of an array.
BETWEEN = re.compile(rb"^(?:[A-Z_]{4,}.*|\S+ \d+ \d+ [a-zA-Z_]+\s*)$", re.M)
EVEN = 1e-4  # share of a step by which steps may differ


def read_vti(request: Request) -> Volume:
    """Read an array of points or of cells of a ``.vti`` file: the named one, else the only one."""
    from vtkmodules.vtkIOXML import vtkXMLImageDataReader

    return _read(request, vtkXMLImageDataReader())


def read_vtk(request: Request) -> Volume:
    """Read a legacy file, in text or binary."""
    from vtkmodules.vtkIOLegacy import vtkDataSetReader

    reader = vtkDataSetReader()
    reader.ReadAllScalarsOn()
    reader.ReadAllFieldsOn()
    return _read(request, reader)


def read_vtkhdf(request: Request) -> Volume:
    """Read a ``.vtkhdf`` file."""
    from vtkmodules.vtkIOHDF import vtkHDFReader

    return _read(request, vtkHDFReader())


def _read(request: Request, reader: Any) -> Volume:
    from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkStringOutputWindow
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    said, before = vtkStringOutputWindow(), vtkOutputWindow.GetInstance()
    vtkOutputWindow.SetInstance(said)
    reader.SetFileName(str(request.path))
    reader.UpdateInformation()
    about, key = reader.GetOutputInformation(0), vtkStreamingDemandDrivenPipeline.WHOLE_EXTENT()
    if about.Has(key):
        extent = np.array(about.Get(key), object)
        request.check_fits(extent[1::2] - extent[::2] + 1, np.dtype("u1"))
    reader.Update()
    vtkOutputWindow.SetInstance(before)
    image = reader.GetOutputDataObject(0)
    if image is None or "error" in said.GetOutput().lower():
        raise FileError("VTK finds it damaged, or truncated")
    _check_text(request.path, image)
    # what has several numbers a sample, and VTK's own marks, is read only if it is named
    arrays: dict[str, tuple[Any, bool]] = {}
    for of_points, data in ((True, image.GetPointData()), (False, image.GetCellData())):
        for array in _arrays(data):
            name = str(array.GetName())
            arrays[f"CellData/{name}" if name in arrays else name] = array, of_points
    plain = [
        name
        for name, (array, _) in arrays.items()
        if name == request.member or (array.GetNumberOfComponents() == 1 and name not in MARKS)
    ]
    name = request.choose(plain or list(arrays), "array of points or cells")
    return _volume_of(image, *arrays[name], f"its array {name!r}", request.path)


def _check_text(path: Path, image: Any) -> None:
    """Raise FileError if text holds fewer values than it promises: VTK makes others up."""
    text = path.read_bytes()
    if not re.match(rb"# vtk.*\n.*\nASCII\s", text):
        return
    data = image.GetPointData(), image.GetCellData()
    promised = sum(array.GetNumberOfValues() for each in data for array in _arrays(each))
    start = re.search(rb"^(?:POINT|CELL)_DATA ", text, re.M)
    follow = len(BETWEEN.sub(b"", text[start.start() if start else 0 :]).split())
    if follow < promised:
        raise FileError(f"it is truncated: {promised:,} values are promised, but {follow:,} follow")


def volume_of_image(image: Any, scalars: str | None) -> Volume:
    """Return an array of image data in memory: see ``files.grids.grid_from_image``."""
    if not (hasattr(image, "IsA") and image.IsA("vtkImageData")):
        raise OptionTypeError(f"image is {seen(image)}: give VTK image data")
    data = image.GetPointData(), image.GetCellData()
    points, cells = ([str(array.GetName()) for array in _arrays(each)] for each in data)
    listed = ", ".join([*points, *(f"{name} (cells)" for name in cells)])
    if scalars is not None:
        found = [each.GetArray(scalars) for each in data]
    else:
        found = [each.GetScalars() for each in data]
        if not any(found):
            found = [_arrays(e)[0] if len(n) == 1 else None for e, n in zip(data, (points, cells))]
    if not listed:
        raise GridError(f"{NAME} holds no array of points or cells")
    if not any(found) and scalars is None:
        some = (points or cells)[0]
        raise GridError(f"{NAME} holds several arrays, {listed}: give scalars={some!r}, say")
    if not any(found):
        raise GridError(f"{NAME} has no array {seen(scalars)}: it holds {listed}")
    array = found[0] or found[1]
    what = f"the array {array.GetName()!r} of {NAME}"
    return _volume_of(image, array, bool(found[0]), what, None)


def _arrays(data: Any) -> list[Any]:
    arrays = (data.GetArray(number) for number in range(data.GetNumberOfArrays()))
    return [array for array in arrays if array]


def _volume_of(image: Any, array: Any, of_points: bool, what: str, path: Any) -> Volume:
    """Return an array at the points of an image, or at the centres of its cells.

    Point (i, j, k) of the extent, which need not begin at 0, is at
    ``origin + direction @ (spacing * (i, j, k))``.
    """
    from vtkmodules.util.numpy_support import vtk_to_numpy

    direction = XYZ
    if image.IsA("vtkImageData"):
        matrix = image.GetDirectionMatrix()
        direction = np.array([[matrix.GetElement(i, j) for j in range(3)] for i in range(3)])
        spacing, origin = image.GetSpacing(), image.GetOrigin()
    elif image.IsA("vtkRectilinearGrid"):
        places = [
            vtk_to_numpy(getattr(image, f"Get{axis}Coordinates")()).astype(float) for axis in "XYZ"
        ]
        spacing = [(each[-1] - each[0]) / max(len(each) - 1, 1) for each in places]
        origin = [each[0] for each in places]
        for axis, each, start, step in zip("xyz", places, origin, spacing):
            even = start + step * np.arange(len(each))
            if not np.allclose(each, even, rtol=0, atol=EVEN * abs(step)):
                raise GridError(
                    f"{path}: its coordinates along {axis} are uneven: resample it, as with "
                    "pyvista.create_grid(mesh, dimensions=mesh.dimensions).sample(mesh)"
                )
    else:
        raise GridError(
            f"it holds {image.GetClassName()}, no image data: sample its distances on a lattice, "
            "and write that as .vti"
        )
    extent = np.array(image.GetExtent())
    first = extent[::2] if image.IsA("vtkImageData") else np.zeros(3)
    shape = tuple(int(n) for n in extent[1::2] - extent[::2] + of_points)
    components, length = array.GetNumberOfComponents(), array.GetNumberOfTuples()
    if components != 1:
        raise GridError(f"{what} has {components} numbers per sample: give an array of one")
    if length != prod(shape):
        raise GridError(f"{what} has {length:,} values for {prod(shape):,} samples")
    start = direction @ (np.array(spacing) * (first + (0 if of_points else 0.5)))
    values = vtk_to_numpy(array).reshape(shape[::-1]).T
    return Volume(values, triple(spacing), triple(np.array(origin) + start), direction)
