"""Vertices in balls that must be empty: pieces of surface where the grid has none.

The samples near the surface see nothing of a piece that lies far from it. But every sample, however
far away, promises a ball without surface, also if its value was truncated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..grid.sdf_grid import SdfGrid
from ..steps.band import plane_blocks, rescale

STRAY = 0.5  # voxels within a ball, from which on a vertex is counted


@dataclass(frozen=True)
class Strays:
    """Vertices that lie where the nearest sample says that no surface is.

    Attributes
    ----------
    count : int
        Vertices more than ``STRAY`` voxels inside the ball of their nearest sample.
    beyond : int
        Vertices beyond the grid, more than half a voxel from its outermost samples.
    deepest : float
        Largest depth of a vertex in the ball of its nearest sample, in voxels; 0 if there is none.
    """

    count: int
    beyond: int
    deepest: float


def find_strays(vertices: NDArray[Any], grid: SdfGrid, offset: float = 0.0) -> Strays:
    """Look up the nearest sample of each vertex.

    Parameters
    ----------
    vertices : (n, 3) float
        World positions.
    grid : SdfGrid
        Read plane by plane.
    offset : float
        World distance of the meshed surface from the solid's.
    """
    position = grid.to_index(vertices)
    nearest = np.rint(position).astype(np.int64)
    inside = ((nearest >= 0) & (nearest < grid.shape)).all(1)
    position, nearest = position[inside], nearest[inside]
    order = np.argsort(nearest[:, 0], kind="stable")
    deepest, count = 0.0, 0
    for first, last in plane_blocks(grid.shape):
        low, high = np.searchsorted(nearest[:, 0], [first, last], sorter=order)
        if low < high:
            rows = order[low:high]
            block = rescale(grid, offset, first, last)
            depth = depths(position[rows], nearest[rows], block, first)
            deepest = max(deepest, float(depth.max()))
            count += int(np.count_nonzero(depth > STRAY))
    return Strays(count, int(np.count_nonzero(~inside)), deepest)


def depths(
    position: NDArray[np.float64], nearest: NDArray[np.int64], block: FloatArray, first: int
) -> NDArray[np.float64]:
    """Return how deep vertices lie in the balls of their nearest samples, (n,), in voxels.

    Parameters
    ----------
    position, nearest : (n, 3) float64, (n, 3) int64
        In index units.
    block : (p, ny, nz) float32
        Planes of samples, in half voxels, from plane ``first`` on.
    """
    i, j, k = nearest.T
    radius = np.abs(block[i - first, j, k]) / 2
    depth: NDArray[np.float64] = radius - np.linalg.norm(position - nearest, axis=1)
    return depth
