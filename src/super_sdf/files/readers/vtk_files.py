"""Legacy ``.vtk`` and ``.vtkhdf`` files, with VTK: image data, or rectilinear with even steps."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import FileError, GridError
from ..volume import XYZ, ImageLattice, Request, Volume
from .choosing import choose_member

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


def read_vtk(request: Request) -> Volume:
    """Read a legacy file, in text or binary."""
    from vtkmodules.vtkIOLegacy import vtkDataSetReader

    reader = vtkDataSetReader()
    for each in ("Scalars", "Fields"):
        getattr(reader, f"ReadAll{each}On")()
    return _read(request, reader)


def read_vtkhdf(request: Request) -> Volume:
    """Read a ``.vtkhdf`` file."""
    from vtkmodules.vtkIOHDF import vtkHDFReader

    return _read(request, vtkHDFReader())


def _read(request: Request, reader: Any) -> Volume:
    """Return the array that a reader of VTK finds in a file."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
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
    name = choose_member(request, [n for each in names for n in each], "array")
    of_points = name in names[0]
    _check_text(
        request.path,
        sum(
            each.GetArray(n).GetNumberOfValues()
            for each, listed in zip(data, names)
            for n in listed
            if each.GetArray(n)
        ),
    )
    lattice = _lattice(image, of_points, name, request.path)
    array = data[0 if of_points else 1].GetArray(name)
    values = vtk_to_numpy(array)
    if values.shape != (np.prod(lattice.shape),):
        raise GridError(
            f"its array {name!r} has shape {values.shape} for {lattice.shape} samples: give one of "
            "a number each"
        )
    values = values.reshape(lattice.shape)
    return lattice.volume(values.dtype, lambda first, last: values[first:last])


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
    """Return where the samples lie.

    Raises
    ------
    GridError
        If they are no lattice, with the command that makes one.
    """
    if image.IsA("vtkImageData"):
        return ImageLattice.of_image(image, of_points)
    if not image.IsA("vtkRectilinearGrid"):
        raise GridError(
            f"it holds {image.GetClassName()}, no image data: sample its distances on a lattice, "
            "and write that as .vti"
        )
    from vtkmodules.util.numpy_support import vtk_to_numpy

    resample = RESAMPLE.format(path, path.stem, name)
    firsts, steps = [], []
    for axis in "XYZ":
        places = vtk_to_numpy(getattr(image, f"Get{axis}Coordinates")()).astype(np.float64)
        step = (places[-1] - places[0]) / max(len(places) - 1, 1)
        even = places[0] + step * np.arange(len(places))
        if not np.allclose(places, even, rtol=0, atol=EVEN * abs(step)):
            raise GridError(f"{path}: its coordinates along {axis.lower()} are uneven: {resample}")
        firsts.append(places[0])
        steps.append(step)
    return ImageLattice(image.GetExtent(), np.array(steps), np.array(firsts), XYZ, of_points)
