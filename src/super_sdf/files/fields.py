"""Refined fields to ``.npz``, ``.vdb``, ``.npy`` and ``.vti``, complete or not at all; and back.

docs/reference/files.md describes the keys of the sparse ``.npz``. Its values are in world units and
exact: as float32 if the spacing is a power of two, since the field's own are float32 in half
voxels, else as float64.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..errors import FileError, GridError, OptionError, OptionTypeError, check_modules, seen
from ..grid.interpret import Field
from ..grid.samples import SamplePlanes, in_blocks
from ..grid.sdf_grid import SdfGrid
from ..options import OPTIONS, check_path
from ..refine.band import neighbour_table
from ..refine.bounds import SampleSpheres
from ..refine.field import FineField, FineLattice, fine_grid, lattice_shape
from ..refine.nodes import share_parts
from ..surface.cap import check_all_seen, find_border_inside
from ..threads import check_fits
from .formats import check_regular_file
from .output import check_free, naming, replacing
from .readers.vdb import write_level_set

VERSION = 1
PLANES = 16  # of the fine lattice at a time
# Which kinds of numbers each array has, and its shape, where None is any length.
ARRAYS: dict[str, tuple[str, tuple[int | None, ...]]] = {
    **dict.fromkeys(("version", "factor"), ("iu", ())),
    **dict.fromkeys(("spacing", "origin"), ("f", (3,))),
    **dict.fromkeys(("voxels", "sample_voxels", "border_inside"), ("i", (None, 3))),
    **{"shape": ("iu", (3,)), "direction": ("f", (3, 3)), "offset": ("f", ()), "leaves": ("b", ())},
    **{"values": ("f", (None,) * 4), "sample_distances": ("f", (None,))},
}


def write_sparse(field: FineField, path: Path) -> None:
    """Write a field to an ``.npz`` file."""
    grid, side, none = field.placed, field.factor + 1, np.empty((0, 3), np.int32)
    # float32 is exact where world units only change exponents
    is_power = math.frexp(grid.voxel_size)[0] == 0.5 and 1e-20 < grid.voxel_size < 1e20
    exact = np.dtype("<f4" if is_power else "<f8")
    samples = field.spheres or SampleSpheres(field.shape, np.empty(0, int), np.empty(0, np.float32))
    arrays: dict[str, Any] = {
        "version": VERSION,
        "shape": field.shape,
        "factor": field.factor,
        "spacing": grid.spacing,
        "origin": grid.origin,
        "direction": grid.direction,
        "offset": field.offset,
        "leaves": field.leaves,
        "values": field.in_world_units(field.blocks.T).astype(exact).reshape(-1, side, side, side),
        "voxels": field.voxel_ijk,
        "sample_voxels": np.stack(np.unravel_index(samples.number, field.shape), 1).astype("i4"),
        "sample_distances": field.in_world_units(samples.distance).astype(exact),
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

    grid, lattice = fine_grid(field), FineLattice(field)
    values = np.empty(grid.shape[::-1], np.float32)
    for planes in in_blocks(lattice, PLANES):
        values[:, :, planes] = lattice[planes].transpose(2, 1, 0)
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


@dataclass
class FieldFile:
    """A file of a field that appears when all is done; ``report`` is what was written, for JSON."""

    path: Path
    part: Path
    report: dict[str, Any] = field(default_factory=dict)

    def check_fits(self, shape: tuple[int, int, int], factor: int) -> None:
        """Raise OutOfMemoryError if the fine lattice must be held, and does not fit."""
        if self.path.suffix.lower() == ".vti":
            nodes = lattice_shape(shape, factor)
            way_out = "write .npy, which is written plane by plane, or .npz, which is sparse"
            size = " x ".join(map(str, nodes))
            check_fits(4 * prod(nodes), f"{self.path}, {size} values,", way_out)

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
    path = check_path(path, "path")
    if path.suffix.lower() not in FIELD_TABLE:
        raise OptionError(f"{path} is not a field file: give one of {', '.join(FIELD_TABLE)}")
    if path.suffix.lower() == ".vti":
        check_modules("writing .vti", "vti")
    with replacing(check_free(path, force=force), force=force) as part:
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
        If the suffix is unknown, or voxels are too small or too large for OpenVDB.
    FileError
        If the file exists and ``force`` is not set, or cannot be written; if the field is one from
        a file and the format is not .npz: others take the coarse samples; if VTK is missing for a
        .vti.
    OutOfMemoryError
        If a .vti would not fit in memory.
    """
    if not isinstance(field, FineField):
        raise OptionTypeError(f"field is {seen(field)}: give one from upsample(grid, network)")
    with saving_field(path, force=force) as file:
        file.check_fits(field.placed.shape, field.factor)
        file.write(field)


class NoSamples(SamplePlanes):
    """Stands for the coarse samples of a field that was read from a file, which has none."""

    dtype = np.dtype(np.float32)

    def __init__(self, shape: tuple[int, ...], name: str) -> None:
        self.shape, self.name = shape, name

    def read(self, first: int, last: int) -> NDArray[Any]:
        """Raise FileError: there is nothing to read."""
        said = f"{self.name} holds the refined field without the coarse samples"
        raise FileError(f"{said}: read those from their own file")


def read_field(path: str | Path) -> FineField:
    """Read a refined field from a ``.npz`` file that ``--save-field`` or ``write_field`` wrote.

    ``extract_mesh`` makes the same mesh of it, byte for byte. Its ``grid`` has shape, spacing and
    origin, but no samples.

    Parameters
    ----------
    path : path
        The file; docs/reference/files.md describes its keys.

    Raises
    ------
    FileError, OutOfMemoryError, OptionError
        If the file is missing, damaged, or holds something else; if the field does not fit in
        memory; if the suffix is not .npz.
    """
    path = check_path(path, "path")
    if path.suffix.lower() != ".npz":
        raise OptionError(f"{path} is no sparse field: give .npz")
    check_regular_file(path)
    try:
        return _field_of(_read_arrays(path), path)
    except (FileError, MemoryError):
        raise
    except (GridError, OptionError) as error:  # a factor or a place that cannot be, say
        raise FileError(f"{path} is no refined field: {error}") from None
    except Exception as error:  # zipfile and NumPy raise over ten kinds of error on damaged files
        reason = str(error).splitlines() or [type(error).__name__]
        raise FileError(f"{path} cannot be read as a refined field: {reason[0]}") from None


def _read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file by their keys, which have the kinds and shapes of ``ARRAYS``."""
    if not zipfile.is_zipfile(path):  # NumPy would take it for a pickle
        raise GridError("it is no .npz archive")
    with np.load(path, allow_pickle=False) as archive:
        if missing := [key for key in ARRAYS if key not in archive.files]:
            raise GridError(f"it has no key {missing[0]!r}")
        need = 3 * sum(each.file_size for each in archive.zip.infolist())
        check_fits(need, f"{path}, as a field,", "read it on a larger machine")
        if archive["version"] != VERSION:
            said = f"has format version {archive['version']}, this program reads {VERSION}"
            raise FileError(f"{path} {said}: use a newer one")
        arrays = {key: archive[key] for key in ARRAYS}
    for key, (kinds, shape) in ARRAYS.items():
        array = arrays[key]
        is_like = all(want in (None, n) for want, n in zip(shape, array.shape))
        if array.dtype.kind not in kinds or array.ndim != len(shape) or not is_like:
            said = f"{array.dtype} of shape {array.shape}"
            raise FileError(f"{path}[{key}] is {said}: it belongs to no refined field")
    return arrays


def _field_of(arrays: dict[str, NDArray[Any]], path: Path) -> FineField:
    """Return the field of arrays, which are checked: a mesh of others would have holes."""

    def damaged(key: str, said: str) -> FileError:
        return FileError(f"{path}[{key}] is damaged: {said}")

    factor, (nx, ny, nz) = OPTIONS["factor"].check(int(arrays["factor"])), arrays["shape"].tolist()
    shape, side = (nx, ny, nz), factor + 1
    if min(shape) < 2:
        raise GridError(f"its grid has the shape {shape}")
    grid = SdfGrid.trusted(
        NoSamples(shape, str(path)),
        *(arrays["spacing"], arrays["origin"]),
        direction=arrays["direction"],
        extremes=(-math.inf, math.inf),
        field=Field(own_lattice=True),  # it is on the lattice of the field already
    )
    for key in ("voxels", "sample_voxels", "border_inside"):
        number = arrays[key].astype(np.int64) @ (ny * nz, nz, 1)
        if (arrays[key] < 0).any() or (arrays[key] >= shape).any() or (np.diff(number) <= 0).any():
            raise damaged(key, "its voxels are not in order in the grid")
        arrays[key] = np.ascontiguousarray(arrays[key], np.int32)
    voxels, values = arrays["voxels"], arrays["values"]
    if values.shape != (len(voxels), side, side, side) or not len(voxels):
        raise damaged("values", f"it has the shape {values.shape} for {len(voxels)} voxels")

    def in_half_voxels(world: NDArray[Any]) -> FloatArray:  # the float32 numbers that were written
        half = np.divide(world, grid.voxel_size / 2, dtype=np.float64)
        return np.ascontiguousarray(half, np.float32)

    blocks = in_half_voxels(values.reshape(len(voxels), -1).T)
    plain = FineField(shape, factor, voxels, blocks, share_parts(neighbour_table(voxels, shape)))
    if not (plain.values[plain.numbers] == blocks.T).all():  # NaN is not, either
        raise damaged("values", "blocks differ at nodes that they share")
    distances = in_half_voxels(arrays["sample_distances"])
    return replace(
        plain,
        spheres=SampleSpheres(shape, arrays["sample_voxels"] @ (ny * nz, nz, 1), distances),
        grid=grid,
        offset=float(arrays["offset"]),
        leaves=bool(arrays["leaves"]),
        border_inside=arrays["border_inside"],
    )
