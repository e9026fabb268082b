"""Refined fields to ``.npz``, ``.vdb``, ``.npy`` and ``.vti``, complete or not at all; and back.

docs/reference/files.md describes the keys of the sparse ``.npz``. Its values are in world units and
exact: as float32 if the spacing is a power of two, since the field's own are float32 in half
voxels, else as float64.
"""

from __future__ import annotations

import math
import struct
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..errors import FileError, OptionError, OptionTypeError, SuperSdfError, seen
from ..grid.interpret import Field
from ..grid.samples import SamplePlanes, in_blocks
from ..grid.sdf_grid import SdfGrid
from ..options import OPTIONS, check_path
from ..refine.band import neighbour_table
from ..refine.field import FineField, FineLattice, SampleSpheres, fine_grid, lattice_shape
from ..refine.nodes import share_parts
from ..surface.cap import check_all_seen, find_border_inside
from ..threads import check_fits
from .output import check_free, naming, replacing
from .regular import check_regular_file
from .vdb_writer import write_level_set

VERSION = 1
CHUNK = 1 << 20  # values at a time
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
    """Write a field to an ``.npz`` file, its values block by block."""
    grid, side, count = field.placed, field.factor + 1, len(field.voxel_ijk)
    # float32 is exact where world units only change exponents
    is_power = math.frexp(grid.voxel_size)[0] == 0.5 and 1e-20 < grid.voxel_size < 1e20
    exact, none = np.dtype("<f4" if is_power else "<f8"), np.empty((0, 3), np.int32)
    samples, distances = none, np.empty(0)
    if field.spheres is not None:
        samples = field.spheres.voxel_ijk
        distances = field.in_world_units(field.spheres.distance)
    arrays: dict[str, Any] = {
        "version": VERSION,
        "shape": field.shape,
        "factor": field.factor,
        "spacing": grid.spacing,
        "origin": grid.origin,
        "direction": grid.direction,
        "offset": field.offset,
        "leaves": field.leaves,
        "values": None,  # in chunks
        "voxels": field.voxel_ijk,
        "sample_voxels": samples,
        "sample_distances": distances.astype(exact),
        "border_inside": find_border_inside(field) if field.leaves else none,
    }
    header = {"descr": exact.str, "fortran_order": False, "shape": (count, side, side, side)}
    step = max(CHUNK // side**3, 1)
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                if array is not None:
                    npy.write_array(member, np.asarray(array))
                    continue
                npy.write_array_header_1_0(member, header)
                for first in range(0, count, step):
                    blocks = field.block_distances(slice(first, min(first + step, count)))
                    member.write(blocks.astype(exact).tobytes())


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
    grid, lattice = fine_grid(field), FineLattice(field)
    values = np.empty(grid.shape[::-1], "<f4")
    for planes in in_blocks(lattice, PLANES):
        values[:, :, planes] = lattice[planes].transpose(2, 1, 0)
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
        If the suffix is unknown, or voxels are too small or too large for OpenVDB.
    FileError
        If the file exists and ``force`` is not set, or cannot be written; if the field is one from
        a file and the format is not .npz: others take the coarse samples.
    OutOfMemoryError
        If a .vti would not fit in memory.
    """
    if not isinstance(field, FineField):
        raise OptionTypeError(f"field is {seen(field)}: give one from upsample(grid, network)")
    path = check_field_target(path, force=force)
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
    except SuperSdfError as error:  # a factor or a place that cannot be
        raise FileError(f"{path} is no refined field: {error}") from None
    except Exception as error:  # zipfile and NumPy raise over ten kinds of error on damaged files
        reason = str(error).splitlines() or [type(error).__name__]
        raise FileError(f"{path} cannot be read as a refined field: {reason[0]}") from None


def _read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file by their keys, which have the kinds and shapes of ``ARRAYS``."""
    arrays: dict[str, NDArray[Any]] = {}
    with zipfile.ZipFile(path) as archive:
        sizes = {each.filename.removesuffix(".npy"): each.file_size for each in archive.infolist()}
        missing = [key for key in ARRAYS if key not in sizes]
        if missing:
            raise FileError(f"{path} is no refined field: it has no key {missing[0]!r}")
        need = 3 * sum(sizes[key] for key in ARRAYS)
        check_fits(need, f"{path}, as a field,", "read it on a larger machine")
        for key, (kinds, shape) in ARRAYS.items():
            with archive.open(f"{key}.npy") as member:
                array = npy.read_array(member, allow_pickle=False)
            if key == "version" and array != VERSION:
                said = f"has format version {array}, this program reads {VERSION}"
                raise FileError(f"{path} {said}: use a newer one")
            is_like = all(want in (None, n) for want, n in zip(shape, array.shape))
            if array.dtype.kind not in kinds or array.ndim != len(shape) or not is_like:
                said = f"{array.dtype} of shape {array.shape}"
                raise FileError(f"{path}[{key}] is {said}: it belongs to no refined field")
            arrays[key] = array
    return arrays


def _field_of(arrays: dict[str, NDArray[Any]], path: Path) -> FineField:
    """Return the field of arrays, which are checked: a mesh of others would have holes."""
    factor, shape = OPTIONS["factor"].check(int(arrays["factor"])), tuple(map(int, arrays["shape"]))
    if min(shape) < 2:
        raise FileError(f"{path} is no refined field: its grid has the shape {shape}")
    grid = SdfGrid.trusted(
        NoSamples(shape, str(path)),
        *(arrays["spacing"], arrays["origin"]),
        direction=arrays["direction"],
        extremes=(-math.inf, math.inf),
        field=Field(own_lattice=True),  # it is on the lattice of the field already
    )
    for key in ("voxels", "sample_voxels", "border_inside"):
        number = arrays[key].astype(np.int64) @ (shape[1] * shape[2], shape[2], 1)
        if (arrays[key] < 0).any() or (arrays[key] >= shape).any() or (np.diff(number) <= 0).any():
            raise FileError(f"{path}[{key}] is damaged: its voxels are not in order in the grid")
        arrays[key] = np.ascontiguousarray(arrays[key], np.int32)
    voxels, values, border = (arrays[key] for key in ("voxels", "values", "border_inside"))
    samples, distances = arrays["sample_voxels"], arrays["sample_distances"]
    parts, side = share_parts(neighbour_table(voxels, shape)), factor + 1
    at_border = ((border == 0) | (border == np.array(shape) - 1)).any(1)
    numbers = (np.ravel_multi_index(tuple(ijk.T), shape) for ijk in (border, voxels))
    is_whole = values.shape == (len(voxels), side, side, side) and len(voxels) > 0
    half = _in_half_voxels(values.reshape(len(voxels), -1), grid) if is_whole else values
    blocks = np.ascontiguousarray(half.T)
    for key, is_sound, fault in (
        ("values", is_whole, f"it has the shape {values.shape} for {len(voxels)} voxels"),
        ("sample_distances", len(samples) == len(distances), f"{len(samples):,} are wanted"),
        ("values", np.isfinite(blocks).all(), "not all values are finite"),
        (
            "border_inside",
            at_border.all() and not np.isin(*numbers).any(),
            "not all are border voxels without a block",
        ),
    ):
        if not is_sound:
            raise FileError(f"{path}[{key}] is damaged: {fault}")
    three = (shape[0], shape[1], shape[2])
    plain = FineField(three, factor, voxels, blocks, parts)
    if (plain.values[plain.numbers] != blocks.T).any():
        raise FileError(f"{path}[values] is damaged: blocks differ at nodes that they share")
    return FineField(
        *(three, factor, voxels, blocks, parts),
        spheres=SampleSpheres(three, samples, _in_half_voxels(distances, grid)),
        grid=grid,
        offset=float(arrays["offset"]),
        leaves=bool(arrays["leaves"]),
        border_inside=border,
    )


def _in_half_voxels(world: NDArray[Any], grid: SdfGrid) -> FloatArray:
    """Return distances in world units in half voxels: the float32 numbers that were written."""
    half: FloatArray = np.divide(world, grid.voxel_size / 2, dtype=np.float64).astype(np.float32)
    return half
