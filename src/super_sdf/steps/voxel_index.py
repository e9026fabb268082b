"""Find voxels of a list by their place in the grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arrays import IntArray


class VoxelIndex:
    """The rows of voxels (n, 3), in C order, by their place in a grid of a shape."""

    def __init__(self, voxel_ijk: IntArray, shape: tuple[int, int, int]) -> None:
        self.shape = shape
        self.keys = self._key_of(voxel_ijk)

    def _key_of(self, voxel_ijk: NDArray[np.integer]) -> NDArray[np.int64]:
        """Return the number of each voxel, (...,), in C order of the whole grid."""
        _, rows, columns = self.shape
        i, j, k = (voxel_ijk[..., axis].astype(np.int64) for axis in range(3))
        return (i * rows + j) * columns + k

    def find(self, voxel_ijk: NDArray[np.integer]) -> NDArray[np.int64]:
        """Return the row of each voxel (..., 3), -1 if it is not in the list, (...,)."""
        if not len(self.keys):
            return np.full(voxel_ijk.shape[:-1], -1, np.int64)
        wanted = self._key_of(voxel_ijk)
        at = np.minimum(np.searchsorted(self.keys, wanted), len(self.keys) - 1)
        in_grid = ((voxel_ijk >= 0) & (voxel_ijk < self.shape)).all(-1)
        return np.where(in_grid & (self.keys[at] == wanted), at, -1)
