"""Refined fields as sparse ``.npz`` files: written slab by slab, read back by ``read_field``.

docs/reference/files.md describes the keys. Values are in world units and exact: as float32 if the
spacing is a power of two, since the field's own are float32 in half voxels, else as float64.
"""

from __future__ import annotations

import math
import zipfile
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import DTypeLike, NDArray

from ..arrays import FloatArray, IntArray
from ..errors import FileError, GridError, OptionError
from .numpy_files import Member, open_archive
from .output import append_spool, little_endian, spool_beside
from .regular import check_regular_file
from ..grid.field import Field
from ..grid.planes import InputFile, SamplePlanes
from ..grid.sdf_grid import SdfGrid
from ..machine.memory import check_fits
from ..options import check_factor, check_path
from ..refine.band import neighbour_table
from ..surface.cap import find_border_inside
from ..refine.field import FineField, SampleSpheres
from ..refine.nodes import copies_agree, share_parts

VERSION = 1
CHUNK = 1 << 20  # values at a time
LONGEST = 1 << 20  # samples along an axis
# Small arrays first; the values, which are large, before the arrays that grow with them.
HEAD = ("version", "shape", "factor", "spacing", "origin", "direction", "offset", "leaves")
LISTS = ("voxels", "sample_voxels", "sample_distances", "border_inside")
KEYS = (*HEAD, "values", *LISTS)
NOT_FINITE = "not all values are finite"


class SparseWriter:
    """Writes a field slab by slab: blocks to the archive, voxels and samples to temporary files."""

    def __init__(self, part: Path, shape: tuple[int, int, int], files: ExitStack) -> None:
        self.archive = zipfile.ZipFile(part, "w")
        files.callback(self._close)
        self.lists = {name: files.enter_context(spool_beside(part)) for name in LISTS}
        self.counts = dict.fromkeys(LISTS, 0)
        self.values: IO[bytes] | None = None
        self.types: dict[str, DTypeLike] = {}

    def add(self, field: FineField) -> None:
        """Write the own planes of a slab's field."""
        if self.values is None:
            self._begin(field)
        assert self.values is not None
        rows = slice(0, len(field.voxel_ijk))
        self._extend("voxels", field.voxel_ijk[rows])
        step = max(CHUNK // len(field.blocks), 1)
        for first in range(rows.start, rows.stop, step):
            some = slice(first, min(first + step, rows.stop))
            self.values.write(self._bytes("values", field.block_distances(some)))
        self._add_samples(field)
        if field.leaves:
            self._extend("border_inside", find_border_inside(field))

    def finish(self) -> None:
        """Complete the archive with the arrays of which the length is known only now."""
        if self.values is None:
            return
        self.values.close()
        for name, spool in self.lists.items():
            shape = (self.counts[name], *([3] if self.types[name] is np.int32 else []))
            with self._open(name, shape, self.types[name]) as member:
                append_spool(spool, member)
        self.archive.close()

    def _close(self) -> None:
        with suppress(OSError, ValueError):
            if self.values is not None:
                self.values.close()
        with suppress(OSError, ValueError):
            self.archive.close()

    def _begin(self, field: FineField) -> None:
        grid, side = field.placed, field.factor + 1
        # float32 is exact where world units only change exponents
        is_power = math.frexp(grid.voxel_size)[0] == 0.5 and 1e-20 < grid.voxel_size < 1e20
        exact = np.float32 if is_power else np.float64
        self.types = {**dict.fromkeys(LISTS, np.int32), "values": exact, "sample_distances": exact}
        head = (
            *(VERSION, field.shape, field.factor),
            *(grid.spacing, grid.origin, grid.direction, field.offset, field.leaves),
        )
        for name, value in zip(HEAD, head):
            array = np.asarray(value)
            with self._open(name, array.shape, array.dtype) as member:
                member.write(little_endian(array))
        self.values = self._open("values", (len(field.voxel_ijk), side, side, side), exact)

    def _add_samples(self, field: FineField) -> None:
        spheres = field.spheres
        if spheres is None:
            return
        self._extend("sample_voxels", spheres.voxel_ijk)
        distances = field.in_world_units(spheres.distance)
        self._extend("sample_distances", distances)

    def _extend(self, name: str, rows: NDArray[Any]) -> None:
        self.lists[name].write(self._bytes(name, rows))
        self.counts[name] += len(rows)

    def _bytes(self, name: str, array: NDArray[Any]) -> bytes:
        return little_endian(array.astype(self.types[name], copy=False))

    def _open(self, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> IO[bytes]:
        member = self.archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True)
        descr = np.dtype(dtype).newbyteorder("<").str
        header = {"descr": descr, "fortran_order": False, "shape": tuple(map(int, shape))}
        npy.write_array_header_1_0(member, header)
        return member


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
    FileError
        If the file is missing, damaged, truncated, or holds something else.
    OutOfMemoryError
        If the field does not fit in memory.
    OptionError
        If the suffix is not .npz.
    """
    path = check_path(path, "path")
    if path.suffix.lower() != ".npz":
        raise OptionError(f"{path} is no sparse field: give .npz")
    file = InputFile.open(check_regular_file(path))
    try:
        with open_archive(path) as archive:
            return _Reader(archive, str(path)).read()
    finally:
        file.check_unchanged()  # a change explains whatever else went wrong


class _Reader:
    """Reads the arrays of an archive and checks that they make a field."""

    def __init__(self, archive: zipfile.ZipFile, name: str) -> None:
        self.archive, self.name = archive, name
        self.members = {i.filename.removesuffix(".npy"): i for i in archive.infolist()}

    def read(self) -> FineField:
        missing = [key for key in KEYS if key not in self.members]
        if missing:
            raise self._no_field(f"it has no key {missing[0]!r}")
        version = int(self._array("version", "iu", ()))
        if version != VERSION:
            said = f"has format version {version}, this program reads {VERSION}"
            raise FileError(f"{self.name} {said}: use a newer one")
        shape = tuple(map(int, self._array("shape", "iu", (3,))))
        if not 2 <= min(shape) <= max(shape) <= LONGEST:
            raise self._no_field(f"its grid has the shape {shape}")
        try:
            factor, grid = check_factor(int(self._array("factor", "iu", ()))), self._grid(shape)
        except (GridError, OptionError) as error:
            raise self._no_field(str(error)) from None
        voxels = self._voxels("voxels", shape)
        if not len(voxels):
            raise self._no_field("it has no blocks")
        blocks = self._blocks(len(voxels), factor, grid)
        parts = share_parts(neighbour_table(voxels, shape))
        if not copies_agree(blocks, parts, factor):
            raise self._damaged("values", "blocks differ at nodes that they share")
        samples = self._voxels("sample_voxels", shape)
        distance = self._array("sample_distances", "f", (len(samples),))
        return FineField(
            (shape[0], shape[1], shape[2]),
            factor,
            voxels,
            blocks,
            parts,
            spheres=SampleSpheres(shape, samples, _in_half_voxels(distance, grid)),  # type: ignore[arg-type]
            grid=grid,
            offset=float(self._array("offset", "f", ())),
            leaves=bool(self._array("leaves", "b", ())),
            border_inside=self._border_inside(voxels, shape),
        )

    def _border_inside(self, blocks: IntArray, shape: tuple[int, ...]) -> IntArray:
        voxels = self._voxels("border_inside", shape)
        at_border = ((voxels == 0) | (voxels == np.array(shape) - 1)).any(1)
        numbers = (np.ravel_multi_index(tuple(ijk.T), shape) for ijk in (voxels, blocks))
        if not at_border.all() or np.isin(*numbers).any():
            raise self._damaged("border_inside", "not all are border voxels without a block")
        return voxels

    def _grid(self, shape: tuple[int, ...]) -> SdfGrid:
        spacing, origin = (self._array(key, "f", (3,)) for key in ("spacing", "origin"))
        direction, samples = self._array("direction", "f", (3, 3)), NoSamples(shape, self.name)
        ends = -math.inf, math.inf
        field = Field(on_lattice=True)  # it is on the lattice of the field already
        return SdfGrid.trusted(
            samples, spacing, origin, direction=direction, extremes=ends, field=field
        )

    def _voxels(self, key: str, shape: tuple[int, ...]) -> IntArray:
        """Return voxels (n, 3), which must lie in the grid, all different, in C order."""
        voxels = np.asarray(self._array(key, "i", (None, 3)), np.int64)
        inside = ((voxels >= 0) & (voxels < shape)).all()
        number = (voxels[:, 0] * shape[1] + voxels[:, 1]) * shape[2] + voxels[:, 2]
        if not inside or (np.diff(number) <= 0).any():
            raise self._damaged(key, "its voxels are not in order in the grid")
        return np.ascontiguousarray(voxels, np.int32)

    def _blocks(self, count: int, factor: int, grid: SdfGrid) -> FloatArray:
        """Return the values (Q, D) in half voxels, read in pieces."""
        member = self._open("values", "f", (count, *(factor + 1,) * 3))
        nodes, dtype = (factor + 1) ** 3, member.header.dtype
        check_fits(4 * nodes * count, f"{self.name}, as a field,", "read it on a larger machine")
        blocks = np.empty((nodes, count), np.float32)
        step = max(CHUNK // nodes, 1)
        for first in range(0, count, step):
            rows = slice(first, min(first + step, count))
            data = member.read((rows.stop - first) * nodes * dtype.itemsize)
            values = _in_half_voxels(np.frombuffer(data, dtype), grid)
            blocks[:, rows] = values.reshape(-1, nodes).T
        if not np.isfinite(blocks).all():
            raise self._damaged("values", NOT_FINITE)
        return blocks

    def _no_field(self, why: str) -> FileError:
        return FileError(f"{self.name} is no refined field: {why}")

    def _damaged(self, key: str, why: str) -> FileError:
        return FileError(f"{self.name}[{key}] is damaged: {why}")

    def _array(self, key: str, kinds: str, shape: tuple[int | None, ...]) -> NDArray[Any]:
        """Return an array of one of some kinds and of a shape, in which None is any length."""
        member = self._open(key, kinds, shape)
        check_fits(member.header.size, f"{self.name}[{key}]", "read it on a larger machine")
        array = member.array()
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise self._damaged(key, NOT_FINITE)
        return array

    def _open(self, key: str, kinds: str, shape: tuple[int | None, ...]) -> Member:
        """Return the member of a key, whose header must be as expected."""
        name = f"{self.name}[{key}]"
        member = Member(self.archive, self.members[key], name)
        header = member.header
        fits = len(header.shape) == len(shape) and all(
            want in (None, have) for want, have in zip(shape, header.shape)
        )
        if not fits or header.dtype.kind not in kinds or header.fortran_order:
            raise FileError(f"{name} is {header}: it belongs to no refined field")
        if header.size != member.left:
            raise self._damaged(key, f"its header promises {header}, but {member.left:,} follow")
        return member


def _in_half_voxels(world: NDArray[Any], grid: SdfGrid) -> FloatArray:
    """Return distances in world units in half voxels: the float32 numbers that were written."""
    half: FloatArray = np.divide(world, grid.voxel_size / 2, dtype=np.float64).astype(np.float32)
    return half
