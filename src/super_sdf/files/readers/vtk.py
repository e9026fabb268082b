"""Image data that VTK holds: read from legacy ``.vtk`` and ``.vtkhdf`` files, or in memory.

Rectilinear grids are read, too, if their steps are even.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError, OptionTypeError, seen
from ..volume import XYZ, Planes, Request, Volume, reversed_axes, triple

NAME = "the image"  # in memory, in error messages
RESAMPLE = (
    'make .npz with python -c "import numpy as n, pyvista as v; from scipy.interpolate import '
    "interpn as f; m = v.read('{0}'); a = m.x, m.y, m.z; e = [n.linspace(c[0], c[-1], len(c)) for "
    "c in a]; w = m['{2}'].reshape(m.dimensions, order='F'); n.savez('{1}.npz', values=f(a, w, "
    "tuple(n.meshgrid(*e, indexing='ij'))), spacing=[c[1] - c[0] for c in e], origin=[c[0] for c "
    'in e])"'
)
# Lines of text between the values of arrays: keywords, or name, counts and type of an array.
BETWEEN = re.compile(rb"^(?:[A-Z_]{4,}.*|\S+ \d+ \d+ [a-zA-Z_]+\s*)$", re.M)
EVEN = 1e-4  # share of a step by which steps may differ


@dataclass(frozen=True)
class ImageLattice:
    """Where the samples of VTK image data lie: at its points, or at the centres of its cells.

    Point (i, j, k) of the extent is at ``origin + direction @ (spacing * (i, j, k))``. The extent,
    the first and the last point on each axis, need not begin at 0.
    """

    extent: tuple[int, ...]
    spacing: NDArray[np.float64]
    origin: NDArray[np.float64]
    direction: NDArray[np.float64]
    of_points: bool

    @classmethod
    def of_image(cls, image: Any, of_points: bool) -> ImageLattice:
        """Return where the samples of VTK's image data lie, at its points or in its cells."""
        matrix = image.GetDirectionMatrix()
        direction = [[matrix.GetElement(row, column) for column in range(3)] for row in range(3)]
        spacing, origin = np.array(image.GetSpacing()), np.array(image.GetOrigin())
        return cls(image.GetExtent(), spacing, origin, np.array(direction), of_points)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape (nz, ny, nx) of the array of samples: x is the fastest."""
        low, high = self.extent[::2], self.extent[1::2]
        return tuple(high[axis] - low[axis] + self.of_points for axis in (2, 1, 0))

    def volume(self, dtype: Any, read: Planes) -> Volume:
        """Return the samples, whose planes of z ``read`` returns, at their place in the world."""
        first = np.array(self.extent[::2]) + (0 if self.of_points else 0.5)
        start = triple(self.origin + self.direction @ (self.spacing * first))
        spacing, direction = reversed_axes(self.spacing, self.direction)
        return Volume(self.shape, np.dtype(dtype), read, spacing, start, direction)


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


def volume_of_image(image: Any, scalars: str | None) -> Volume:
    """Return an array of image data in memory: see ``files.grids.grid_from_image``."""
    if not (hasattr(image, "IsA") and image.IsA("vtkImageData")):
        raise OptionTypeError(f"image is {seen(image)}: give VTK image data")
    data = image.GetPointData(), image.GetCellData()
    if scalars is not None:
        arrays = [each.GetArray(scalars) for each in data]
    else:
        arrays = [each.GetScalars() for each in data]
        if not any(arrays):
            arrays = [each.GetArray(names[0]) if len(names := _names(each)) == 1 else None
                      for each in data]  # fmt: skip
    if not any(arrays):
        raise GridError(_no_array(data, scalars))
    array, lattice = arrays[0] or arrays[1], ImageLattice.of_image(image, bool(arrays[0]))
    components, length = array.GetNumberOfComponents(), array.GetNumberOfTuples()
    what, samples = f"the array {array.GetName()!r} of {NAME}", prod(lattice.shape)
    if components != 1:
        raise GridError(f"{what} has {components} numbers per sample: give an array of one")
    if length != samples:
        raise GridError(f"{what} has {length:,} values for {samples:,} samples")
    return _volume_of(lattice, array)


def _volume_of(lattice: ImageLattice, array: Any) -> Volume:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    values = vtk_to_numpy(array).reshape(lattice.shape)
    return lattice.volume(values.dtype, lambda first, last: values[first:last])


def _names(data: Any) -> list[str]:
    arrays = (data.GetArray(number) for number in range(data.GetNumberOfArrays()))
    return [str(array.GetName()) for array in arrays if array]


def _no_array(data: tuple[Any, Any], scalars: str | None) -> str:
    points, cells = map(_names, data)
    listed = ", ".join([*points, *(f"{name} (cells)" for name in cells)])
    if not listed:
        return f"{NAME} holds no array of points or cells"
    if scalars is None:
        return f"{NAME} holds several arrays, {listed}: give scalars={(points or cells)[0]!r}, say"
    return f"{NAME} has no array {seen(scalars)}: it holds {listed}"


def _read(request: Request, reader: Any) -> Volume:
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow

    request.check_loads(request.path.stat().st_size, "VTK")
    said = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(said)  # this process reads no other file
    reader.SetFileName(str(request.path))
    reader.Update()
    image = reader.GetOutputDataObject(0)
    if image is None or "error" in said.GetOutput().lower():
        raise FileError("VTK finds it damaged, or truncated")
    data = image.GetPointData(), image.GetCellData()
    names = [[each.GetArrayName(i) for i in range(each.GetNumberOfArrays())] for each in data]
    name = request.choose([n for each in names for n in each], "array")
    arrays = [each.GetArray(n) for each, listed in zip(data, names) for n in listed]
    _check_text(request.path, sum(each.GetNumberOfValues() for each in arrays if each))
    of_points = name in names[0]
    lattice = _lattice(image, of_points, name, request.path)
    array = data[0 if of_points else 1].GetArray(name)
    shape = (array.GetNumberOfTuples(), array.GetNumberOfComponents())
    if shape != (prod(lattice.shape), 1):
        raise GridError(
            f"its array {name!r} has shape {shape} for {lattice.shape} samples: give one of "
            "a number each"
        )
    return _volume_of(lattice, array)


def _check_text(path: Path, promised: int) -> None:
    """Raise FileError if text holds fewer values than it promises: VTK makes others up."""
    text = path.read_bytes()
    if not re.match(rb".*\n.*\nASCII\s", text):
        return
    start = re.search(rb"^(?:POINT|CELL)_DATA ", text, re.M)
    values = BETWEEN.sub(b"", text[start.start() if start else 0 :])
    is_word = np.frombuffer(b" " + values, np.uint8) > ord(" ")
    follow = int((is_word[1:] & ~is_word[:-1]).sum())
    if follow < promised:
        raise FileError(f"it is truncated: {promised:,} values are promised, but {follow:,} follow")


def _lattice(image: Any, of_points: bool, name: str, path: Path) -> ImageLattice:
    if image.IsA("vtkImageData"):
        return ImageLattice.of_image(image, of_points)
    if not image.IsA("vtkRectilinearGrid"):
        raise GridError(
            f"it holds {image.GetClassName()}, no image data: sample its distances on a lattice, "
            "and write that as .vti"
        )
    from vtkmodules.util.numpy_support import vtk_to_numpy

    firsts, steps = [], []
    for axis in "XYZ":
        places = vtk_to_numpy(getattr(image, f"Get{axis}Coordinates")()).astype(np.float64)
        step = (places[-1] - places[0]) / max(len(places) - 1, 1)
        even = places[0] + step * np.arange(len(places))
        if not np.allclose(places, even, rtol=0, atol=EVEN * abs(step)):
            resample = RESAMPLE.format(path, path.stem, name)
            raise GridError(f"{path}: its coordinates along {axis.lower()} are uneven: {resample}")
        firsts.append(places[0])
        steps.append(step)
    return ImageLattice(image.GetExtent(), np.array(steps), np.array(firsts), XYZ, of_points)
