"""Writing refined fields: ``.npz``, ``.vdb``, ``.npy`` and ``.vti``, complete or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from ..errors import OptionError, OptionTypeError, OutOfMemoryError, WriteError, seen
from .output import check_free, free_space, little_endian, naming, replacing
from ..grid.sdf_grid import SdfGrid
from ..machine.extras import check_modules
from ..machine.memory import held_memory, in_words, memory_bound
from ..options import check_path
from ..surface.cap import check_all_seen
from ..refine.field import FineField, fine_grid, lattice_shape, lattice_planes
from .sparse import SparseWriter
from .level_set import VdbWriter

BYTES = 4  # of a value
Shape = tuple[int, int, int]


class NpyWriter:
    """Writes the planes of the fine lattice, slab by slab."""

    def __init__(self, part: Path, shape: Shape, files: ExitStack) -> None:
        self.file: IO[bytes] = files.enter_context(part.open("wb"))
        header = {"descr": "<f4", "fortran_order": False, "shape": shape}
        npy.write_array_header_1_0(self.file, header)

    def add(self, field: FineField) -> None:
        """Write the planes of nodes of a slab."""
        for _, planes in lattice_planes(field):
            self.file.write(little_endian(planes))

    def finish(self) -> None:
        """Complete the file."""
        self.file.close()


class VtiWriter:
    """Gathers the fine lattice in memory and writes it as VTK image data at the end.

    The memory is filled at once, so that the plan of the work counts it.
    """

    def __init__(self, part: Path, shape: Shape, files: ExitStack) -> None:
        self.part = part
        self.values = np.full(shape[::-1], np.float32(np.inf))  # x is the fastest
        self.grid: SdfGrid | None = None

    def add(self, field: FineField) -> None:
        """Copy the planes of nodes of a slab."""
        self.grid = fine_grid(field)
        for first, planes in lattice_planes(field):
            self.values[:, :, first : first + len(planes)] = planes.transpose(2, 1, 0)

    def finish(self) -> None:
        """Write the file."""
        from vtkmodules.util.numpy_support import numpy_to_vtk
        from vtkmodules.vtkCommonCore import vtkObject
        from vtkmodules.vtkCommonDataModel import vtkImageData
        from vtkmodules.vtkCommonMisc import vtkErrorCode
        from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

        image = vtkImageData()
        image.SetDimensions(*self.values.shape[::-1])
        if self.grid:
            image.SetSpacing(*self.grid.spacing)
            image.SetOrigin(*self.grid.origin)
            image.SetDirectionMatrix(np.ravel(self.grid.direction).tolist())
        array = numpy_to_vtk(self.values.reshape(-1))
        array.SetName("distance")
        image.GetPointData().SetScalars(array)
        writer = vtkXMLImageDataWriter()
        writer.SetFileName(str(self.part))
        writer.SetInputData(image)
        writer.EncodeAppendedDataOff()
        writer.SetCompressorTypeToNone()
        logs = vtkObject.GetGlobalWarningDisplay()
        vtkObject.GlobalWarningDisplayOff()
        written = writer.Write()
        vtkObject.SetGlobalWarningDisplay(logs)
        if not written:
            reason = vtkErrorCode.GetStringFromErrorCode(writer.GetErrorCode())
            raise OSError(f"VTK says {reason!r}")


WRITERS: dict[str, Any] = {
    ".npz": SparseWriter,
    ".vdb": VdbWriter,
    ".npy": NpyWriter,
    ".vti": VtiWriter,
}
"""Each takes the path, the nodes along each axis of the lattice, and what closes files at the end.

A writer has the methods ``add`` and ``finish``. Those not in ``SPARSE`` write every node.
"""
FIELD_SUFFIXES = tuple(WRITERS)
SPARSE = (".npz", ".vdb")


def check_field_target(path: str | Path, *, force: bool = False) -> Path:
    """Return the path if a field can be written there; called before the work starts."""
    path = check_path(path, "path")
    suffix = path.suffix.lower()
    if suffix not in WRITERS:
        raise OptionError(f"{path} is not a field file: give one of {', '.join(FIELD_SUFFIXES)}")
    if suffix == ".vti":
        check_modules("Writing .vti", "vti")
    return check_free(path, force=force)


def check_field_fits(path: Path, shape: Shape, max_memory: int | None = None) -> None:
    """Raise an error if a dense file of a lattice does not fit on the disk, or .vti in memory."""
    suffix = path.suffix.lower()
    if suffix in SPARSE:
        return
    size = BYTES * prod(shape)
    what = f"{' x '.join(map(str, shape))} values take {in_words(size)}"
    free, bound = free_space(path), memory_bound(max_memory)
    if size > free:
        raise WriteError(
            f"{path} cannot be written: {what}, {in_words(free)} are free there; write .npz, which "
            "is sparse"
        )
    left = None if bound is None else bound - (held_memory() or 0)
    if suffix == ".vti" and left is not None and size > left:
        raise OutOfMemoryError(
            f"{path} cannot be written: {what} of memory, {in_words(max(left, 0))} are left; "
            "write .npy, which is written plane by plane, or .npz, which is sparse"
        )


class FieldFile:
    """A file of a field that is being written; errors name it."""

    def __init__(self, path: Path, shape: Shape, writer: Any) -> None:
        self.path, self.shape, self.writer = path, shape, writer
        self.place: dict[str, Any] = {}  # spacing and origin of the lattice, once there is a field

    def add(self, field: FineField) -> None:
        """Write the own planes of a slab's field."""
        if not self.place:
            check_all_seen(field.placed, "write the mesh alone, without its field")
            fine = fine_grid(field)
            self.place = {"spacing": list(fine.spacing), "origin": list(fine.origin)}
        with naming(self.path):
            self.writer.add(field)

    def finish(self) -> None:
        """Complete the file."""
        with naming(self.path):
            self.writer.finish()

    def report(self) -> dict[str, Any]:
        """Return what was written, for JSON."""
        return {"path": str(self.path), "shape": list(self.shape), **self.place}


@contextmanager
def saving_field(path: Path, shape: Shape, *, force: bool = False) -> Iterator[FieldFile]:
    """Yield a file to write a field to; it appears at the end, if ``finish`` was called.

    ``shape`` is the number of nodes of the fine lattice along each axis.
    """
    with replacing(path, force=force) as part, ExitStack() as files:
        yield FieldFile(path, shape, WRITERS[path.suffix.lower()](part, shape, files))


def write_field(field: FineField, path: str | Path, *, force: bool = False) -> None:
    """Write a refined field to a file, in the format of its suffix.

    Parameters
    ----------
    field : FineField
        From ``upsample``.
    path : path
        The file: .npz for the sparse field, which ``read_field`` reads back; .vdb for a level set
        of OpenVDB; .npy or .vti for the whole fine lattice. docs/reference/files.md describes them.
    force : bool
        Replace an existing file.

    Raises
    ------
    OptionError
        If the suffix is unknown, or the field was made without its grid; if voxels are too small
        or too large for OpenVDB.
    FileError
        If the file exists and ``force`` is not set, or cannot be written; if the field is one from
        a file and the format is not .npz: others take the coarse samples.
    OutOfMemoryError
        If a .vti would not fit in memory.
    """
    if not isinstance(field, FineField):
        raise OptionTypeError(f"field is {seen(field)}: give one from upsample(grid, network)")
    path = check_field_target(path, force=force)
    shape = lattice_shape(field.placed.shape, field.factor)
    check_field_fits(path, shape)
    with saving_field(path, shape, force=force) as writer:
        writer.add(field)
        writer.finish()
