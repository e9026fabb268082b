"""OpenVDB level sets, with tinyvdb: the active voxels, and the sign of all others.

Voxel (i, j, k) is the sample at the grid's transform of (i, j, k).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import GridError
from ..volume import Request, Volume, from_affine
from .choosing import choose_member

MARGIN = 2  # voxels of background around the active ones, so that the border is outside
DENSITIES = ("fog volume", "staggered")


def read_vdb(request: Request) -> Volume:
    """Read a level set of a ``.vdb`` file.

    Inactive voxels become the background, negative where the next active voxel before them on their
    line is inside.
    """
    import tinyvdb

    with tinyvdb.open(str(request.path)) as file:
        grid = _choose(file, request)
        metadata = grid.metadata
        if metadata.get("class") in DENSITIES:
            raise GridError(
                f"{request.path} holds a {metadata['class']}, which is no signed distance: give a "
                "level set"
            )
        sparse = grid.to_sparse()
        ijk = np.frombuffer(sparse["coords"], np.int32).reshape(-1, 3)
        values = np.frombuffer(sparse["values"], np.float32)
        background = abs(float(grid.float_background()))
        affine = _affine(grid.transform)
    if not len(ijk):
        raise GridError(f"{request.path} has no active voxel: it holds no surface")
    level_set = _LevelSet(ijk, values, background)
    spacing, _, direction = from_affine(affine)
    first = affine[:, :3] @ level_set.first + affine[:, 3]
    shape = level_set.shape
    dtype = np.dtype(np.float32)
    return Volume(shape, dtype, level_set.read, spacing, tuple(first), direction)


def _choose(file: Any, request: Request) -> Any:
    """Return the grid asked for, or the only one of float values."""
    numbers = range(file.grid_count)
    floats = [n for n in numbers if str(file.grid_type_name(n)).startswith("Tree_float")]
    names = [str(file.grid_name(n)) for n in floats]
    name = choose_member(request, names, "grid of float values")
    file.read_grids()
    return file.grid(floats[names.index(name)])


def _affine(transform: dict[str, Any]) -> NDArray[np.float64]:
    """Return the matrix (3, 4) from indices to world coordinates."""
    kind = str(transform["type"])
    if "scale" in kind or kind == "translation":
        scale = np.asarray(transform["scale"], np.float64)
        return np.column_stack([np.diag(scale), transform["translation"]])
    rows = np.asarray(transform["matrix"], np.float64)  # OpenVDB multiplies rows by it
    return rows.T[:3]


class _LevelSet:
    """The active voxels of a narrow band, and planes of the dense grid around them."""

    def __init__(
        self, ijk: NDArray[np.int32], values: NDArray[np.float32], background: float
    ) -> None:
        self.first = ijk.min(0).astype(np.int64) - MARGIN
        nx, ny, nz = (int(n) for n in ijk.max(0) - self.first + 1 + MARGIN)
        self.shape, self.background = (nx, ny, nz), np.float32(background)
        order = np.argsort(ijk[:, 0], kind="stable")
        self.ijk, self.values = ijk[order], values[order]

    def read(self, first: int, last: int) -> NDArray[np.float32]:
        """Return the planes first <= i < last, all voxels known."""
        ends = np.searchsorted(self.ijk[:, 0], (first + self.first[0], last + self.first[0]))
        part = slice(*ends)
        i, j, k = (self.ijk[part] - self.first).T
        known = np.zeros((last - first, *self.shape[1:]), bool)
        planes = np.full(known.shape, self.background)
        known[i - first, j, k] = True
        planes[i - first, j, k] = self.values[part]
        before = np.maximum.accumulate(np.where(known, np.arange(self.shape[2]), 0), axis=2)
        inside = np.take_along_axis(planes, before, axis=2) < 0
        planes[inside & ~known] = -self.background
        return planes
