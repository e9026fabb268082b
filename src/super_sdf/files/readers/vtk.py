"""Image data of VTK, in files or in memory; and rectilinear grids, if their steps are even."""

from __future__ import annotations

import re
from importlib import import_module
from math import prod
from typing import Any

import numpy as np

from ...errors import FileError, GridError, OptionTypeError, seen
from ...grid.samples import as_triple, even_steps
from . import XYZ, Request, Volume, stored, triple

NAME = "the image"  # in memory, in error messages
STATED = re.compile(rb'\b(Origin|Spacing)="([^"]*)"')  # of a ``.vti``
MARKS = ("vtkGhostType", "vtkValidPointMask")
READERS = {
    ".vti": ("vtkIOXML", "vtkXMLImageDataReader"),
    ".vtk": ("vtkIOLegacy", "vtkDataSetReader"),
    ".vtkhdf": ("vtkIOHDF", "vtkHDFReader"),
}


def read_vtk(request: Request) -> Volume:
    """Read an array of points or of cells: the named one, else the only one."""
    from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkStringOutputWindow
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline

    suffix = request.path.suffix.lower()
    module, name = READERS[suffix]
    reader = getattr(import_module(f"vtkmodules.{module}"), name)()
    if suffix == ".vtk":
        reader.ReadAllScalarsOn()
        reader.ReadAllFieldsOn()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    said, before = vtkStringOutputWindow(), vtkOutputWindow.GetInstance()
    request.files.callback(vtkOutputWindow.SetInstance, before)
    vtkOutputWindow.SetInstance(said)
    with request.path.open("rb") as file:
        for what, numbers in STATED.findall(file.read(1 << 16)):  # VTK takes nan for 1
            as_triple(list(map(float, numbers.split())), what.decode())
    reader.SetFileName(str(request.path))
    reader.UpdateInformation()
    about, key = reader.GetOutputInformation(0), vtkStreamingDemandDrivenPipeline.WHOLE_EXTENT()
    if about.Has(key):
        extent = np.array(about.Get(key), object)
        request.check_fits(extent[1::2] - extent[::2] + 1, np.dtype("u1"))
    reader.Update()
    image = reader.GetOutputDataObject(0)
    if image is None or "error" in said.GetOutput().lower():
        raise FileError("VTK finds it damaged, or truncated")
    arrays = _arrays(image)
    text = request.path.read_bytes() if suffix == ".vtk" else b""
    if re.match(rb"# vtk.*\n.*\nASCII\s", text):  # VTK makes up what is missing
        start = text.find(b"_DATA ")
        if len(text[start:].split()) < sum(each.GetNumberOfValues() for each, _ in arrays.values()):
            raise FileError("it is truncated")
    # what has several numbers a sample, and VTK's own marks, is read only if it is named
    single = [name for name, (array, _) in arrays.items() if array.GetNumberOfComponents() == 1]
    plain = [name for name in single if name.removeprefix("CellData/") not in MARKS]
    names = plain if plain and request.member not in arrays else list(arrays)
    name = request.choose(names, "array of points or cells")
    return _volume_of(image, name, *arrays[name], *request.numbers)


def volume_of_image(image: Any, request: Request) -> Volume:
    """Return an array of image data in memory: see ``files.grids.grid_from_image``."""
    if not (hasattr(image, "IsA") and image.IsA("vtkImageData")):
        raise OptionTypeError(f"image is {seen(image)}: give VTK image data")
    arrays = _arrays(image)
    active = [data.GetScalars() for data in (image.GetPointData(), image.GetCellData())]
    named = [str(each.GetName()) for each in active if each and request.member is None]
    name = request.choose(named[:1] or list(arrays), "array of points or cells")
    return _volume_of(image, name, *arrays[name])


def _arrays(image: Any) -> dict[str, tuple[Any, bool]]:
    """Return the arrays of points and of cells by their names, and which are of points."""
    arrays: dict[str, tuple[Any, bool]] = {}
    for of_points, data in ((True, image.GetPointData()), (False, image.GetCellData())):
        for number in range(data.GetNumberOfArrays()):
            if array := data.GetArray(number):  # none if it holds text
                name = str(array.GetName())
                arrays[f"CellData/{name}" if name in arrays else name] = array, of_points
    return arrays


def _volume_of(image: Any, name: str, array: Any, of_points: bool, *numbers: int) -> Volume:
    """Return an array at the points of an image, or at the centres of its cells."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    extent = np.array(image.GetExtent()) if hasattr(image, "GetExtent") else np.zeros(6, int)
    direction, first = XYZ, extent[::2]  # which need not be 0
    if image.IsA("vtkImageData"):
        direction = np.reshape(image.GetDirectionMatrix().GetData(), (3, 3))
        spacing, origin = image.GetSpacing(), image.GetOrigin()
    elif image.IsA("vtkRectilinearGrid"):
        places = [vtk_to_numpy(getattr(image, f"Get{axis}Coordinates")()) for axis in "XYZ"]
        origin, spacing = zip(*(even_steps(*each) for each in zip("xyz", places)))
        first = np.zeros(3)
    else:
        said = f"it holds {image.GetClassName()}, no image data"
        raise GridError(f"{said}: sample its distances on a lattice, and write that as .vti")
    shape = tuple(int(n) for n in extent[1::2] - extent[::2] + of_points)
    if (count := array.GetNumberOfTuples()) != prod(shape):
        raise GridError(f"its array {name!r} has {count:,} samples, its shape is {shape}")
    components = array.GetNumberOfComponents()
    if components != 1 and not (len(numbers) == 1 and numbers[0] < components):
        said = f"its array {name!r} has {components} numbers per sample"
        raise GridError(f"{said}: give an array of one, or NAME[0]")
    start = direction @ (np.array(spacing) * (first + (0 if of_points else 0.5)))
    values = vtk_to_numpy(array).reshape(*shape[::-1], -1)[..., numbers[0] if numbers else 0].T
    return Volume(*stored(values), triple(spacing), triple(np.array(origin) + start), direction)
