"""What a reader of a file format is asked for and returns: an array, and its place in the world.

A reader only says what the file says. Here, and nowhere else, the axes of the array are brought
into the order and sense in which they lie nearest to the world's. What is left is the direction of
the grid.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from itertools import permutations
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import Triple
from ..errors import FileError, OptionError, OutOfMemoryError
from ..grid.samples import Direction, as_direction, check_direction
from ..threads import in_words

STRAIGHT = 1e-4  # an axis that is off by less than this from a world axis counts as along it
MOST_NAMED = 10  # arrays that an error lists
COPIES = 2  # of an array that is loaded, while its axes are put in order
PLACE = ("spacing", "origin", "direction")
XYZ = np.eye(3)


@dataclass(frozen=True)
class Request:
    """What a reader is asked for."""

    path: Path
    member: str | None  # the name of an array in the file
    axes: str  # the order in a file that does not state one: "xyz" or "zyx"
    files: ExitStack  # closes what the reader opens, once the samples are read
    left: int | None = None  # bytes of memory that the process may still take, if that is known
    describes: bool = False  # no sample will be read: the file is described

    def check_fits(self, shape: Sequence[int], dtype: np.dtype[Any]) -> None:
        """Raise OutOfMemoryError if an array that is loaded whole does not fit."""
        need = COPIES * prod(map(int, shape)) * dtype.itemsize
        if self.left is not None and need > self.left:
            raise OutOfMemoryError(
                f"{self.path}, {in_words_of(shape, dtype)}, is loaded whole, which takes "
                f"{in_words(need)} of memory, {in_words(self.left)} are left; allow more "
                "(--max-memory), or save it as .npy in C order"
            )

    def choose(self, names: Sequence[str], what: str) -> str:
        """Return the name of the array to read: the one asked for, else the only one."""
        if not names:
            raise FileError(f"{self.path} holds no {what}")
        listed = ", ".join(names[:MOST_NAMED])
        if len(names) > MOST_NAMED:
            listed += f" and {len(names) - MOST_NAMED:,} more"
        if self.member is not None:
            same = [name for name in names if name.strip("/") == self.member.strip("/")]
            if not same:
                raise FileError(f"{self.path} has no {what} {self.member!r}: it holds {listed}")
            return same[0]
        if len(names) > 1:
            raise FileError(
                f"{self.path} holds several arrays, {listed}: give {self.path}:{names[0]}, say"
            )
        return names[0]


@dataclass(frozen=True)
class Volume:
    """An array of samples in a file, and where they are in the world.

    Sample (a, b, c) of the axes in space is at ``origin + direction @ (spacing * (a, b, c))``:
    spacings are those along the axes of the array, and the columns of ``direction`` (unit vectors)
    their world directions.
    """

    load: Callable[[], Any]  # returns the samples
    stored: Sequence[int]  # their shape
    dtype: np.dtype[Any]
    spacing: Triple | None = None
    origin: Triple | None = None
    direction: NDArray[np.float64] | None = None
    kept: tuple[int, ...] = (0, 1, 2)  # the axes in space; others have length 1
    axes: str | None = None  # order of x, y and z along the array, if the file or user names it
    space: str | None = None  # "RAS" or "LPS", if the file states one of them
    notes: tuple[str, ...] = ()  # sentences on what the file says, for the user
    about: dict[str, Any] = field(default_factory=dict)  # how it is stored, for ``info``
    # spacing, origin, direction of x, y, z as the file has them, unchecked, instead of those above
    place: dict[str, Any] = field(default_factory=dict)
    is_mapped: bool = False  # the samples stay in the file

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of samples along each axis that is kept."""
        return tuple(int(self.stored[axis]) for axis in self.kept)

    def read(self) -> NDArray[Any]:
        """Return the samples along the axes that are kept."""
        samples: NDArray[Any] = np.asanyarray(self.load())
        if samples.shape != tuple(self.stored):
            raise FileError(f"its header promises {self.stored} samples, it holds {samples.shape}")
        where = [slice(None) if axis in self.kept else 0 for axis in range(samples.ndim)]
        kept: NDArray[Any] = samples[tuple(where)]
        return kept

    def in_space(self, space: str | None, name: str) -> Volume:
        """Return it in an anatomical space, its own if None; OptionError if it states none."""
        if space in (None, self.space):
            return self
        if self.space is None:
            raise OptionError(f"space is {space}: {name} states neither RAS nor LPS, leave it out")
        turn = np.array([-1.0, -1.0, 1.0])  # between the two
        origin = None if self.origin is None else triple(turn * self.origin)
        turned = turn[:, None] * (XYZ if self.direction is None else self.direction)
        return replace(self, origin=origin, direction=turned, space=space)


def of_array(values: Any) -> tuple[Callable[[], Any], tuple[int, ...], np.dtype[Any]]:
    """Return how a ``Volume`` loads an array that is at hand, its shape and its type."""
    return lambda: values, tuple(values.shape), np.dtype(values.dtype)


class Placement(NamedTuple):
    """Which world axis each axis of an array runs along, or nearest to, and whether backwards.

    ``direction`` is that of the array with its axes in this order and sense, None if they run along
    the world's.
    """

    world_axes: tuple[int, ...]
    backwards: tuple[bool, ...]
    direction: Direction | None = None

    @property
    def is_straight(self) -> bool:
        """Whether the axes of the array are nearest to x, y and z in this order and sense."""
        return self.world_axes == (0, 1, 2) and not any(self.backwards)

    def of_world(self, numbers: Sequence[Any]) -> tuple[Any, ...]:
        """Return what is said of the axes of an array for those nearest to x, y and z."""
        return tuple(numbers[self.world_axes.index(world)] for world in range(3))

    def ordered(self, samples: NDArray[Any]) -> NDArray[Any]:
        """Return a view of samples with their axes along x, y and z."""
        flips = tuple(axis for axis in range(3) if self.backwards[axis])
        turned = np.flip(samples, flips) if flips else samples
        return turned.transpose(self.of_world((0, 1, 2)))


def triple(numbers: Any) -> Triple:
    """Return three numbers as floats."""
    x, y, z = (float(number) for number in numbers)
    return x, y, z


def in_words_of(shape: Sequence[int], dtype: np.dtype[Any]) -> str:
    """Return shape, type and size of an array, for messages."""
    size = prod(map(int, shape)) * dtype.itemsize
    return f"{' x '.join(map(str, shape))} {dtype}, {size:,} bytes"


def kept_axes(shape: Sequence[int]) -> tuple[int, ...]:
    """Return the axes of an array without those of length 1 that are beside three others."""
    single = [axis for axis, count in enumerate(shape) if count == 1][: max(len(shape) - 3, 0)]
    return tuple(axis for axis in range(len(shape)) if axis not in single)


def from_affine(matrix: NDArray[Any]) -> tuple[Triple, Triple, NDArray[np.float64]]:
    """Split an affine (3 or 4, 4) into spacing, origin and direction of the array's axes."""
    columns = np.asarray(matrix, np.float64)[:3, :3]
    lengths = np.linalg.norm(columns, axis=0)
    direction = columns / np.where(lengths > 0, lengths, 1)
    return triple(lengths), triple(np.asarray(matrix, np.float64)[:3, 3]), direction


def axes_direction(axes: str) -> NDArray[np.float64]:
    """Return the direction of an array whose axes are the world's in an order, such as "zyx"."""
    return XYZ[:, ["xyz".index(name) for name in axes]]


def find_placement(volume: Volume) -> Placement:
    """Return how the axes of an array lie; raise GridError if they are not at right angles."""
    direction = XYZ if volume.direction is None else np.asarray(volume.direction)
    rounded = np.rint(direction)
    along = np.abs(rounded)
    straight = np.abs(direction - rounded).max() <= STRAIGHT  # False for NaN
    if straight and (along.sum(0) == 1).all() and (along.sum(1) == 1).all():
        backwards = rounded.sum(0) < 0
        return Placement(tuple(map(int, along.argmax(0))), tuple(map(bool, backwards)))
    check_direction(direction)

    def nearness(order: tuple[int, ...]) -> float:
        return float(np.abs(direction[order, (0, 1, 2)]).sum())

    world_axes = max(permutations(range(3)), key=nearness)
    backwards = direction[world_axes, (0, 1, 2)] < 0
    turned = np.empty((3, 3))
    turned[:, world_axes] = np.where(backwards, -direction, direction)
    return Placement(world_axes, tuple(map(bool, backwards)), as_direction(turned))


def place_in_world(volume: Volume, placement: Placement, given: dict[str, Any]) -> dict[str, Any]:
    """Return the place of a volume in a placement; ``given`` replaces what the file says of it."""
    place = {k: volume.place.get(k) if given.get(k) is None else given[k] for k in PLACE}
    spacing, origin, direction = place.values()
    if spacing is None and volume.spacing is not None:
        spacing = placement.of_world(volume.spacing)
    if origin is None:
        origin = volume.origin
    if origin is not None and any(placement.backwards):  # to the sample that comes first now
        columns = XYZ if placement.direction is None else np.array(placement.direction)
        steps = np.broadcast_to(np.asarray(spacing, np.float64), 3)
        origin = np.broadcast_to(np.asarray(origin, np.float64), 3).copy()
        for count, axis, is_back in zip(volume.shape, placement.world_axes, placement.backwards):
            origin -= is_back * columns[:, axis] * ((count - 1) * steps[axis])
    direction = placement.direction if direction is None else direction
    return {"spacing": spacing, "origin": origin, "direction": direction}
