"""What a reader of a file format returns, and its place in the world.

A reader only says what the file says. Here, and nowhere else, the axes of the array are brought
into the order and sense in which they lie nearest to the world's. What is left is the direction of
the grid.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import permutations
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Triple
from ..errors import GridError, OutOfMemoryError
from ..grid.placement import Direction, as_direction, check_direction
from ..grid.planes import SampleArray
from ..grid.samples import check_kind
from ..machine.memory import in_words
from .boxes import Box, Layout, boxes_of, choose_layout, runs_of
from .headers import ArrayHeader
from .unpacking import PIECE, Write, check_ratio, fill

STRAIGHT = 1e-4  # an axis that is off by less than this from a world axis counts as along it
# Of a chunked array: bytes of a box, unless little memory is left; how many times the memory of a
# box or chunk reading it takes, with its packed bytes and the copy in another order of axes.
BOX, LEAST_SHARE, COPIES = 1 << 25, 16, 3
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

    def named(self, member: str | None) -> Request:
        """Return the same request for another array of the file."""
        return replace(self, member=member)

    def check_loads(self, size: int, library: str) -> None:
        """Raise OutOfMemoryError if an array that is loaded whole would not fit in memory."""
        if self.left is not None and size > self.left:
            raise OutOfMemoryError(
                f"{self.path} takes {in_words(size)} of memory, since {library} loads it whole, "
                f"and {in_words(max(self.left, 0))} are left; save it as .npy in C order"
            )


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
    chunks : three ints, optional
        Samples of a chunk along each axis, if the array is stored in chunks.
    read_box : callable, optional
        Returns a box of samples of such an array.
    packed : int, optional
        Bytes of the array as it is compressed in the file, if it is.
    notes : tuple of str
        Sentences on what the file says, for the user.
    about : dict
        What else the file says of how the array is stored, for ``info``.
    axes : str, optional
        The order of x, y and z along the array, if the file or the user names it.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    read: Callable[[int, int], NDArray[Any]]
    spacing: Triple | None = None
    origin: Triple | None = None
    direction: NDArray[np.float64] | None = None
    stored: SampleArray | None = None
    """The array itself, if its planes can be read again and again without unpacking it."""
    chunks: tuple[int, ...] | None = None
    read_box: Callable[[Box], NDArray[Any]] | None = None
    packed: int | None = None
    notes: tuple[str, ...] = ()
    about: dict[str, Any] = field(default_factory=dict)
    axes: str | None = None

    def turned(self, axes: str) -> Volume:
        """Return it without its direction, for a user who gives that of x, y and z."""
        return replace(self, direction=axes_direction(self.axes or axes))

    @property
    def unit(self) -> tuple[int, ...]:
        """Samples along each axis that are read together at least."""
        return self.chunks or (1, *self.shape[1:])

    def box(self, box: Box) -> NDArray[Any]:
        """Return a box of samples, of the array's own type."""
        if self.read_box:
            samples = self.read_box(box)
        else:
            samples = self.read(box[0].start, box[0].stop)[:, box[1], box[2]]
        return np.asarray(samples).astype(self.dtype, copy=False)


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

    @classmethod
    def of_image(cls, image: Any, of_points: bool) -> ImageLattice:
        """Return where the samples of VTK's image data lie, at its points or in its cells."""
        matrix = image.GetDirectionMatrix()
        direction = [[matrix.GetElement(row, column) for column in range(3)] for row in range(3)]
        spacing, origin = np.array(image.GetSpacing()), np.array(image.GetOrigin())
        return cls(image.GetExtent(), spacing, origin, np.array(direction), of_points)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape (nz, ny, nx) of the array of samples: x is the fastest."""
        low, high = self.extent[::2], self.extent[1::2]
        return tuple(high[axis] - low[axis] + self.of_points for axis in (2, 1, 0))

    def volume(self, dtype: Any, read: Callable[[int, int], NDArray[Any]]) -> Volume:
        """Return the samples, whose planes of z ``read`` returns, at their place in the world."""
        first = np.array(self.extent[::2]) + (0 if self.of_points else 0.5)
        start = _triple(self.origin + self.direction @ (self.spacing * first))
        spacing, direction = reversed_axes(self.spacing, self.direction)
        return Volume(self.shape, np.dtype(dtype), read, spacing, start, direction)


def axes_direction(axes: str) -> NDArray[np.float64]:
    """Return the direction of an array whose axes are the world's in an order, such as "zyx"."""
    return XYZ[:, ["xyz".index(name) for name in axes]]


def in_array_order(xyz: Any, axes: str) -> Triple:
    """Return three numbers given as x, y, z in the order of the array's axes."""
    return _triple(xyz["xyz".index(name)] for name in axes)


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


def take(
    volume: Volume, name: str, room: int, given: dict[str, Any], left: int | None = None
) -> dict[str, Any]:
    """Return values (nx, ny, nz), spacing, origin and direction of a volume, for ``make_grid``.

    ``given`` holds what replaces these of the file, or None. ``left`` is how many bytes of memory
    the process may still take, None if unknown.

    Raises
    ------
    GridError
        If the array is no grid, or its axes are not at right angles.
    OutOfMemoryError
        If there is no room to unpack it, or not even for one of its chunks.
    """
    check_kind(volume.dtype, volume.shape)
    placement = find_placement(volume, name)
    values = volume.stored
    if values is None or placement.world_axes != (0, 1, 2) or any(placement.backwards):
        values = unpacked(volume, placement, name, (room, left))
    return {"values": values, **place_in_world(volume, placement, given)}


def place_in_world(volume: Volume, placement: Placement, given: dict[str, Any]) -> dict[str, Any]:
    """Return spacing, origin and direction of a volume whose axes are brought into a placement."""
    spacing, origin = given["spacing"], given["origin"]
    if spacing is None and volume.spacing is not None:
        spacing = tuple(volume.spacing[placement.world_axes.index(w)] for w in range(3))
    if origin is None:
        origin = volume.origin
    if origin is not None and any(placement.backwards):
        origin = _lowest_corner(volume, placement, spacing, origin)
    direction = placement.direction if given["direction"] is None else given["direction"]
    return {"spacing": spacing, "origin": origin, "direction": direction}


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


def unpacked(
    volume: Volume,
    placement: Placement,
    name: str,
    memory: tuple[int, int | None],
    planes: tuple[int, int] | None = None,
) -> SampleArray:
    """Return the samples as an array (nx, ny, nz), in memory or in a temporary file.

    Planes of x are made contiguous; within them, the axis comes first along which boxes are short.

    Parameters
    ----------
    memory : two ints
        Bytes that the array may take, and that the process may still take, None if unknown.
    planes : two ints, optional
        Only the planes of x from the first to before the second.
    """
    room, left = memory
    check_chunk(volume, name, left)
    if volume.packed is not None:
        whole = ArrayHeader(volume.shape, volume.dtype, False, 0)
        check_ratio(whole, volume.packed, name, room)
    layout = layout_of(volume, placement, left)
    nx, ny, nz = (volume.shape[placement.world_axes.index(w)] for w in range(3))
    first, last = planes or (0, nx)
    swapped = placement.world_axes[layout.order[1]] == 2
    header = ArrayHeader((last - first, ny, nz), volume.dtype, swapped, 0)
    return fill(partial(_copy, volume, placement, layout, (first, last)), header, name, room)


def check_chunk(volume: Volume, name: str, left: int | None) -> None:
    """Raise OutOfMemoryError if not even one chunk, or plane, of an array can be unpacked."""
    size = prod(volume.unit) * volume.dtype.itemsize
    if left is not None and COPIES * size > (left if volume.chunks else max(left, BOX)):
        parts = "chunks" if volume.chunks else "planes"
        chunk = " x ".join(map(str, volume.unit))
        raise OutOfMemoryError(
            f"{name} is stored in {parts} of {chunk} samples, {in_words(size)} each, and to unpack "
            f"one takes {in_words(COPIES * size)} of memory, {in_words(max(left, 0))} are left; "
            "allow more (--max-memory), or store it in smaller chunks"
        )


def layout_of(volume: Volume, placement: Placement, left: int | None = None) -> Layout:
    """Return how a volume is copied: planes of x, y before z or z before y, box by box."""
    world = placement.world_axes
    orders = [tuple(world.index(w) for w in order) for order in ((0, 1, 2), (0, 2, 1))]
    budget = PIECE
    if volume.chunks:
        budget = BOX if left is None else max(min(BOX, left // LEAST_SHARE), PIECE)
    return choose_layout(volume.shape, volume.unit, orders, budget // volume.dtype.itemsize)


def _copy(
    volume: Volume,
    placement: Placement,
    layout: Layout,
    planes: tuple[int, int],
    write: Write,
) -> None:
    """Copy some planes of x of a volume box by box."""
    along, count = layout.order[0], planes[1] - planes[0]
    shape = (count, *(volume.shape[axis] for axis in layout.order[1:]))
    bounds = [(0, size) for size in volume.shape]
    bounds[along] = planes
    if placement.backwards[along]:
        bounds[along] = volume.shape[along] - planes[1], volume.shape[along] - planes[0]
    for box in boxes_of(bounds, layout.box):
        block = np.ascontiguousarray(turned(volume.box(box), placement, layout.order))
        start = [_start(volume, placement, box, axis) for axis in layout.order]
        start[0] -= planes[0]
        for offset, piece in runs_of(block, tuple(start), shape):
            write(offset, piece)
        del block  # before the next one is read


def turned(block: NDArray[Any], placement: Placement, order: tuple[int, ...]) -> NDArray[Any]:
    """Return a box of an array with its axes in an order, and none backwards."""
    flipped = tuple(axis for axis in range(3) if placement.backwards[axis])
    return np.flip(block, flipped).transpose(order)


def _start(volume: Volume, placement: Placement, box: Box, axis: int) -> int:
    """Return where the samples of a box begin along an axis that no longer runs backwards."""
    start: int = box[axis].start
    return volume.shape[axis] - box[axis].stop if placement.backwards[axis] else start
