"""Writing refined fields: ``.npz``, ``.vdb``, ``.npy`` and ``.vti``, complete or not at all."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from ..errors import OptionError, OptionTypeError, seen
from ..options import check_path
from ..refine.field import FineField, fine_grid, lattice_planes, lattice_shape
from ..surface.cap import check_all_seen
from ..threads import check_fits
from .output import check_free, naming, replacing
from .sparse import write_sparse
from .vdb_writer import write_level_set


def write_npy(field: FineField, path: Path) -> None:
    """Write the whole fine lattice as NumPy's ``.npy``, in float32."""
    shape = lattice_shape(field.shape, field.factor)
    with path.open("wb") as file:
        npy.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": shape})
        for _, planes in lattice_planes(field):
            file.write(planes.astype("<f4", copy=False).tobytes())


def write_vti(field: FineField, path: Path) -> None:
    """Write the whole fine lattice as VTK image data, from memory: x is the fastest there."""
    grid = fine_grid(field)
    values = np.empty(grid.shape[::-1], "<f4")
    for first, planes in lattice_planes(field):
        values[:, :, first : first + len(planes)] = planes.transpose(2, 1, 0)
    extent = " ".join(f"0 {nodes - 1}" for nodes in grid.shape)
    place: dict[str, Any] = {
        "Origin": grid.origin,
        "Spacing": grid.spacing,
        "Direction": np.ravel(grid.direction),
    }
    placed = " ".join(f'{n}="{" ".join(f"{x:.17g}" for x in at)}"' for n, at in place.items())
    head = (
        '<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">\n'
        f'<ImageData WholeExtent="{extent}" {placed}>\n<Piece Extent="{extent}">\n'
        '<PointData Scalars="distance">\n<DataArray type="Float32" Name="distance" '
        'format="appended" offset="0"/>\n</PointData>\n</Piece>\n</ImageData>\n'
        '<AppendedData encoding="raw">\n_'
    )
    with path.open("wb") as file:
        file.write(head.encode("ascii") + struct.pack("<Q", values.nbytes))
        file.write(values.data)
        file.write(b"\n</AppendedData>\n</VTKFile>\n")


FIELD_TABLE: dict[str, Callable[[FineField, Path], None]] = {
    ".npz": write_sparse,
    ".vdb": write_level_set,
    ".npy": write_npy,
    ".vti": write_vti,
}
"""What writes a field to a path, by suffix: the last two write every node."""


def check_field_target(path: str | Path, *, force: bool = False) -> Path:
    """Return the path if a field can be written there; called before the work starts."""
    path = check_path(path, "path")
    if path.suffix.lower() not in FIELD_TABLE:
        raise OptionError(f"{path} is not a field file: give one of {', '.join(FIELD_TABLE)}")
    return check_free(path, force=force)


def check_field_fits(path: Path, shape: tuple[int, int, int]) -> None:
    """Raise OutOfMemoryError if the fine lattice must be held for a file, and does not fit."""
    if path.suffix.lower() == ".vti":
        size = " x ".join(map(str, shape))
        way_out = "write .npy, which is written plane by plane, or .npz, which is sparse"
        check_fits(4 * prod(shape), f"{path}, {size} values,", way_out)


@dataclass
class FieldFile:
    """A file of a field that appears when all is done; ``report`` is what was written, for JSON."""

    path: Path
    part: Path
    report: dict[str, Any] = field(default_factory=dict)

    def write(self, field: FineField) -> None:
        """Write the field; errors name the file."""
        check_all_seen(field.placed, "write the mesh alone, without its field")
        with naming(self.path):
            FIELD_TABLE[self.path.suffix.lower()](field, self.part)
        fine = fine_grid(field)
        place = {"spacing": list(fine.spacing), "origin": list(fine.origin)}
        self.report = {"path": str(self.path), "shape": list(fine.shape), **place}


@contextmanager
def saving_field(path: str | Path, *, force: bool = False) -> Iterator[FieldFile]:
    """Yield a file to write a field to; it appears at the end of the block, if that succeeds."""
    path = check_field_target(path, force=force)
    with replacing(path, force=force) as part:
        yield FieldFile(path, part)


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
    check_field_fits(path, lattice_shape(field.placed.shape, field.factor))
    with saving_field(path, force=force) as file:
        file.write(field)
