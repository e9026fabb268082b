"""The readers of grid files, by libraries that own the formats: each turns a Request into a Volume.

A reader says what the file says, in the world coordinates of the file. Here, and nowhere else, the
axes of the array are brought into the order and sense in which they lie nearest to the world's. A
reader may raise anything: ``files.grids`` turns what a library raises into one line.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from itertools import permutations
from math import prod
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...arrays import Triple
from ...errors import FileError, GridError, OptionError
from ...grid.samples import AXES, UNNAMED, as_triple, check_direction, even_steps
from ...threads import check_fits, memory_bound

STRAIGHT = 1e-4  # an axis that is off by less than this from a world axis counts as along it
MOST_NAMED = 10  # arrays that an error lists
COPIES = 2  # of an array that is loaded, while its axes are put in order
PLACE = ("spacing", "origin", "direction")
XYZ = np.eye(3)
LABELS, DENSITY, DISTANCE = "labels", "density", "distance"  # what a file says its values are

Index: TypeAlias = tuple[slice | int, ...]
"""Which samples of an array are read: all along its axes in space, one number of each other."""
Names: TypeAlias = dict[int, tuple[str, tuple[int, int, int] | None]]
"""Name of each label, and its colour in red, green and blue if the file states one."""


@dataclass
class Request:
    """What a reader is asked for."""

    path: Path
    member: str | None  # the name of an array in the file
    numbers: tuple[int, ...]  # along the axes that are not in space, of which one is read
    axes: str  # the order in a file that does not state one: "xyz" or "zyx"
    files: ExitStack  # closes what the reader opens, once the samples are read
    max_memory: int | None = None  # bytes that the process may hold; default: a share of the free

    def check_fits(self, shape: Sequence[int], dtype: np.dtype[Any]) -> None:
        """Raise OutOfMemoryError if an array that is loaded whole does not fit."""
        what = f"{self.path}, {' x '.join(map(str, shape))} {dtype}, loaded whole,"
        need = COPIES * prod(map(int, shape)) * dtype.itemsize
        way_out = "save it as .npy in C order, or allow more (--max-memory)"
        check_fits(need, what, way_out, memory_bound(self.max_memory))

    def choose(self, names: Sequence[str], what: str) -> str:
        """Return the name of the array to read: the one asked for, else the only one."""
        if not names:
            raise FileError(f"{self.path} holds no {what}")
        listed = ", ".join(names[:MOST_NAMED]) + ", ..." * (len(names) > MOST_NAMED)
        if self.member is None and len(names) > 1:
            example = f"{self.path}:{names[0]}"
            error = FileError(f"{self.path} holds several arrays, {listed}: give {example}, say")
            error.names = names
            raise error
        whole = (self.member or "") + "".join(f"[{number}]" for number in self.numbers)
        for wanted, numbers in ((whole, ()), (self.member or names[0], self.numbers)):
            if same := [name for name in names if name.strip("/") == wanted.strip("/")]:
                self.numbers = numbers  # none if brackets are a part of the name
                return same[0]
        raise FileError(f"{self.path} has no {what} {self.member!r}: it holds {listed}")

    def choose_array(self, shapes: Mapping[str, Sequence[int]]) -> str:
        """Return the name of the array to read, of three axes or more, by the shapes of all."""
        names = [name for name, shape in shapes.items() if len(shape) >= 3]
        return self.choose(names, "array of three axes")

    def pick(
        self, shape: Sequence[int], kept: Sequence[int] | None = None, names: Sequence[str] = ()
    ) -> Index:
        """Return which samples of an array are read; GridError if an axis or a number is missing.

        ``kept`` are the axes in space, by default the longest.
        """
        if len(shape) < 3:
            raise GridError(f"{self.path} has shape {tuple(shape)}: give a file of three axes")
        if kept is None:
            kept = sorted(range(len(shape)), key=lambda axis: shape[axis])[-3:]
        others = [n for n, count in enumerate(shape) if n not in kept and count != 1]
        if len(self.numbers) > len(others):
            raise OptionError(f"{self.path} has {len(others)} axes to choose from by [0], [1], ...")
        chosen = dict(zip(others, self.numbers))
        for axis in others:
            if chosen.get(axis, shape[axis]) >= shape[axis]:
                said = f"its axis {(names[axis] if names else '') or axis} has {shape[axis]}"
                name = f"{self.path}:{self.member}" if self.member else self.path
                say = f"choose one, {name}{'[0]' * len(others)}, say"
                raise GridError(f"{said} entries, from 0 on: {say}")
        return tuple(slice(None) if n in kept else chosen.get(n, 0) for n in range(len(shape)))


@dataclass(frozen=True)
class Volume:
    """An array of samples in a file, and where they are in the world.

    Sample (a, b, c) of the axes in space is at ``origin + direction @ (spacing * (a, b, c))``:
    spacings are those along the axes of the array, and the columns of ``direction`` (unit vectors)
    their world directions.
    """

    load: Callable[[Index], Any]  # returns the samples at an index
    stored: Sequence[int]  # the shape of the array
    dtype: np.dtype[Any]
    spacing: Triple | None = None
    origin: Triple | None = None
    direction: NDArray[np.float64] | None = None
    index: Index = (slice(None),) * 3
    axes: str | None = None  # order of x, y and z along the array, if the file or user names it
    space: str | None = None  # "RAS" or "LPS", if the file states one of them
    notes: tuple[str, ...] = ()  # sentences on what the file says, for the user
    # spacing, origin, direction of x, y, z, as far as they are stated; they replace those above
    place: dict[str, Any] = field(default_factory=dict)
    is_mapped: bool = False  # the samples stay in the file
    hint: str = ""  # what the file says its values are: LABELS, DENSITY, DISTANCE
    names: Names = field(default_factory=dict)

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of samples along each axis in space."""
        return tuple(int(self.stored[axis]) for axis in kept_of(self.index))

    def read(self) -> NDArray[Any]:
        """Return the samples along the axes in space."""
        samples: NDArray[Any] = np.asanyarray(self.load(self.index))
        if samples.shape != self.shape:
            raise FileError(f"its header promises {self.shape} samples, it holds {samples.shape}")
        return samples

    def in_space(self, space: str | None, name: str) -> Volume:
        """Return it in an anatomical space, its own if None; OptionError if it states none."""
        if space in (None, self.space):
            return self
        if self.space is None:
            raise OptionError(f"{name} states neither RAS nor LPS: leave out --space {space}")
        turn = np.array([-1.0, -1.0, 1.0])  # between the two
        origin = None if self.origin is None else triple(turn * self.origin)
        turned = turn[:, None] * (XYZ if self.direction is None else self.direction)
        return replace(self, origin=origin, direction=turned, space=space)


def triple(numbers: Any) -> Triple:
    """Return three numbers as floats."""
    x, y, z = (float(number) for number in numbers)
    return x, y, z


def from_affine(matrix: NDArray[Any]) -> dict[str, Any]:
    """Split an affine, or the columns that are no origin, into spacing, origin and direction."""
    columns = np.asarray(matrix, np.float64)[:3, :3]
    lengths = np.linalg.norm(columns, axis=0)
    place = {"spacing": triple(lengths), "direction": columns / np.where(lengths > 0, lengths, 1)}
    return {**place, "origin": triple(matrix[:3, 3]) if matrix.shape[1] > 3 else None}


def kept_of(index: Index) -> list[int]:
    """Return the axes of an array that are in space."""
    return [axis for axis, at in enumerate(index) if isinstance(at, slice)]


def axes_direction(axes: str) -> NDArray[np.float64]:
    """Return the direction of an array whose axes are the world's in an order, such as "zyx"."""
    return XYZ[:, ["xyz".index(name) for name in axes]]


def find_placement(
    volume: Volume, given: dict[str, Any]
) -> tuple[tuple[int, ...], tuple[int, ...], dict[str, Any]]:
    """Return which axes of an array lie nearest to x, y and z, which run backwards, and its place.

    The place is spacing, origin and direction: ``given``, else the file's, else None.
    """
    direction = XYZ if volume.direction is None else np.asarray(volume.direction, np.float64)
    check_direction(direction)
    nearness = np.abs(direction)
    order = max(permutations(range(3)), key=lambda axes: float(nearness[(0, 1, 2), axes].sum()))
    is_back = direction[(0, 1, 2), order] < 0
    turned = direction[:, order] * np.where(is_back, -1, 1)
    place = {k: volume.place.get(k) if given.get(k) is None else given[k] for k in PLACE}
    if place["direction"] is None and np.abs(turned - XYZ).max() > STRAIGHT:
        place["direction"] = turned
    spacing, origin, frame = place.values()
    if spacing is None and volume.spacing is not None:
        spacing = tuple(volume.spacing[axis] for axis in order)
    origin = volume.origin if origin is None else origin
    if origin is not None and is_back.any():  # to the sample that comes first now
        ends = np.array([volume.shape[axis] - 1 for axis in order]) * is_back
        steps = np.broadcast_to(np.asarray(spacing, np.float64), 3)
        frame = XYZ if frame is None else np.reshape(frame, (3, 3))
        origin = np.asarray(origin, np.float64) - frame @ (ends * steps)
    return order, tuple(np.flatnonzero(is_back)), {**place, "spacing": spacing, "origin": origin}


# What HDF5, Zarr, NetCDF, MATLAB and TIFF files say of the axes of an array, and of its values


class Axis(NamedTuple):
    """What a file says of an axis, "" or None where it does not."""

    name: str = ""
    unit: str = ""
    step: float | None = None  # from a sample to the next, below 0 along a falling axis
    start: float | None = None  # position of the first sample


def one_unit(units: Sequence[str]) -> tuple[bool, tuple[str, ...]]:
    """Return whether x, y and z have the same unit of length, or none; and a note that names it."""
    listed = ", ".join(dict.fromkeys(filter(None, units)))
    if ", " in listed:
        said = f"its axes have different units ({listed})"
        return False, (f"{said}: spacing and origin are not taken from it (give --spacing)",)
    return True, (f"lengths are in the unit that it states, {listed}",) * bool(listed)


def measured(name: str, count: int, scale: Any) -> Axis:
    """Return an axis by its name and its scale, a variable with the coordinates, if there is one.

    By the conventions for climate and forecast data an axis may be ``positive: down``, and ``axis``
    may name it.
    """
    places = np.asarray(scale[:] if getattr(scale, "shape", ()) == (count,) else [0])
    if places[0] == places[-1]:  # none are known
        return Axis(name)
    start, step = even_steps(name, places)
    about = getattr(scale, "attrs", getattr(scale, "_attributes", {}))  # the second of SciPy
    unit, alias, positive = (
        said.decode() if isinstance(said, bytes) else str(said)
        for said in (about.get(key, "") for key in ("units", "axis", "positive"))
    )
    sign = -1 if positive.lower() == "down" else 1
    is_named = name.lower() in AXES or alias.lower() not in AXES
    return Axis(name if is_named else alias, unit, sign * step, sign * start)


def placed(
    request: Request,
    shape: Sequence[int],
    attributes: Mapping[str, Any],
    axes: Sequence[Axis] = (),
    order: str = "",
) -> dict[str, Any]:
    """Return what a ``Volume`` says of the place of an array: which axes are kept, and where.

    Attributes replace what ``axes`` says: ``element_size_um``, of ImageJ's HDF5 plugin, has the
    order of the array's axes; ``spacing``, ``origin`` and the columns of ``direction`` are x, y, z.
    ``order`` is that of axes without names.
    """
    axes = axes or [Axis()] * len(shape)
    names = ["" if axis.name in UNNAMED else axis.name.strip().lower() for axis in axes]
    in_space = [n for n, name in enumerate(names) if name in AXES]
    is_named = sorted(names[n] for n in in_space) == list(AXES)
    index = request.pick(shape, in_space if is_named else None, names)
    kept, order = kept_of(index), order or request.axes
    notes = tuple[str, ...]()
    if is_named and order == "zyx":
        order = "".join(names[n] for n in kept)
    elif not is_named and any(names[n] for n in kept):
        called = ", ".join(names[n] or "?" for n in kept)
        notes = (f"its axes are named {called}: taken as {', '.join(order)}",)
    world = [axes[kept[order.index(name)]] for name in AXES]
    is_one, told = one_unit([axis.unit for axis in world])
    spacing = origin = None
    if is_one and all(axis.step for axis in world):
        spacing = triple(abs(axes[n].step or 0) for n in kept)
        starts = [axis.start for axis in world]
        origin = None if None in starts else triple(starts)
    if "element_size_um" in attributes:
        spacing = as_triple(attributes["element_size_um"], "element_size_um")
    signs = [-1 if (axes[n].step or 0) < 0 else 1 for n in kept]
    stated: dict[str, Any] = {k: as_triple(attributes[k], k) for k in PLACE[:2] if k in attributes}
    if "direction" in attributes:
        stated["direction"] = check_direction(np.squeeze(attributes["direction"]))
    place = {"spacing": spacing, "origin": origin, "direction": axes_direction(order) * signs}
    return {**place, "place": stated, "notes": notes + told, "index": index, "axes": order}


def stored(
    values: Any, attributes: Mapping[str, Any] | None = None, none: Any = None
) -> tuple[Callable[[Index], Any], tuple[int, ...], np.dtype[Any]]:
    """Return how a ``Volume`` loads an array of a file, its shape and its type.

    By the conventions for climate and forecast data a value is ``scale_factor`` times the number,
    plus ``add_offset``; ``none``, or ``_FillValue``, is no value.
    """
    said, shape, dtype = attributes or {}, tuple(values.shape), np.dtype(values.dtype)
    is_packed = "scale_factor" in said or "add_offset" in said
    missing = np.ravel(said.get("_FillValue", none))
    # a 0 of whole numbers is the background of a mask or of labels
    if not (is_packed or ("_FillValue" in said and (dtype.kind == "f" or missing.any()))):
        return lambda index: values[index], shape, dtype
    factor = float(np.ravel(said.get("scale_factor", 1))[0])
    offset = float(np.ravel(said.get("add_offset", 0))[0])
    kind = np.result_type(dtype, np.float32)

    def load(index: Index) -> Any:
        numbers = np.asarray(values[index])
        unpacked = (numbers * factor + offset).astype(kind)
        unpacked[np.isin(numbers, missing)] = np.nan
        return unpacked

    return load, shape, kind
