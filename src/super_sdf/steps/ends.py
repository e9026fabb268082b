"""Where the surface ends, because samples of the grid are unknown.

As in marching cubes of the samples, a cell has a surface only if all its eight samples are known.
Such a cell holds one octant of each of eight voxels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arrays import IntArray
from ..errors import GridError
from ..grid.planes import SampleArray
from ..grid.sdf_grid import SdfGrid
from .band import plane_blocks
from .cell_cases import CORNERS
from .nodes import block_ijk

WAY_OUT = (
    "end the surface there (--open), or replace each by a distance of the right sign (the cut-off "
    "value of its side)"
)


def check_can_close(grid: SdfGrid, *, cap: bool) -> None:
    """Raise GridError if a surface is to be closed, and samples that may hide it are unknown."""
    unseen = grid.field.unseen
    if unseen is not None and cap:
        why = getattr(unseen, "refusal", lambda: "samples beside the surface are unknown")()
        raise GridError(f"{why}; {WAY_OUT}")


def check_all_seen(grid: SdfGrid, what: str) -> None:
    """Raise GridError if something cannot be done with a surface that ends at unknown samples."""
    if grid.field.unseen is not None:
        raise GridError(f"samples beside the surface are unknown, so it is open there: {what}")


def seen_octants(unseen: SampleArray, voxel_ijk: IntArray) -> NDArray[np.uint8]:
    """Return a bit for each octant of voxels (D, 3), (D,): whether no sample round it is unseen."""
    seen = np.empty(len(voxel_ijk), np.uint8)
    for first, last in plane_blocks(tuple(unseen.shape)):
        rows = slice(*np.searchsorted(voxel_ijk[:, 0], [first, last]).tolist())
        low, high = max(first - 1, 0), min(last + 1, unseen.shape[0])
        marked = np.pad(np.asarray(unseen[low:high]), 1, mode="edge")
        any_of = marked
        for axis in range(3):
            lines = np.moveaxis(any_of, axis, 0)
            any_of = np.moveaxis(lines[1:] | lines[:-1], 0, axis)
        cell = voxel_ijk[rows] - np.array([low, 0, 0], np.int32)
        octants = [any_of[tuple((cell + corner).T)] for corner in CORNERS]
        seen[rows] = np.packbits(~np.stack(octants, 1), axis=1, bitorder="little")[:, 0]
    return seen


def octant_of_cells(factor: int) -> NDArray[np.uint8]:
    """Return the octant of the voxel, 0 to 7, in which each cell of a block lies, (K^3,)."""
    low = block_ijk(factor)
    low = low[(low < factor).all(1)]
    octant: NDArray[np.uint8] = ((low >= factor // 2) @ np.array([4, 2, 1])).astype(np.uint8)
    return octant
