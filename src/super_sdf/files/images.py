"""VTK image data in memory, such as PyVista and ParaView hold it: read as a ``.vti`` file is."""

from __future__ import annotations

from math import prod
from typing import TYPE_CHECKING, Any

from ..errors import GridError, OptionTypeError, seen
from ..grid.sdf_grid import SdfGrid, make_grid
from ..options import ReadOptions, Values
from .grids import unpacking_room
from .volume import ImageLattice, take

if TYPE_CHECKING:
    from typing_extensions import Unpack

NAME = "the image"  # in error messages
PLACE_OF_FILE = {"spacing": None, "origin": None, "direction": None}  # nothing replaces its own


def grid_from_image(
    image: Any,
    scalars: str | None = None,
    *,
    max_memory: int | None = None,
    **values: Unpack[Values],
) -> SdfGrid:
    """Make a grid of VTK image data: the one that ``read_grid`` makes of it as a ``.vti`` file.

    Parameters
    ----------
    image : vtkImageData
        Or a subclass, such as ``pyvista.ImageData``. Its spacing, origin, extent and direction
        place the samples in the world.
    scalars : str, optional
        The name of an array of numbers at its points or, if no array there has that name, in its
        cells; samples in cells are at their centres. Default: the active scalars of the points,
        else of the cells, else the only array.
    inside, field, label, level, scale
        What the values are; see ``make_grid``.
    max_memory : int, optional
        Bytes that this process may hold in all. Default: a share of the free memory.

    Returns
    -------
    SdfGrid
        With a copy of the samples, in a temporary file if they are large.

    Raises
    ------
    GridError
        If there is no such array, or several and none is named; if its values are not a signed
        distance grid.
    OptionError
        If ``inside`` or ``field`` is unknown, or ``image`` is no image data (``OptionTypeError``).
    """
    ReadOptions(**values)  # checks them
    if not (hasattr(image, "IsA") and image.IsA("vtkImageData")):
        raise OptionTypeError(f"image is {seen(image)}: give VTK image data")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    array, of_points = _choose_array(image, scalars)
    lattice = ImageLattice.of_image(image, of_points)
    _check_array(array, prod(lattice.shape))
    samples = vtk_to_numpy(array).reshape(lattice.shape)
    volume = lattice.volume(samples.dtype, lambda first, last: samples[first:last])
    found = take(volume, NAME, unpacking_room(max_memory), PLACE_OF_FILE)
    return make_grid(**found, **values)


def _choose_array(image: Any, scalars: str | None) -> tuple[Any, bool]:
    """Return an array, and whether it is one of points."""
    data = image.GetPointData(), image.GetCellData()
    if scalars is not None:
        found = [each.GetArray(scalars) for each in data]
    else:
        found = [each.GetScalars() for each in data]
        found = found if any(found) else [_only_array(each) for each in data]
    if not any(found):
        raise GridError(_no_array(data, scalars))
    return (found[0], True) if found[0] else (found[1], False)


def _names(data: Any) -> list[str]:
    """Return the names of the arrays of numbers."""
    arrays = (data.GetArray(number) for number in range(data.GetNumberOfArrays()))
    return [str(array.GetName()) for array in arrays if array]


def _only_array(data: Any) -> Any:
    """Return the array if there is only one."""
    names = _names(data)
    return data.GetArray(names[0]) if len(names) == 1 else None


def _no_array(data: tuple[Any, Any], scalars: str | None) -> str:
    """Return what is wrong if no array was found."""
    points, cells = map(_names, data)
    listed = ", ".join([*points, *(f"{name} (cells)" for name in cells)])
    if not listed:
        return f"{NAME} holds no array of points or cells"
    if scalars is None:
        return f"{NAME} holds several arrays, {listed}: give scalars={(points or cells)[0]!r}, say"
    return f"{NAME} has no array {seen(scalars)}: it holds {listed}"


def _check_array(array: Any, samples: int) -> None:
    """Raise GridError unless an array has one number for each sample."""
    components, length = array.GetNumberOfComponents(), array.GetNumberOfTuples()
    what = f"the array {array.GetName()!r} of {NAME}"
    if components != 1:
        raise GridError(f"{what} has {components} numbers per sample: give an array of one")
    if length != samples:
        raise GridError(f"{what} has {length:,} values for {samples:,} samples")
