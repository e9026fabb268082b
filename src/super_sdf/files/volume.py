"""What a reader of a file format returns, and its place in the world.

A reader only says what the file says. Here, and nowhere else, the axes of the array are brought
into the order and sense in which they lie nearest to the world's. What is left is the direction of
the grid.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import permutations
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Triple
from ..errors import GridError, OutOfMemoryError
from ..grid.direction import Direction, as_direction, check_direction
from ..grid.planes import SampleArray
from ..grid.samples import check_kind
from ..machine.memory import in_words
from .headers import ArrayHeader
from .unpacking import PIECE, Write, fill

STRAIGHT = 1e-4  # an axis that is off by less than this from a world axis counts as along it
XYZ = np.eye(3)
ZYX = np.eye(3)[::-1]


@dataclass(frozen=True)
class Request:
    """What a reader is asked for.

    Attributes
    ----------
    path : Path
        The file.
    member : str or None
        The name of an array in it.
    axes : str
        The axis order of a file that does not state one: "xyz" or "zyx".
    room : int
        Bytes of memory that the unpacked array may take.
    left : int or None
        Bytes of memory that the process may still take; None if unknown.
    files : ExitStack
        Closes the files that the reader opens, once the volume is copied.
    """

    path: Path
    member: str | None
    axes: str
    room: int
    left: int | None
    files: ExitStack

    def check_loads(self, size: int, library: str) -> None:
        """Raise OutOfMemoryError if an array that is loaded whole would not fit in memory."""
        if self.left is not None and size > self.left:
            raise OutOfMemoryError(
                f"{self.path} takes {in_words(size)} of memory, since {library} loads it whole, "
                f"and {in_words(max(self.left, 0))} are left; save it as .npy in C order"
            )

    def planes_at_once(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> int:
        """Return how many planes to read at once if reading many is much quicker."""
        plane = max(prod(shape[1:]) * dtype.itemsize, 1)
        return max(min(max(self.room, PIECE) // plane, shape[0]), 1)


@dataclass(frozen=True)
class Volume:
    """An array of samples in a file, and where they are in the world.

    Sample (a, b, c) of the array is at ``origin + direction @ (spacing * (a, b, c))``.

    Attributes
    ----------
    shape, dtype
        Shape of the array, and its type.
    read : callable
        Returns planes first to last (exclusive) along the array's first axis, which is the slowest
        in the file.
    spacing : three floats or None
        Distance of neighbouring samples along each axis of the array, in world units.
    origin : three floats or None
        World position of sample (0, 0, 0).
    direction : (3, 3) array
        The columns are the world directions (unit vectors) of the axes of the array.
    planes_at_once : int
        Planes that are read together, such as those of a chunk.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    read: Callable[[int, int], NDArray[Any]]
    spacing: Triple | None = None
    origin: Triple | None = None
    direction: NDArray[np.float64] | None = None
    planes_at_once: int = 1
    stored: SampleArray | None = None
    """The array itself, if its planes can be read again and again without unpacking it."""


@dataclass(frozen=True)
class Placement:
    """Which world axis each axis of an array runs along, or nearest to, and whether backwards.

    ``direction`` is that of the array with its axes in this order and sense, None if they run along
    the world's.
    """

    world_axes: tuple[int, ...]
    backwards: tuple[bool, ...]
    direction: Direction | None = None


def from_affine(matrix: NDArray[Any]) -> tuple[Triple, Triple, NDArray[np.float64]]:
    """Split an affine (3 or 4, 4) into spacing, origin and direction of the array's axes."""
    columns = np.asarray(matrix, np.float64)[:3, :3]
    lengths = np.linalg.norm(columns, axis=0)
    direction = columns / np.where(lengths > 0, lengths, 1)
    return _triple(lengths), _triple(np.asarray(matrix, np.float64)[:3, 3]), direction


def reversed_axes(
    spacing: Any, direction: NDArray[np.float64]
) -> tuple[Triple, NDArray[np.float64]]:
    """Return spacing and direction for the array with its axes in reverse order."""
    return _triple(np.asarray(spacing, np.float64)[::-1]), np.asarray(direction)[:, ::-1]


@dataclass(frozen=True)
class ImageLattice:
    """Where the samples of VTK image data lie: at its points, or at the centres of its cells.

    Point (i, j, k) of the extent is at ``origin + direction @ (spacing * (i, j, k))``. The extent,
    the first and the last point on each axis, need not begin at 0.
    """

    extent: tuple[int, ...]
    spacing: NDArray[np.float64]
    origin: NDArray[np.float64]
    direction: NDArray[np.float64]
    of_points: bool

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape (nz, ny, nx) of the array of samples: x is the fastest."""
        low, high = self.extent[::2], self.extent[1::2]
        return tuple(high[axis] - low[axis] + self.of_points for axis in (2, 1, 0))

    def volume(
        self, dtype: Any, read: Callable[[int, int], NDArray[Any]], planes_at_once: int = 1
    ) -> Volume:
        """Return the samples, whose planes of z ``read`` returns, at their place in the world."""
        first = np.array(self.extent[::2]) + (0 if self.of_points else 0.5)
        start = _triple(self.origin + self.direction @ (self.spacing * first))
        spacing, direction = reversed_axes(self.spacing, self.direction)
        return Volume(self.shape, np.dtype(dtype), read, spacing, start, direction, planes_at_once)


def axes_direction(axes: str) -> NDArray[np.float64]:
    """Return the direction of an array whose axes are the world's in an order: "xyz", "zyx"."""
    return XYZ if axes == "xyz" else ZYX


def in_array_order(xyz: Any, axes: str) -> Triple:
    """Return three numbers given as x, y, z in the order of the array's axes."""
    triple = _triple(xyz)
    return triple if axes == "xyz" else (triple[2], triple[1], triple[0])


def _triple(numbers: Any) -> Triple:
    x, y, z = (float(number) for number in numbers)
    return x, y, z


def find_placement(volume: Volume, name: str) -> Placement:
    """Return how the axes of an array lie in the world.

    Raises
    ------
    GridError
        If they are not at right angles.
    """
    direction = XYZ if volume.direction is None else np.asarray(volume.direction)
    rounded = np.rint(direction)
    along = np.abs(rounded)
    straight = np.abs(direction - rounded).max() <= STRAIGHT  # False for NaN
    if straight and (along.sum(0) == 1).all() and (along.sum(1) == 1).all():
        backwards = rounded.sum(0) < 0
        return Placement(tuple(map(int, along.argmax(0))), tuple(map(bool, backwards)))
    try:
        check_direction(direction)
    except GridError as error:
        raise GridError(f"{name}: {error}") from None
    return _nearest_placement(direction)


def _nearest_placement(direction: NDArray[np.float64]) -> Placement:
    """Return the order and sense in which oblique axes lie nearest to the world's."""

    def nearness(order: tuple[int, ...]) -> float:
        return float(np.abs(direction[order, (0, 1, 2)]).sum())

    world_axes = max(permutations(range(3)), key=nearness)
    backwards = direction[world_axes, (0, 1, 2)] < 0
    turned = np.empty((3, 3))
    turned[:, world_axes] = np.where(backwards, -direction, direction)
    return Placement(world_axes, tuple(map(bool, backwards)), as_direction(turned))


def take(volume: Volume, name: str, room: int, given: dict[str, Any]) -> dict[str, Any]:
    """Return values (nx, ny, nz), spacing, origin and direction of a volume, for ``make_grid``.

    ``given`` holds what replaces these of the file, or None.

    Raises
    ------
    GridError
        If the array is no grid, or its axes are not at right angles.
    """
    check_kind(volume.dtype, volume.shape)
    placement = find_placement(volume, name)
    spacing, origin = given["spacing"], given["origin"]
    if spacing is None and volume.spacing is not None:
        spacing = tuple(volume.spacing[placement.world_axes.index(w)] for w in range(3))
    if origin is None:
        origin = volume.origin
    if origin is not None and any(placement.backwards):
        origin = _lowest_corner(volume, placement, spacing, origin)
    values = volume.stored
    if values is None or placement.world_axes != (0, 1, 2) or any(placement.backwards):
        values = _copied(volume, placement, name, room)
    direction = placement.direction if given["direction"] is None else given["direction"]
    return {"values": values, "spacing": spacing, "origin": origin, "direction": direction}


def _lowest_corner(
    volume: Volume, placement: Placement, spacing: Any, origin: Any
) -> NDArray[np.float64]:
    """Return the position of the sample that comes first when no axis runs backwards."""
    columns = XYZ if placement.direction is None else np.array(placement.direction)
    steps = np.broadcast_to(np.asarray(spacing, np.float64), 3)
    corner = np.broadcast_to(np.asarray(origin, np.float64), 3).copy()
    for count, axis, backwards in zip(volume.shape, placement.world_axes, placement.backwards):
        if backwards:
            corner -= columns[:, axis] * ((count - 1) * steps[axis])
    return corner


def _copied(volume: Volume, placement: Placement, name: str, room: int) -> SampleArray:
    """Return the samples as an array (nx, ny, nz), in memory or in a temporary file.

    Planes of x are made contiguous; within them, the axis along which the file is read comes first.
    """
    nx, ny, nz = (volume.shape[placement.world_axes.index(w)] for w in range(3))
    header = ArrayHeader((nx, ny, nz), volume.dtype, placement.world_axes[0] == 2, 0)
    return fill(partial(_copy, volume, placement), header, name, room)


def _copy(volume: Volume, placement: Placement, write: Write) -> None:
    """Copy a volume slab by slab."""
    slowest = placement.world_axes[0]
    stored = (0, slowest, 3 - slowest) if slowest else (0, 1, 2)
    order = [placement.world_axes.index(axis) for axis in stored]
    flipped = [axis for axis in range(3) if placement.backwards[axis]]
    count = volume.shape[0]
    for first, last in _slabs(volume):
        block = np.asarray(volume.read(first, last)).astype(volume.dtype, copy=False)
        block = np.ascontiguousarray(np.flip(block, tuple(flipped)).transpose(order))
        start = count - last if placement.backwards[0] else first
        if slowest == 0:
            write(start * block[0].nbytes, block.reshape(-1).view(np.uint8))
            continue
        row = block[0, 0].nbytes
        for i, piece in enumerate(block):
            write((i * count + start) * row, piece.reshape(-1).view(np.uint8))


def _slabs(volume: Volume) -> list[tuple[int, int]]:
    """Return the first and last plane of each slab that is read at once."""
    plane = prod(volume.shape[1:]) * volume.dtype.itemsize
    step = volume.planes_at_once
    step *= max(PIECE // (plane * step), 1)
    count = volume.shape[0]
    return [(first, min(first + step, count)) for first in range(0, count, step)]
