"""An estimate of the size of a mesh before the work, from the sign changes of the coarse samples.

A surface of area A crosses 3/2 A / h^2 edges of a lattice of spacing h, averaged over its
directions. So it crosses K^2 times as many edges of the fine lattice as of the coarse one. Each
crossed edge holds one vertex, and a closed mesh has two triangles per vertex.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import prod
from pathlib import Path

import numpy as np

from ..arrays import BoolArray
from ..errors import WriteError
from ..grid.planes import SamplePlanes
from ..grid.sdf_grid import SdfGrid
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
    """The estimated number of triangles of a mesh, and the size of its file in bytes."""

    triangles: int
    size: int

    def warning(self, path: str | Path) -> str | None:
        """Return a sentence that announces a large file, None for others."""
        if self.size < LARGE:
            return None
        return f"{path} will have about {_rounded(self.triangles):,} triangles, {_size(self.size)}"


def expect(
    grid: SdfGrid, factor: int, offset: float, path: str | Path, *, cap: bool = False
) -> Expectation:
    """Estimate the size of the mesh of a grid, and of its file; ``cap`` is as in ``reconstruct``.

    Raises
    ------
    WriteError
        If half of that is more than the free disk space.
    """
    triangles = 2 * factor**2 * round(count_on_lattice(grid, offset, cap=cap))
    size = triangles * format_of(path).bytes_per_triangle
    free = free_space(Path(path))
    if CERTAIN_SHARE * size > free:
        raise WriteError(
            f"{path} cannot be written: about {_rounded(triangles):,} triangles take "
            f"{_size(size)}, {_size(free)} are free there; use a smaller factor, or another "
            "folder"
        )
    return Expectation(triangles, size)


def count_on_lattice(grid: SdfGrid, offset: float, *, cap: bool = False) -> float:
    """Estimate how many edges of the lattice that is refined the offset surface crosses.

    Edges along an axis are as many as the cells of a plane across it.
    """
    counts = count_crossings(grid, offset, cap=cap)
    if grid.is_cubic or grid.field.on_lattice:
        return sum(counts)
    h, cell = grid.voxel_size, prod(grid.spacing)
    return sum(count * cell / step / h**2 for count, step in zip(counts, grid.spacing))


def count_crossings(grid: SdfGrid, offset: float, *, cap: bool = False) -> tuple[int, int, int]:
    """Count the edges along x, y and z with samples on different sides of the offset surface.

    With ``cap``, all is outside beyond the border of the grid.
    """
    x = y = z = 0
    before = None
    for inside in _planes(grid, offset):
        y += int(np.count_nonzero(inside[1:] != inside[:-1]))
        z += int(np.count_nonzero(inside[:, 1:] != inside[:, :-1]))
        if cap:
            y += int(np.count_nonzero(inside[[0, -1]]))
            z += int(np.count_nonzero(inside[:, [0, -1]]))
        if before is not None or cap:
            x += int(np.count_nonzero(inside if before is None else inside != before))
        before = inside
    return x + (int(np.count_nonzero(before)) if cap and before is not None else 0), y, z


def _planes(grid: SdfGrid, offset: float) -> Iterator[BoolArray]:
    """Yield a mask of the samples inside, plane by plane, since the grid may be in a file."""
    step = grid.samples.block if isinstance(grid.samples, SamplePlanes) else 1
    for first in range(0, grid.shape[0], step):
        with np.errstate(over="ignore"):  # an offset beyond float32 is beyond all values
            inside = grid.planes(first, min(first + step, grid.shape[0])) <= offset
        yield from inside


def _rounded(count: int) -> int:
    """Round a number to two digits: it is an estimate."""
    return int(float(f"{count:.2g}"))


def _size(count: int) -> str:
    """Return a number of bytes with a unit, or in full if it is small."""
    return in_words(count) if count >= SMALL else f"{count:,} bytes"
