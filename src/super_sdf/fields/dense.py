"""Refined fields as dense arrays over the whole fine lattice: ``.npy``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO

from numpy.lib import format as npy

from ..arrays import FloatArray
from ..files.spool import little_endian
from ..steps.field import FineField
from ..steps.lattice import FineLattice

CHUNK = 1 << 20  # values at a time, but at least a plane
BYTES = 4  # of a value


class NpyWriter:
    """Writes the planes of the fine lattice slab by slab to an ``.npy`` file."""

    def __init__(self, part: Path, shape: tuple[int, int, int], files: ExitStack) -> None:
        self.file: IO[bytes] = files.enter_context(part.open("wb"))
        header = {"descr": "<f4", "fortran_order": False, "shape": shape}
        npy.write_array_header_1_0(self.file, header)

    def add(self, field: FineField) -> None:
        """Write the planes of nodes of a slab."""
        for _, planes in own_planes(field):
            self.file.write(little_endian(planes))

    def finish(self) -> None:
        """Complete the file."""
        self.file.close()


def own_planes(field: FineField) -> Iterator[tuple[int, FloatArray]]:
    """Yield the planes of nodes of a slab, a few at a time, and the number of the first of them.

    The plane between two slabs belongs to the second; the last slab also has the last plane.
    """
    lattice, factor = FineLattice(field), field.factor
    first, last = (factor * plane for plane in field.planes)
    last += field.planes[1] == field.shape[0]
    step = max(CHUNK // (lattice.shape[1] * lattice.shape[2]), 1)
    for start in range(first, last, step):
        yield start, lattice.read(start, min(start + step, last))
