"""An estimate of the size of a mesh before the work, from the sign changes of the coarse samples.

A surface of area A crosses 3/2 A / h^2 edges of a lattice of spacing h, averaged over its
directions. So it crosses K^2 times as many edges of the fine lattice as of the coarse one. Each
crossed edge holds one vertex, and a closed mesh has two triangles per vertex.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray
from ..errors import WriteError
from ..grid.planes import in_blocks, over_planes
from ..grid.sdf_grid import SdfGrid, negated
from ..machine.memory import in_words
from .meshes import format_of
from .output import free_space

SMALL = 10_000_000  # bytes; smaller sizes are printed in full
LARGE = 200_000_000  # bytes of a file whose size is announced before the work
# The estimate is within 8 % of the truth, or too low where parts are thin: the file certainly takes
# half of it.
CERTAIN_SHARE = 0.5


@dataclass(frozen=True)
class Expectation:
    """The estimated number of triangles of a mesh, and the size of its file in bytes.

    ``by_plane``, (nx, 3) int64, has the edges along x, y and z that the surface crosses in each
    plane of samples; those along x are those to the plane before.
    """

    triangles: int
    size: int
    by_plane: NDArray[np.int64] | None = None

    def warning(self, path: str | Path) -> str | None:
        """Return a sentence that announces a large file, None for others."""
        if self.size < LARGE:
            return None
        return f"{path} will have about {_rounded(self.triangles):,} triangles, {_size(self.size)}"


def expect(
    grid: SdfGrid, factor: int, offset: float, path: str | Path, *, cap: bool = False
) -> Expectation:
    """Estimate the size of the mesh of a grid, and of its file; ``cap`` is as in ``reconstruct``.

    Raises WriteError if half of that is more than the free disk space.
    """
    by_plane = count_by_plane(grid, offset, cap=cap)
    triangles = 2 * factor**2 * round(count_on_lattice(grid, by_plane))
    size = triangles * format_of(path).bytes_per_triangle
    free = free_space(Path(path))
    if CERTAIN_SHARE * size > free:
        raise WriteError(
            f"{path} cannot be written: about {_rounded(triangles):,} triangles take "
            f"{_size(size)}, {_size(free)} are free there; use a smaller factor, or another "
            "folder"
        )
    return Expectation(triangles, size, by_plane)


def count_on_lattice(grid: SdfGrid, by_plane: NDArray[np.int64]) -> float:
    """Estimate how many edges of the lattice that is refined the offset surface crosses.

    Edges along an axis are as many as the cells of a plane across it.
    """
    counts: list[int] = by_plane.sum(0).tolist()
    if grid.is_cubic or grid.field.on_lattice:
        return sum(counts)
    h, cell = grid.voxel_size, prod(grid.spacing)
    return sum(count * cell / step / h**2 for count, step in zip(counts, grid.spacing))


def count_by_plane(grid: SdfGrid, offset: float, *, cap: bool = False) -> NDArray[np.int64]:
    """Count the edges with samples on different sides of the offset surface, (nx, 3).

    With ``cap``, all is outside beyond the border of the grid. See ``Expectation.by_plane``.
    """
    count = partial(_crossings_of, grid.positive_inside, offset, cap)
    ranges = [
        (max(first - 1, 0), last, first > 0, last == len(grid.samples))
        for first, last in in_blocks(grid.samples)
    ]
    return np.concatenate(list(over_planes(grid.samples, count, ranges)))


def _crossings_of(
    positive_inside: bool,
    offset: float,
    cap: bool,
    planes: NDArray[Any],
    has_before: bool,
    is_end: bool,
) -> NDArray[np.int64]:
    """Count crossed edges plane by plane, (n, 3); ``has_before``: the first is the one before."""
    with np.errstate(over="ignore"):  # an offset beyond float32 is beyond all values
        inside = (negated(planes) if positive_inside else planes) <= offset
    counted = inside[int(has_before) :]
    x, y, z = (
        _count(np.diff(part, axis=axis)) for axis, part in enumerate((inside, counted, counted))
    )
    if not has_before:
        x = np.concatenate([_count(inside[:1]) * cap, x])
    if cap:
        y += _count(counted[:, [0, -1]])
        z += _count(counted[:, :, [0, -1]])
        x[-1] += is_end * np.count_nonzero(counted[-1])
    return np.stack([x, y, z], axis=1)


def _count(marks: BoolArray) -> NDArray[np.int64]:
    return np.asarray(np.count_nonzero(marks, axis=(1, 2)))


def _rounded(count: int) -> int:
    return int(float(f"{count:.2g}"))


def _size(count: int) -> str:
    return in_words(count) if count >= SMALL else f"{count:,} bytes"
