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
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ..arrays import FloatArray, Triple, without_device
from ..errors import GridError, seen
from ..threads import check_fits

FAR = 1e6  # spacings
BLOCK_BYTES = 1 << 20  # read at a time when iterating over all planes
LEAST_AT_ONCE = 4  # planes
LARGE_FILE = 1 << 27  # bytes
# Bytes taken at a time when planes are made of others, and per sample, measured.
WORKING_BYTES, EACH = 1 << 26, 60

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
SKEW = 1e-3  # largest error of a product of two columns: files hold few digits
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
        return CroppedPlanes(self, low, high)

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


class LazyPlanes(SamplePlanes):
    """An array of h5py, Zarr, Dask or the like, which is read by slices."""

    def __init__(self, source: Any) -> None:
        self.source, self.shape, self.dtype = source, tuple(source.shape), np.dtype(source.dtype)

    def read(self, first: int, last: int) -> NDArray[Any]:
        """Return planes ``first`` to ``last`` (exclusive)."""
        return np.asarray(self.source[first:last])

    def crop(self, low: Index, high: Index) -> SampleArray:
        """Return the samples in a box, which alone is read."""
        return np.asarray(self.source[_box(low, high)])


class CroppedPlanes(SamplePlanes):
    """The samples of another array in a box."""

    def __init__(self, source: SamplePlanes, low: Index, high: Index) -> None:
        self.source, self.box = source, _box(low, high)
        self.shape, self.dtype = tuple(s.stop - s.start for s in self.box), source.dtype
        self.beside = source.beside

    def read(self, first: int, last: int) -> NDArray[Any]:
        """Return planes ``first`` to ``last`` (exclusive)."""
        start = self.box[0].start
        return self.source.read(start + first, start + last)[:, self.box[1], self.box[2]]


class DerivedPlanes(SamplePlanes):
    """Planes that are made of those of another array, and of some beside them.

    ``make`` takes some planes of ``source`` and returns as many. Values depend on ``beside``
    samples to either side along each axis. If they depend on their place in the grid, ``make``
    takes ``numbered`` planes: whole ones, and the number of the first.
    """

    def __init__(
        self,
        source: SampleArray,
        make: Callable[..., NDArray[Any]],
        beside: int = 0,
        dtype: DTypeLike = np.float64,
        *,
        numbered: bool = False,
    ) -> None:
        self.source, self.make, self.beside, self.numbered = source, make, beside, numbered
        self.shape, self.dtype = tuple(source.shape), np.dtype(dtype)

    def crop(self, low: Index, high: Index) -> SampleArray:
        """Return the samples in a box, made of those of the source in a box around it."""
        if self.numbered:
            return super().crop(low, high)
        around = [max(n - self.beside, 0) for n in low]
        beyond = [min(n + self.beside, count) for n, count in zip(high, self.shape)]
        source = cropped(self.source, around, beyond)
        made = DerivedPlanes(source, self.make, self.beside, self.dtype)
        return CroppedPlanes(made, *([a - b for a, b in zip(ends, around)] for ends in (low, high)))

    def read(self, first: int, last: int) -> NDArray[Any]:
        """Return planes ``first`` to ``last`` (exclusive); some rows at a time, to save memory."""
        low, high = max(first - self.beside, 0), min(last + self.beside, len(self))
        out = np.empty((last - first, *self.shape[1:]), self.dtype)
        if last <= first:
            return out
        source, own = np.asarray(self.source[low:high]), slice(first - low, last - low)
        if self.numbered:
            return self.make(source, low)[own]
        step = WORKING_BYTES // (len(source) * self.shape[2] * EACH)
        if step < self.shape[1]:
            step = max(step - 2 * self.beside, 2 * self.beside, 1)
        for start in range(0, self.shape[1], step):
            stop, low_row = min(start + step, self.shape[1]), max(start - self.beside, 0)
            made = self.make(source[:, low_row : stop + self.beside])[own]
            out[:, start:stop] = made[:, start - low_row : stop - low_row]
        return out


def cropped(samples: SampleArray, low: Index, high: Index) -> SampleArray:
    """Return the samples from index ``low`` (3,) to before ``high``."""
    if isinstance(samples, SamplePlanes):
        return samples.crop(low, high)
    return samples[_box(low, high)]


def _box(low: Index, high: Index) -> tuple[slice, ...]:
    return tuple(slice(int(first), int(last)) for first, last in zip(low, high))


def changed(
    samples: SampleArray,
    change: Callable[[NDArray[Any]], NDArray[Any]],
    dtype: DTypeLike = np.float64,
) -> DerivedPlanes:
    """Return samples changed one by one, each for itself; as float64 they are changed as such."""
    if dtype is np.float64:
        return DerivedPlanes(samples, lambda planes: change(planes.astype(np.float64)))
    return DerivedPlanes(samples, change, dtype=dtype)


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


def spread_planes(first: int, last: int, most: int) -> list[int]:
    """Return evenly spread planes from ``first`` to ``last`` (inclusive), a limited number."""
    return sorted({int(i) for i in np.linspace(first, last, most)})


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


def as_triple(number: ArrayLike, name: str) -> Triple:
    """Return one number or three as three finite floats; ``name`` is that in messages."""
    try:
        array = np.asarray(number)
        if array.dtype.kind not in "fiu":  # booleans and strings are refused
            raise TypeError
        with np.errstate(over="ignore"):  # of long doubles, which are found to be infinite below
            triple = np.broadcast_to(array.astype(np.float64).ravel(), (3,))
    except (TypeError, ValueError, RuntimeError):
        raise GridError(f"{name} is {seen(number)}: give one number or three") from None
    if not np.isfinite(triple).all():
        raise GridError(f"{name} is {seen(number)}: it must be finite")
    return float(triple[0]), float(triple[1]), float(triple[2])


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
    try:
        array = np.asarray(direction)
        if array.dtype.kind not in "fiu" or array.shape not in ((9,), (3, 3)):
            raise TypeError
    except (TypeError, ValueError, RuntimeError):
        raise GridError(
            f"direction is {seen(direction)}: give nine numbers, row by row, or a 3 x 3 matrix"
        ) from None
    matrix = array.astype(np.float64).reshape(3, 3)
    if not np.isfinite(matrix).all():
        raise GridError(f"direction is {in_rows(matrix)}: it must be finite")
    products = matrix.T @ matrix
    off = np.abs(products - np.eye(3))
    if off.max() > SKEW:
        a, b = (int(n) for n in np.unravel_index(off.argmax(), (3, 3)))
        fault = f"column {a + 1} has length {np.sqrt(products[a, a]):.4g}"
        if a != b:
            fault = f"columns {a + 1} and {b + 1} are not at right angles"
        raise GridError(
            f"direction is {in_rows(matrix)}: {fault}; give unit vectors at right angles, or "
            "resample a sheared grid"
        )
    return STRAIGHT if np.abs(matrix - np.eye(3)).max() <= DIGITS else as_direction(matrix)


def as_direction(matrix: Any) -> Direction:
    """Return a 3 x 3 matrix row by row, as floats."""
    (a, b, c), (d, e, f), (g, h, i) = (map(float, row) for row in np.asarray(matrix))
    return (a, b, c), (d, e, f), (g, h, i)


def in_rows(matrix: Any) -> str:
    """Return a matrix as text, row by row."""
    return "; ".join(", ".join(f"{entry:.4g}" for entry in row) for row in np.asarray(matrix))


class Placed(NamedTuple):
    """Samples along increasing x, y and z, and what their coordinates say: None if nothing."""

    values: ArrayLike | SamplePlanes
    spacing: ArrayLike | None = None
    origin: ArrayLike | None = None


def placed(
    values: ArrayLike | SamplePlanes,
    spacing: ArrayLike | None = None,
    origin: ArrayLike | None = None,
) -> Placed:
    """Return samples and their place in the world; of a ``DataArray``, from its coordinates.

    A spacing or an origin that is given replaces that of the coordinates. Dimensions are x, y and z
    in any order, besides some of length 1.
    """
    xarray: Any = sys.modules.get("xarray")
    if xarray is None or not isinstance(values, (xarray.DataArray, xarray.Dataset)):
        return Placed(values, spacing, origin)
    if isinstance(values, xarray.Dataset):
        names = ", ".join(map(str, values.data_vars)) or "none"
        raise GridError(f"values are a Dataset: give one of its arrays ({names})")
    array: Any = values
    if array.ndim < len(AXES):
        check_kind(array.dtype, array.shape)  # raises
    wanted = UNNAMED if set(array.dims) == set(UNNAMED) else AXES
    extra = [name for name in array.dims if name not in wanted]
    if not set(wanted) <= set(array.dims):
        raise GridError(
            f"dimensions are {', '.join(map(repr, array.dims)) or 'none'}: name those of the axes "
            "'x', 'y' and 'z', with array.rename(...)"
        )
    for name in extra:
        if array.sizes[name] > 1:
            raise GridError(
                f"dimension {name!r} has length {array.sizes[name]:,}: choose one, such as "
                f"array.isel({name}=0)"
            )
    array = array.isel(dict.fromkeys(extra, 0)).transpose(*wanted)
    check_kind(array.dtype, array.shape)
    return _at_coordinates(array, spacing, origin)


def _at_coordinates(array: Any, spacing: ArrayLike | None, origin: ArrayLike | None) -> Placed:
    names = [x for x in array.dims if x in array.coords and array.coords[x].dims == (x,)]
    if array.chunks is not None:
        check_fits(array.nbytes, "the array of Dask, whole,", "save it as .npy and give its path")
    samples: NDArray[Any] = np.asanyarray(array.values)
    if not names:
        return Placed(samples, spacing, origin)
    if len(names) < len(AXES):
        missing = next(name for name in array.dims if name not in names)
        raise GridError(
            f"dimension {missing!r} has no coordinates, but {names[0]!r} has: give those of all "
            "axes, or of none (array.drop_vars(...))"
        )
    firsts, steps = zip(*(even_steps(name, array.coords[name].values) for name in names))
    samples = samples[tuple(slice(None, None, -1 if step < 0 else 1) for step in steps)]
    lowest = [first + min(step, 0) * (n - 1) for first, step, n in zip(firsts, steps, array.shape)]
    spacing = np.abs(steps) if spacing is None else spacing
    return Placed(samples, spacing, lowest if origin is None else origin)


def even_steps(name: str, coordinates: NDArray[Any]) -> tuple[float, float]:
    """Return the first of some coordinates, and the step; GridError unless they are even."""
    if coordinates.dtype.kind not in "fiu":
        raise GridError(
            f"coordinates of {name!r} have dtype {coordinates.dtype}: give numbers, in the unit of "
            "the distances"
        )
    places = coordinates.astype(np.float64)
    bad = np.flatnonzero(~np.isfinite(places))
    if len(bad):
        raise GridError(
            f"coordinate {bad[0]} of {name!r} is {places[bad[0]]}: every coordinate must be finite"
        )
    first, count = float(places[0]), len(places)
    step = float(places[-1] - first) / (count - 1)
    is_float = coordinates.dtype.kind == "f"
    rounding = np.finfo(coordinates.dtype).eps * np.abs(places).max() if is_float else 0.0
    off = np.abs(places - (first + step * np.arange(count))).max()
    if step == 0 or off > EVEN * abs(step) + rounding:
        steps = np.diff(places)
        usual = float(np.median(steps))
        worst = int(np.abs(steps - usual).argmax())
        raise GridError(
            f"coordinates of {name!r} are not evenly spaced: {places[worst]:.6g} is followed by "
            f"{places[worst + 1]:.6g}, a step of {steps[worst]:.6g} among steps of {usual:.6g}; "
            f"resample the array (array.interp({name}=...))"
        )
    return first, step


def as_samples(values: ArrayLike | SamplePlanes) -> SampleArray:
    """Return samples as an array; those that are read by slices are not loaded."""
    if isinstance(values, SamplePlanes):
        return values
    if hasattr(values, "chunks") and isinstance(getattr(values, "dtype", None), np.dtype):
        return LazyPlanes(values)  # of h5py, Zarr or Dask
    try:
        samples: NDArray[Any] = np.asanyarray(without_device(values))
    except (TypeError, ValueError, RuntimeError):  # ragged lists
        raise GridError(f"values are {seen(values)}: give an array of three axes") from None
    if not hasattr(samples, "mask"):
        return samples
    masked = np.ma.getmaskarray(samples)  # of a masked array: what is masked is unknown
    if not masked.any() or samples.dtype.kind not in "fiu":
        return np.asarray(np.ma.filled(samples, False) if masked.any() else samples.data)
    data = np.array(samples.data, np.result_type(samples.dtype, np.float32))
    data[masked] = np.nan
    return data


def check_kind(dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
    """Raise GridError if an array of this type and shape cannot be a grid."""
    if dtype.kind not in "fiub":
        raise GridError(f"values have dtype {dtype}: give floating-point or integer numbers")
    if len(shape) != 3:
        raise GridError(f"values have shape {shape}: give three axes (x, y, z)")
    if min(shape) < 2:
        raise GridError(f"values have shape {shape}: give at least 2 samples on each axis")
