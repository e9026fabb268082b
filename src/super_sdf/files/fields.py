"""Refined fields to ``.npz``, ``.vdb``, ``.npy`` and ``.vti``, complete or not at all; and back.

docs/reference/files.md describes the keys of the sparse ``.npz``. It has the field's own numbers,
float32 in half voxels, so they come back as they were.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.lib.npyio import NpzFile

from ..errors import FileError, OptionError, OptionTypeError, check_modules, seen
from ..grid.interpret import Field
from ..grid.sdf_grid import SdfGrid
from ..options import OPTIONS, PATH
from ..refine.band import neighbour_table
from ..refine.bounds import SampleSpheres
from ..refine.field import FineField, FineLattice, fine_grid
from ..refine.nodes import share_parts
from ..surface.cap import check_all_seen, find_border_inside
from ..threads import check_fits
from .formats import check_regular_file
from .output import check_free, replacing
from .readers.vdb import write_level_set

VERSION = 2


def write_sparse(field: FineField, path: Path) -> None:
    """Write a field to an ``.npz`` file."""
    grid, side, none = field.grid, field.factor + 1, np.empty((0, 3), np.int32)
    arrays: dict[str, Any] = {
        "version": VERSION,
        "shape": field.shape,
        "factor": field.factor,
        "spacing": grid.spacing,
        "origin": grid.origin,
        "direction": grid.direction,
        "offset": field.offset,
        "unit": grid.voxel_size / 2,
        "leaves": field.leaves,
        "voxels": field.voxel_ijk,
        "values": field.blocks.T.reshape(-1, side, side, side),
        "samples": field.spheres.number,
        "sample_values": field.spheres.distance,
        "border_inside": find_border_inside(field) if field.leaves else none,
    }
    with path.open("wb") as file:
        np.savez(file, **arrays)


def write_npy(field: FineField, path: Path) -> None:
    """Write the whole fine lattice as NumPy's ``.npy``, in float32."""
    lattice = FineLattice(field)
    header = {"descr": "<f4", "fortran_order": False, "shape": lattice.shape}
    with path.open("wb") as file:
        npy.write_array_header_1_0(file, header)
        for plane in lattice:
            file.write(plane.astype("<f4", copy=False).tobytes())


def write_vti(field: FineField, path: Path) -> None:
    """Write the whole fine lattice as VTK image data, from memory: x is the fastest there."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    grid = fine_grid(field)
    way_out = "write .npy, which is written plane by plane, or .npz, which is sparse"
    check_fits(4 * prod(grid.shape), f"the refined field, {prod(grid.shape):,} values,", way_out)
    values = np.empty(grid.shape[::-1], np.float32)
    for x, plane in enumerate(FineLattice(field)):
        values[:, :, x] = plane.T
    image, array = vtkImageData(), numpy_to_vtk(values.ravel())
    image.SetDimensions(grid.shape)
    image.SetSpacing(grid.spacing)
    image.SetOrigin(grid.origin)
    image.SetDirectionMatrix(np.ravel(grid.direction).tolist())
    array.SetName("distance")
    image.GetPointData().SetScalars(array)
    writer = vtkXMLImageDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(image)
    writer.SetCompressorTypeToNone()
    writer.SetEncodeAppendedData(False)
    if not writer.Write():
        raise OSError("VTK cannot write it")


FIELD_TABLE: dict[str, Callable[[FineField, Path], None]] = {
    ".npz": write_sparse,
    ".vdb": write_level_set,
    ".npy": write_npy,
    ".vti": write_vti,
}
"""What writes a field to a path, by suffix: the last two write every node."""


@contextmanager
def saving_field(
    path: str | Path, *, force: bool = False
) -> Iterator[Callable[[FineField], dict[str, Any]]]:
    """Yield what writes a field, and returns facts of the file, which appears after the block."""
    path = Path(PATH.check(path, "path"))
    kind = path.suffix.lower()
    if kind not in FIELD_TABLE:
        raise OptionError(f"{path} is not a field file: give one of {', '.join(FIELD_TABLE)}")
    if kind == ".vti":
        check_modules("writing .vti", "vti")
    with replacing(check_free(path, force=force), force=force) as part:

        def write(field: FineField) -> dict[str, Any]:
            check_all_seen(field.grid, "write the mesh alone, without its field")
            if kind != ".npz" and field.border_inside is not None:
                said = f"{kind} needs the coarse samples, which a field from a file has not"
                raise FileError(f"{path} cannot be written: {said}; write .npz")
            FIELD_TABLE[kind](field, part)
            fine = fine_grid(field)
            place = {"spacing": list(fine.spacing), "origin": list(fine.origin)}
            return {"path": str(path), "shape": list(fine.shape), **place}

        yield write


def write_field(field: FineField, path: str | Path, *, force: bool = False) -> None:
    """Write a refined field to a file, in the format of its suffix.

    Parameters
    ----------
    field : FineField
        From ``upsample``.
    path : path
        The file: .npz for the sparse field, which ``read_field`` reads back; .vdb for a level set
        of OpenVDB; .npy or .vti for the whole fine lattice: see docs/reference/files.md.
    force : bool
        Replace an existing file.

    Raises
    ------
    OptionError, FileError, OutOfMemoryError
        If the suffix is unknown; if the file cannot be written, VTK is missing for a .vti, or the
        field is from a file and the format is not .npz; if a .vti would not fit in memory.
    """
    if not isinstance(field, FineField):
        raise OptionTypeError(f"field is {seen(field)}: give one from upsample(grid, network)")
    with saving_field(path, force=force) as write:
        write(field)


def read_field(path: str | Path) -> FineField:
    """Read a refined field from a ``.npz`` file that ``--save-field`` or ``write_field`` wrote.

    ``extract_mesh`` of the field gives the same mesh, byte for byte. The ``grid`` of the field has
    shape, spacing and origin, but its samples are NaN.

    Parameters
    ----------
    path : path
        The file; docs/reference/files.md describes its keys.

    Raises
    ------
    FileError
        If the file is missing, damaged, or not a refined field.
    """
    path = check_regular_file(PATH.check(path, "path"))
    try:
        with path.open("rb") as file, NpzFile(file) as archive:
            if (version := archive["version"]) != VERSION:
                raise ValueError(f"its version is {version}, and this program reads {VERSION}")
            return _field_of({key: archive[key] for key in archive.files})
    except MemoryError:
        raise
    except Exception as error:  # zipfile and NumPy raise over ten kinds of error on damaged files
        reason = str(error).splitlines() or [type(error).__name__]
        raise FileError(f"{path} cannot be read as a refined field: {reason[0]}") from None


def _field_of(arrays: dict[str, Any]) -> FineField:
    """Return the field of a file's arrays; an error of any kind if they make none."""
    factor, (nx, ny, nz) = OPTIONS["factor"].check(int(arrays["factor"])), arrays["shape"].tolist()
    shape = nx, ny, nz
    grid = SdfGrid.trusted(
        np.broadcast_to(np.float32(np.nan), shape),
        *(arrays["spacing"], arrays["origin"]),
        direction=arrays["direction"],
        extremes=(-math.inf, math.inf),
        field=Field(own_lattice=True),  # it is on the lattice of the field already
    )
    voxels, border = (arrays[key].astype(np.int32) for key in ("voxels", "border_inside"))
    samples, distances = arrays["samples"].astype(np.int64), arrays["sample_values"]
    flat = (np.ravel_multi_index(tuple(each.T), shape) for each in (voxels, border))
    if any((np.diff(numbers) <= 0).any() for numbers in (*flat, samples)):
        raise ValueError("its voxels are not in order")
    values = arrays["values"].reshape(len(voxels), (factor + 1) ** 3)
    blocks = np.ascontiguousarray(values.T, np.float32)
    parts = share_parts(neighbour_table(voxels, shape))
    spheres = SampleSpheres(shape, samples, distances.reshape(len(samples)))
    offset, leaves = float(arrays["offset"]), bool(arrays["leaves"])
    field = FineField(shape, factor, voxels, blocks, parts, grid, offset, spheres, leaves, border)
    if not (field.values[field.numbers] == values).all():  # the mesh of others would have holes
        raise ValueError("blocks differ at nodes that they share")
    return field
