"""Writing refined fields as OpenVDB level sets, which ``files.readers.vdb`` reads back.

Node (i, j, k) of the fine lattice is voxel (i, j, k). Active are the voxels nearer to the surface
than three spacings of the lattice. All others have the background, which is those three spacings,
or minus the background inside. A level set is closed: a solid that leaves the lattice is cut off at
its border, so no node is deeper inside than the border is away, and voxels beyond are outside.

Eight planes of nodes are held at a time. Their cubes of 8^3 nodes without an active voxel are only
a side; the others, the leaves, wait in a temporary file, because a tree has them node by node.
"""

from __future__ import annotations

from array import array
from contextlib import ExitStack
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray
from ..errors import NoSurfaceError, OptionError
from .output import little_endian, spool_beside
from .vdb_writer import (INSIDE, LEAF, MIXED, OUTSIDE, LevelSet, Sides, leaf_bytes, write_level_set)
from ..grid.sdf_grid import SdfGrid
from ..refine.field import FineField, fine_grid, lattice_planes

HALF_WIDTH = 3  # voxels of the narrow band to either side of the surface; OpenVDB's tools want 3
BEYOND = HALF_WIDTH - 1  # voxels beyond the lattice that can be active
AT_ONCE = 1 << 11  # leaves
SIZES = 2e-5, 1e30  # of a voxel: OpenVDB refuses transforms with a determinant below 3e-15


class VdbWriter:
    """Gathers the leaves of a level set slab by slab, and writes the file at the end."""

    def __init__(self, part: Path, shape: tuple[int, int, int], files: ExitStack) -> None:
        from hashlib import blake2b  # loads OpenSSL, and few fields are written

        self.file: IO[bytes] = files.enter_context(part.open("wb"))
        self.leaves: IO[bytes] = files.enter_context(spool_beside(part))
        self.starts = array("q", [0])  # of the leaves, in bytes
        self.last = shape[0] - 1
        rows, columns = (LEAF - (-(nodes + BEYOND) // LEAF) * LEAF for nodes in shape[1:])
        self.planes = np.full((LEAF, rows, columns), np.float32(np.inf))  # from voxel -8 on
        self.held = LEAF - BEYOND  # planes that are there, the first ones far beyond the lattice
        self.sides: list[Sides] = []  # of the cubes of each eight planes
        self.low, self.high = np.full(3, 1 << 31), np.full(3, -LEAF)  # active voxels
        self.active = 0
        self.grid: SdfGrid | None = None
        self.background = np.float32(0)
        self.digest = blake2b(digest_size=16)

    def add(self, field: FineField) -> None:
        """Take the planes of nodes of a slab."""
        if self.grid is None:
            self.grid = fine_grid(field)
            _check_size(self.grid.voxel_size)
            self.background = np.float32(HALF_WIDTH * self.grid.voxel_size)
        for first, planes in lattice_planes(field):
            for number, plane in enumerate(planes, first):
                self._close(plane, number)
                for away in range(BEYOND, 0, -1) if number == 0 else ():
                    self._put(self._beyond(plane, away))
                self._put(plane)
                for away in range(1, BEYOND + 1) if number == self.last else ():
                    self._put(self._beyond(plane, away))

    def finish(self) -> None:
        """Write the file."""
        if self.held:
            self.planes[self.held :] = np.inf
            self._take_cubes()
        if self.grid is None:
            return
        if not self.active:
            raise NoSurfaceError("the field has no surface: there is no level set to write")
        self.digest.update(
            repr((self.grid.spacing, self.grid.origin, self.grid.direction)).encode()
        )
        key, box = self.digest.digest(), (self.low, self.high)
        sides = np.stack(self.sides)
        tree = LevelSet(self.grid, self.background, sides, self._leaf, self.active, box, key)
        write_level_set(self.file, tree)
        self.file.close()

    def _close(self, plane: FloatArray, number: int) -> None:
        """Set the nodes of a plane that are deeper inside than they are from the border."""
        for depth in range(HALF_WIDTH):
            least = np.float32(0 - depth * self.background / HALF_WIDTH)
            for line in (plane[depth], plane[-1 - depth], plane[:, depth], plane[:, -1 - depth]):
                np.maximum(line, least, out=line)
            if depth in (number, self.last - number):
                np.maximum(plane, least, out=plane)

    def _beyond(self, border: FloatArray, away: int) -> FloatArray:
        """Return the distances some nodes beyond the border: if the border is the nearest."""
        beyond: FloatArray = np.hypot(border, np.float32(away * self.background / HALF_WIDTH))
        return beyond

    def _put(self, plane: FloatArray) -> None:
        """Hold a plane of nodes, and the voxels beside it, beyond the lattice."""
        held = self.planes[self.held]
        held[LEAF : LEAF + plane.shape[0], LEAF : LEAF + plane.shape[1]] = plane
        for lines, count in zip((held, held.T), plane.shape):  # the second has the corners, too
            for away in range(1, BEYOND + 1):
                lines[LEAF - away] = self._beyond(lines[LEAF], away)
                lines[LEAF + count - 1 + away] = self._beyond(lines[LEAF + count - 1], away)
        self.held += 1
        if self.held == LEAF:
            self._take_cubes()

    def _take_cubes(self) -> None:
        """Take the cubes of the eight planes that are held."""
        rows, columns = (nodes // LEAF for nodes in self.planes.shape[1:])
        lines = rows, LEAF, columns, LEAF
        low, high = self.planes.min(0).reshape(lines), self.planes.max(0).reshape(lines)
        sides = np.full((rows, columns), MIXED, np.uint8)
        sides[low.min((1, 3)) >= self.background] = OUTSIDE
        sides[high.max((1, 3)) <= -self.background] = INSIDE
        cubes, places = self.planes.reshape(LEAF, *lines), np.argwhere(sides == MIXED)
        for first in range(0, len(places), AT_ONCE):
            some = places[first : first + AT_ONCE]
            corners = LEAF * (np.insert(some, 0, len(self.sides), axis=1) - 1)
            self._add_leaves(corners, cubes[:, some[:, 0], :, some[:, 1]])
        self.sides.append(sides)
        self.held = 0

    def _add_leaves(self, corners: NDArray[np.int64], values: FloatArray) -> None:
        """Add leaves (n, 8, 8, 8) to those that wait."""
        active = np.abs(values) < self.background
        self._extend_box(corners, active)
        self.digest.update(little_endian(values))
        for numbers, on in zip(values.reshape(-1, LEAF**3), active.reshape(-1, LEAF**3)):
            leaf = leaf_bytes(numbers, on)
            self.leaves.write(leaf)
            self.starts.append(self.starts[-1] + len(leaf))

    def _extend_box(self, corners: NDArray[np.int64], active: BoolArray) -> None:
        self.active += int(np.count_nonzero(active))
        for axis, across in enumerate(((2, 3), (1, 3), (1, 2))):
            at = (corners[:, axis, None] + np.arange(LEAF))[active.any(across)]
            self.low[axis] = at.min(initial=self.low[axis])
            self.high[axis] = at.max(initial=self.high[axis])

    def _leaf(self, number: int) -> bytes:
        start, end = self.starts[number : number + 2]
        self.leaves.seek(start)
        return self.leaves.read(end - start)


def _check_size(voxel: float) -> None:
    if not SIZES[0] <= voxel <= SIZES[1]:
        raise OptionError(
            f"the voxels of the field are {voxel:.3g}, and OpenVDB takes {SIZES[0]:g} to "
            f"{SIZES[1]:g}: multiply distances, spacing and origin of the grid, or write .npz"
        )
