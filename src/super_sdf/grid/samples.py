"""Arrays of samples that are read by planes, and where they lie: spacing, direction, coordinates.

xarray is not imported: whoever has a ``DataArray`` has imported it.
"""

from __future__ import annotations

import mmap
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from math import prod
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ..arrays import FloatArray, Triple, without_device
from ..errors import GridError, seen
from ..threads import check_fits

FAR = 1e6  # spacings
BLOCK_BYTES = 1 << 20  # read at a time when iterating over all planes
LEAST_AT_ONCE = 4  # planes
LARGE_FILE = 1 << 27  # bytes

# Spacings that differ by less than this ratio count as equal. Coarser axes are resampled to the
# finest spacing, so a large ratio makes many samples of few.
EQUAL_SPACING, MOST_UNEQUAL = 1e-3, 50.0
# Within these, areas, volumes and squared areas neither overflow nor underflow.
LEAST_SPACING, MOST_SPACING = 1e-60, 1e60

Index: TypeAlias = Sequence[int] | NDArray[Any]
"""One index per axis."""
Direction: TypeAlias = tuple[Triple, Triple, Triple]
"""A matrix, row by row; its columns are the world directions of the array's axes."""

STRAIGHT: Direction = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
SKEW = 1e-3  # largest error of a length or a product of two columns: files hold few digits
FLAT = 0.1  # volume of the box of three axes, below which they nearly lie in a plane
DIGITS = 1e-9  # a matrix this near to the identity is it

AXES = ("x", "y", "z")
UNNAMED = ("dim_0", "dim_1", "dim_2")  # xarray's names of dimensions that got none
EVEN = 1e-3  # of a step: how far coordinates may be from even ones, besides their rounding


class SamplePlanes(ABC):
    """A 3D array, (nx, ny, nz), whose planes along the first axis are made when they are needed.

    ``name`` is what it is called in messages.
    """

    ndim = 3
    beside = 0  # planes to either side on which those that are made depend
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    name: str = "the grid"

    @abstractmethod
    def read(self, first: int, last: int) -> NDArray[Any]:
        """Return planes ``first`` to ``last`` (exclusive), (last - first, ny, nz)."""

    def crop(self, low: Index, high: Index) -> SampleArray:
        """Return the samples from index ``low`` to before ``high``, read when they are needed."""
        return MadePlanes(self, _same, dtype=self.dtype, box=(low, high))

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, which: int | slice) -> NDArray[Any]:
        """Return one plane or a range of planes, as indexing an array would."""
        if isinstance(which, slice):
            first, last, step = which.indices(len(self))
            return self.read(first, max(first, last)) if step == 1 else self.loaded[which]
        number = range(len(self))[which]
        plane: NDArray[Any] = self.read(number, number + 1)[0]
        return plane

    def __iter__(self) -> Iterator[NDArray[Any]]:
        plane = self.shape[1] * self.shape[2] * self.dtype.itemsize
        for block in in_blocks(self, max(BLOCK_BYTES // plane, 2 * self.beside, 1)):
            yield from self[block]

    @cached_property
    def loaded(self) -> NDArray[Any]:
        """The whole array, which stays in memory; OutOfMemoryError if it is too large."""
        size = prod(self.shape) * self.dtype.itemsize
        check_fits(size, f"{self.name}, whole,", "read it plane by plane (SdfGrid.planes)")
        return self.read(0, len(self))

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self.loaded, dtype) if copy else np.asarray(self.loaded, dtype)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the array itself: another process may not have what it is made from."""
        return np.asarray, (self.loaded,)


SampleArray: TypeAlias = NDArray[Any] | SamplePlanes
"""An array of samples in memory, or one whose planes are read or made when they are needed."""


class MadePlanes(SamplePlanes):
    """Planes that are made of those of another array, and of some beside them.

    ``make`` takes some planes of ``source``, anything that is sliced, and returns as many. Values
    depend on ``beside`` samples to either side along each axis. Of what is made, a ``box`` is kept.
    """

    def __init__(
        self,
        source: Any,
        make: Callable[[NDArray[Any]], NDArray[Any]],
        beside: int = 0,
        dtype: DTypeLike = np.float64,
        box: tuple[Index, Index] | None = None,
    ) -> None:
        self.source, self.make, self.beside = source, make, beside
        low, high = box or ((0, 0, 0), source.shape)
        self.low, self.dtype = tuple(map(int, low)), np.dtype(dtype)
        self.shape = tuple(int(b) - a for a, b in zip(self.low, high))

    def read(self, first: int, last: int) -> NDArray[Any]:
        """Return planes ``first`` to ``last`` (exclusive)."""
        first, last = first + self.low[0], last + self.low[0]
        start, stop = max(first - self.beside, 0), min(last + self.beside, self.source.shape[0])
        made = self.make(np.asarray(self.source[start:stop]))[first - start : last - start]
        rows, row = (slice(a, a + n) for a, n in zip(self.low[1:], self.shape[1:]))
        return made[:, rows, row].astype(self.dtype, copy=False)

    def crop(self, low: Index, high: Index) -> SampleArray:
        """Return the samples in a box, made of those of the source in a box around it."""
        low, high = np.add(low, self.low), np.add(high, self.low)
        around = np.maximum(low - self.beside, 0)
        source = cropped(self.source, around, np.minimum(high + self.beside, self.source.shape))
        box = low - around, high - around
        return MadePlanes(source, self.make, self.beside, self.dtype, box)


def _same(planes: NDArray[Any]) -> NDArray[Any]:
    return planes


def cropped(samples: Any, low: Index, high: Index) -> SampleArray:
    """Return the samples from index ``low`` (3,) to before ``high``."""
    if isinstance(samples, SamplePlanes):
        return samples.crop(low, high)
    part: NDArray[Any] = np.asanyarray(samples[tuple(map(slice, map(int, low), map(int, high)))])
    return part


def changed(
    samples: SampleArray,
    change: Callable[[NDArray[Any]], NDArray[Any]],
    dtype: DTypeLike = np.float64,
) -> MadePlanes:
    """Return samples changed one by one, each for itself; as float64 they are changed as such."""
    if dtype is np.float64:
        return MadePlanes(samples, lambda planes: change(planes.astype(np.float64)))
    return MadePlanes(samples, change, dtype=dtype)


def let_go(samples: SampleArray) -> None:
    """Let the system take back the pages of a large mapped file: they count as held memory."""
    while hasattr(samples, "source"):
        samples = samples.source
    mapped: Any = getattr(samples, "_mmap", None)
    if hasattr(mapped, "madvise") and len(mapped) > LARGE_FILE:
        mapped.madvise(mmap.MADV_DONTNEED)


def in_blocks(samples: SampleArray, step: int) -> list[slice]:
    """Return ranges of ``step`` planes, the last one of what is left."""
    return [slice(i, min(i + step, len(samples))) for i in range(0, len(samples), step)]


def planes_at_once(samples: SampleArray) -> int:
    """Return how many planes are best made at a time: not few, if each needs many beside it."""
    return max(2 * getattr(samples, "beside", 0), LEAST_AT_ONCE)


def in_spacings(values: NDArray[Any], unit: float) -> FloatArray:
    """Return values over a unit as float32; from ``FAR`` on their size does not matter."""
    return np.clip(values.astype(np.float64) / unit, -FAR, FAR).astype(np.float32)


def over_three(values: NDArray[Any], choose: np.ufunc) -> NDArray[Any]:
    """Return the least, or the largest, of each sample and the 26 round it."""
    for axis in range(3):
        source, chosen = np.moveaxis(values, axis, 0), np.moveaxis(values.copy(), axis, 0)
        choose(chosen[1:], source[:-1], out=chosen[1:])
        choose(chosen[:-1], source[1:], out=chosen[:-1])
        values = np.moveaxis(chosen, 0, axis)
    return values


def as_samples(values: ArrayLike | SamplePlanes) -> SampleArray:
    """Return samples as an array; those that are read by slices are not loaded."""
    if isinstance(values, SamplePlanes):
        return values
    stored: Any = values
    if hasattr(stored, "chunks") and isinstance(getattr(stored, "dtype", None), np.dtype):
        return MadePlanes(stored, _same, dtype=stored.dtype)  # of h5py, Zarr or Dask
    try:
        samples: NDArray[Any] = np.asanyarray(without_device(values))
    except (TypeError, ValueError, RuntimeError):  # ragged lists
        raise GridError(f"values are {seen(values)}: give an array of three axes") from None
    if not hasattr(samples, "mask"):  # of a masked array: what is masked is unknown
        return samples
    if samples.dtype.kind in "fiu":
        samples = samples.astype(np.result_type(samples.dtype, np.float32))
    return np.ma.filled(samples, np.nan if samples.dtype.kind == "f" else False)


def check_kind(dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
    """Raise GridError if an array of this type and shape cannot be a grid."""
    if dtype.kind not in "fiub":
        raise GridError(f"values have dtype {dtype}: give floating-point or integer numbers")
    if len(shape) != 3:
        raise GridError(f"values have shape {shape}: give three axes (x, y, z)")
    if min(shape) < 2:
        raise GridError(f"values have shape {shape}: give at least 2 samples on each axis")


# Where samples lie


def as_numbers(given: ArrayLike, name: str, count: int, what: str) -> NDArray[np.float64]:
    """Return finite numbers, (count,), of as many or of one; GridError, by a name, otherwise."""
    try:
        array = np.asarray(given)
        if array.dtype.kind not in "fiu":  # booleans and strings are refused
            raise TypeError
        with np.errstate(over="ignore"):  # of long doubles, which are found to be infinite below
            numbers = np.broadcast_to(array.astype(np.float64).ravel(), (count,))
    except (TypeError, ValueError, RuntimeError):
        raise GridError(f"{name} is {seen(given)}: give {what}") from None
    if not np.isfinite(numbers).all():
        raise GridError(f"{name} is {seen(given)}: it must be finite")
    return numbers


def as_triple(number: ArrayLike, name: str) -> Triple:
    """Return one number or three as three finite floats; ``name`` is that in messages."""
    x, y, z = as_numbers(number, name, 3, "one number or three").tolist()
    return x, y, z


def check_spacing(spacing: ArrayLike) -> Triple:
    """Return the spacing as three floats; GridError unless they are positive and within range."""
    triple = as_triple(spacing, "spacing")
    said = f"spacing is {', '.join(f'{number:g}' for number in triple)}"
    if min(triple) <= 0:
        raise GridError(f"{said}: it must be greater than 0")
    if not LEAST_SPACING <= min(triple) <= max(triple) <= MOST_SPACING:
        raise GridError(
            f"{said}: give lengths in a unit in which it is between "
            f"{LEAST_SPACING:g} and {MOST_SPACING:g}"
        )
    if max(triple) > min(triple) * MOST_UNEQUAL:
        raise GridError(
            f"{said}: the largest may be {MOST_UNEQUAL:g} times the smallest; "
            "leave out samples along the finer axes"
        )
    return triple


def is_cubic(spacing: Triple) -> bool:
    """Return whether a spacing is the same on all axes, up to 0.1 %."""
    return max(spacing) <= min(spacing) * (1 + EQUAL_SPACING)


def steps_of(spacing: Triple) -> Triple:
    """Return the spacing of each axis, the mean if they are nearly equal."""
    return (sum(spacing) / 3,) * 3 if is_cubic(spacing) else spacing


def check_direction(direction: ArrayLike | None) -> Direction:
    """Return a direction, nine numbers or (3, 3), row by row; None is along the world's axes."""
    if direction is None:
        return STRAIGHT
    what = "nine numbers, row by row, or a 3 x 3 matrix"
    if np.size(np.asarray(direction, object)) == 1:
        raise GridError(f"direction is {seen(direction)}: give {what}")
    matrix = as_numbers(direction, "direction", 9, what).reshape(3, 3)
    lengths = np.sqrt((matrix**2).sum(0))
    fault = f"its columns have the lengths {', '.join(f'{x:.4g}' for x in lengths)}, not 1"
    if np.abs(lengths - 1).max() <= SKEW:
        fault = "its columns lie in a plane" if abs(np.linalg.det(matrix)) < FLAT else ""
    if fault:
        raise GridError(f"direction is {in_rows(matrix)}: {fault}; give a unit vector of each axis")
    return STRAIGHT if np.abs(matrix - np.eye(3)).max() <= DIGITS else as_direction(matrix)


def is_sheared(direction: Direction) -> bool:
    """Return whether axes are not at right angles, as of a scanner whose gantry is tilted."""
    products = np.transpose(direction) @ np.array(direction)
    return bool(np.abs(products - np.eye(3)).max() > 2 * SKEW)


def as_direction(matrix: Any) -> Direction:
    """Return a 3 x 3 matrix row by row, as floats."""
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(matrix, np.float64).tolist()
    return (a, b, c), (d, e, f), (g, h, i)


def in_rows(matrix: Any) -> str:
    """Return a matrix as text, row by row."""
    return "; ".join(", ".join(f"{entry:.4g}" for entry in row) for row in np.asarray(matrix))


def placed(
    values: Any, spacing: ArrayLike | None = None, origin: ArrayLike | None = None
) -> tuple[Any, ArrayLike | None, ArrayLike | None]:
    """Return samples along x, y and z, spacing and origin; of a ``DataArray``, by its coordinates.

    What is given replaces that of the coordinates; None is not known. Dimensions are x, y and z in
    any order, besides some of length 1.
    """
    xarray: Any = sys.modules.get("xarray")
    if xarray is None or not isinstance(values, (xarray.DataArray, xarray.Dataset)):
        return values, spacing, origin
    if isinstance(values, xarray.Dataset):
        names = ", ".join(map(str, values.data_vars)) or "none"
        raise GridError(f"values are a Dataset: give one of its arrays ({names})")
    array: Any = values.squeeze(drop=True) if values.ndim > len(AXES) else values
    wanted = UNNAMED if set(array.dims) == set(UNNAMED) else AXES
    if set(array.dims) != set(wanted):
        check_kind(array.dtype, array.shape)
        raise GridError(
            f"dimensions are {', '.join(map(repr, array.dims)) or 'none'}: name those of the axes "
            "'x', 'y' and 'z', with array.rename(...)"
        )
    array = array.transpose(*wanted)
    check_kind(array.dtype, array.shape)
    if array.chunks is not None:
        check_fits(array.nbytes, "the array of Dask, whole,", "save it as .npy and give its path")
    samples, steps, lowest = np.asanyarray(array.values), list[float](), list[float]()
    named = [x for x in wanted if x in array.coords and array.coords[x].dims == (x,)]
    if 0 < len(named) < len(AXES):
        raise GridError(
            f"only {', '.join(map(repr, named))} has coordinates: give those of all axes, or of "
            "none (array.drop_vars(...))"
        )
    for axis, name in enumerate(named):
        first, step = even_steps(name, array.coords[name].values)
        lowest.append(first + min(step, 0) * (samples.shape[axis] - 1))
        steps.append(abs(step))
        samples = np.flip(samples, axis) if step < 0 else samples
    spacing = steps or None if spacing is None else spacing
    return samples, spacing, lowest or None if origin is None else origin


def even_steps(name: str, coordinates: NDArray[Any]) -> tuple[float, float]:
    """Return the first of some coordinates, and the step; GridError unless they are even."""
    if coordinates.dtype.kind not in "fiu":
        raise GridError(
            f"coordinates of {name!r} have dtype {coordinates.dtype}: give numbers, in the unit of "
            "the distances"
        )
    places = coordinates.astype(np.float64)
    first, steps = float(places[0]), np.diff(places)
    step = float(places[-1] - first) / len(steps)
    is_float = coordinates.dtype.kind == "f"
    rounding = np.finfo(coordinates.dtype).eps * np.abs(places).max() if is_float else 0.0
    off = np.abs(places - (first + step * np.arange(len(places)))).max()
    if step == 0 or not off <= EVEN * abs(step) + rounding:
        usual = float(np.nanmedian(steps))
        worst = int(np.nan_to_num(np.abs(steps - usual), nan=np.inf).argmax())
        raise GridError(
            f"coordinates of {name!r} are not evenly spaced: {places[worst]:.6g} is followed by "
            f"{places[worst + 1]:.6g}, a step of {steps[worst]:.6g} among steps of {usual:.6g}; "
            f"resample the array (array.interp({name}=...))"
        )
    return first, step
