"""Refined fields as sparse ``.npz`` files: written by ``write_field``, read back by ``read_field``.

docs/reference/files.md describes the keys. Values are in world units and exact: as float32 if the
spacing is a power of two, since the field's own are float32 in half voxels, else as float64.
"""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..errors import FileError, GridError, OptionError, SuperSdfError
from ..grid.field import Field
from ..grid.samples import SamplePlanes
from ..grid.sdf_grid import SdfGrid
from ..options import check_factor, check_path
from ..refine.band import neighbour_table
from ..refine.field import FineField, SampleSpheres
from ..refine.nodes import copies_agree, share_parts
from ..surface.cap import find_border_inside
from ..threads import check_fits
from .regular import check_regular_file

VERSION = 1
CHUNK = 1 << 20  # values at a time
LONGEST = 1 << 20  # samples along an axis
# Which kinds of numbers each array has, and its shape, where None is any length; that of the values
# depends on the factor.
ARRAYS: dict[str, tuple[str, tuple[int | None, ...]]] = {
    "version": ("iu", ()),
    "shape": ("iu", (3,)),
    "factor": ("iu", ()),
    "spacing": ("f", (3,)),
    "origin": ("f", (3,)),
    "direction": ("f", (3, 3)),
    "offset": ("f", ()),
    "leaves": ("b", ()),
    "values": ("f", (None, None, None, None)),
    "voxels": ("i", (None, 3)),
    "sample_voxels": ("i", (None, 3)),
    "sample_distances": ("f", (None,)),
    "border_inside": ("i", (None, 3)),
}


def write_sparse(field: FineField, path: Path) -> None:
    """Write a field to an ``.npz`` file, its values block by block."""
    grid, side, count = field.placed, field.factor + 1, len(field.voxel_ijk)
    # float32 is exact where world units only change exponents
    is_power = math.frexp(grid.voxel_size)[0] == 0.5 and 1e-20 < grid.voxel_size < 1e20
    exact = np.dtype("<f4" if is_power else "<f8")
    samples, distances = np.empty((0, 3), np.int32), np.empty(0)
    if field.spheres is not None:
        samples = field.spheres.voxel_ijk
        distances = field.in_world_units(field.spheres.distance)
    border = np.empty((0, 3), np.int32)
    if field.leaves:
        border = find_border_inside(field)
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
        "border_inside": border,
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
    arrays = _read_arrays(check_regular_file(path))

    def no_field(why: str) -> FileError:
        return FileError(f"{path} is no refined field: {why}")

    def damaged(key: str, why: str) -> FileError:
        return FileError(f"{path}[{key}] is damaged: {why}")

    shape = tuple(map(int, arrays["shape"]))
    if not 2 <= min(shape) <= max(shape) <= LONGEST:
        raise no_field(f"its grid has the shape {shape}")
    for key, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise damaged(key, "not all values are finite")
        if array.dtype.kind == "i" and array.ndim == 2:
            number = array.astype(np.int64) @ (shape[1] * shape[2], shape[2], 1)
            if (array < 0).any() or (array >= shape).any() or (np.diff(number) <= 0).any():
                raise damaged(key, "its voxels are not in order in the grid")
            arrays[key] = np.ascontiguousarray(array, np.int32)
    try:
        factor = check_factor(int(arrays["factor"]))
        grid = SdfGrid.trusted(
            NoSamples(shape, str(path)),
            *(arrays["spacing"], arrays["origin"]),
            direction=arrays["direction"],
            extremes=(-math.inf, math.inf),
            field=Field(on_lattice=True),  # it is on the lattice of the field already
        )
    except (GridError, OptionError) as error:
        raise no_field(str(error)) from None
    voxels, values, border = (arrays[key] for key in ("voxels", "values", "border_inside"))
    samples, distances = arrays["sample_voxels"], arrays["sample_distances"]
    if not len(voxels):
        raise no_field("it has no blocks")
    for key, want in (
        ("values", (len(voxels), *(factor + 1,) * 3)),
        ("sample_distances", (len(samples),)),
    ):
        if arrays[key].shape != want:
            raise damaged(key, f"it has the shape {arrays[key].shape}, not {want}")
    half = _in_half_voxels(values.reshape(len(voxels), -1), grid)
    blocks, parts = np.ascontiguousarray(half.T), share_parts(neighbour_table(voxels, shape))
    if not copies_agree(blocks, parts, factor):
        raise damaged("values", "blocks differ at nodes that they share")
    at_border = ((border == 0) | (border == np.array(shape) - 1)).any(1)
    numbers = (np.ravel_multi_index(tuple(ijk.T), shape) for ijk in (border, voxels))
    if not at_border.all() or np.isin(*numbers).any():
        raise damaged("border_inside", "not all are border voxels without a block")
    return FineField(
        (shape[0], shape[1], shape[2]),
        factor,
        voxels,
        blocks,
        parts,
        spheres=SampleSpheres(shape, samples, _in_half_voxels(distances, grid)),  # type: ignore[arg-type]
        grid=grid,
        offset=float(arrays["offset"]),
        leaves=bool(arrays["leaves"]),
        border_inside=border,
    )


def _read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file by their keys, which have the kinds and shapes of ``ARRAYS``."""
    arrays: dict[str, NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            sizes = {i.filename.removesuffix(".npy"): i.file_size for i in archive.infolist()}
            missing = [key for key in ARRAYS if key not in sizes]
            if missing:
                raise FileError(f"{path} is no refined field: it has no key {missing[0]!r}")
            way_out = "read it on a larger machine"
            check_fits(3 * sum(sizes[key] for key in ARRAYS), f"{path}, as a field,", way_out)
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
    except SuperSdfError:
        raise
    except Exception as error:  # zipfile and NumPy raise over ten kinds of error on damaged files
        reason = str(error).splitlines() or [type(error).__name__]
        raise FileError(f"{path} cannot be read as a refined field: {reason[0]}") from None
    return arrays


def _in_half_voxels(world: NDArray[Any], grid: SdfGrid) -> FloatArray:
    """Return distances in world units in half voxels: the float32 numbers that were written."""
    half: FloatArray = np.divide(world, grid.voxel_size / 2, dtype=np.float64).astype(np.float32)
    return half
