"""How large a mesh will be, told before the work: from where the coarse samples change sign.

Edges of the lattice that cross a surface of area A number 3/2 A / h^2 in the mean over its
directions, whatever h is; so the fine lattice has K^2 times as many as the coarse one. Each holds
a vertex, and a closed mesh has two triangles a vertex.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..arrays import BoolArray
from ..errors import WriteError
from ..grid.sdf_grid import SdfGrid
from ..machine.memory import in_words
from .meshes import BYTES_PER_TRIANGLE
from .output import free_space

SMALL = 10_000_000
LARGE = 200_000_000  # bytes of a file that a user is told of before
# The estimate is within 8 % of the truth, or low where parts are thin: a half is surely too much.
SURELY = 0.5


@dataclass(frozen=True)
class Expectation:
    """How many triangles a mesh will have, and bytes its file, about."""

    triangles: int
    size: int

    def said(self, path: str | Path) -> str | None:
        """Return the sentence that prepares a user for a large file, None for others."""
        if self.size < LARGE:
            return None
        return f"{path} will have about {_rounded(self.triangles):,} triangles, {_size(self.size)}"


def expect(grid: SdfGrid, factor: int, offset: float, path: str | Path) -> Expectation:
    """Return about how large the mesh of a grid will be, and its file.

    Raises
    ------
    WriteError
        If half of that is more than there is room for.
    """
    triangles = 2 * factor**2 * count_crossings(grid, offset)
    size = triangles * BYTES_PER_TRIANGLE[Path(path).suffix.lower()]
    room = free_space(Path(path))
    if SURELY * size > room:
        raise WriteError(
            f"{path} cannot be written: about {_rounded(triangles):,} triangles take "
            f"{_size(size)}, {_size(room)} are free there; use a smaller factor, or another "
            "folder"
        )
    return Expectation(triangles, size)


def count_crossings(grid: SdfGrid, offset: float) -> int:
    """Count the edges between neighbouring samples on different sides of the offset."""
    count, before = 0, None
    for inside in _planes(grid, offset):
        count += int(np.count_nonzero(inside[1:] != inside[:-1]))
        count += int(np.count_nonzero(inside[:, 1:] != inside[:, :-1]))
        if before is not None:
            count += int(np.count_nonzero(inside != before))
        before = inside
    return count


def _planes(grid: SdfGrid, offset: float) -> Iterator[BoolArray]:
    """Yield which samples are inside, plane by plane: the grid may be in a file."""
    for i in range(grid.shape[0]):
        with np.errstate(over="ignore"):  # an offset beyond single precision is beyond all values
            inside = grid.planes(i, i + 1)[0] <= offset
        yield inside


def _rounded(count: int) -> int:
    """Return two digits of a number: it is an estimate."""
    return int(float(f"{count:.2g}"))


def _size(count: int) -> str:
    """Return a number of bytes in words, a small one outright."""
    return in_words(count) if count >= SMALL else f"{count:,} bytes"
