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
from typing import Any, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ..arrays import FloatArray, Triple, without_device
from ..errors import GridError, seen
from ..threads import check_fits

FAR = 1e6  # spacings
BLOCK_BYTES = 1 << 20  # read at a time when iterating over all planes
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

    def read_box(self, low: Index, high: Index) -> NDArray[Any]:
        """Return the samples from index ``low`` to before ``high``."""
        return self.read(low[0], high[0])[:, low[1] : high[1], low[2] : high[2]]

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
        step = max(BLOCK_BYTES // plane, 2 * self.beside, 1)
        for first in range(0, len(self), step):
            yield from self[first : first + step]

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
    """Samples made of those of another array, anything that is sliced, in a box of it.

    ``make`` takes an array of samples and returns one of that shape. Each depends on ``beside``
    samples to either side along each axis.
    """

    def __init__(
        self,
        source: Any,
        make: Callable[[NDArray[Any]], NDArray[Any]] = np.asarray,
        beside: int = 0,
        dtype: DTypeLike = np.float64,
        box: tuple[Index, Index] | None = None,
    ) -> None:
        self.source, self.make, self.margin, self.dtype = source, make, beside, np.dtype(dtype)
        self.beside = beside + getattr(source, "beside", 0)
        low, high = box or ((0,) * len(source.shape), source.shape)
        self.low, self.shape = np.array(low), tuple(np.subtract(high, low).tolist())

    def read(self, first: int, last: int) -> NDArray[Any]:
        """Return planes ``first`` to ``last`` (exclusive)."""
        return self.read_box((first, 0, 0), (last, *self.shape[1:]))

    def read_box(self, low: Index, high: Index) -> NDArray[Any]:
        """Return the samples in a box, made of those in a box around it."""
        low, high = self.low + low, self.low + high
        start = np.maximum(low - self.margin, 0)
        stop = np.minimum(high + self.margin, self.source.shape)
        made = self.make(read_box(self.source, start, stop))
        return made[slices(low - start, high - start)].astype(self.dtype, copy=False)


def slices(low: Index, high: Index) -> tuple[slice, ...]:
    """Return what indexes an array from index ``low`` (3,) to before ``high``."""
    return tuple(map(slice, map(int, low), map(int, high)))


def read_box(samples: Any, low: Index, high: Index) -> NDArray[Any]:
    """Return the samples from index ``low`` (3,) to before ``high`` as an array."""
    if isinstance(samples, SamplePlanes):
        return samples.read_box(low, high)
    return np.asanyarray(samples[slices(low, high)])


def cropped(samples: SampleArray, low: Index, high: Index) -> SampleArray:
    """Return the samples from index ``low`` (3,) to before ``high``, read when they are needed."""
    if isinstance(samples, SamplePlanes):
        return MadePlanes(samples, dtype=samples.dtype, box=(low, high))
    return samples[slices(low, high)]


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


def as_samples(values: Any) -> SampleArray:
    """Return samples along three axes as an array; those that are read by slices are not loaded."""
    while getattr(values, "ndim", 0) > len(AXES) and values.shape[0] == 1:  # a batch, a channel
        values = values[0]
    samples: Any = values
    if hasattr(values, "chunks") and isinstance(getattr(values, "dtype", None), np.dtype):
        check_kind(values.dtype, values.shape)
        samples = MadePlanes(values, dtype=values.dtype)  # of h5py, Zarr or Dask
    elif not isinstance(values, SamplePlanes):
        try:
            samples = np.asanyarray(without_device(values))
        except (TypeError, ValueError, RuntimeError):  # ragged lists
            raise GridError(f"values are {seen(values)}: give an array of three axes") from None
    if hasattr(samples, "mask") and samples.dtype.kind in "fiub":  # what is masked is unknown
        samples = np.ma.filled(samples.astype(np.result_type(samples.dtype, np.float32)), np.nan)
    check_kind(samples.dtype, samples.shape)
    return cast(SampleArray, samples)


def check_kind(dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
    """Raise GridError if an array of this type and shape cannot be a grid."""
    if dtype.kind not in "fiub":
        raise GridError(f"values have dtype {dtype}: give floating-point or integer numbers")
    if len(shape) != 3 or not all(count >= 2 for count in shape):  # nor NaN, of Dask
        how = "give three axes (x, y, z), with at least 2 samples on each"
        raise GridError(f"values have shape {shape}: {how}")


# Where samples lie


def as_numbers(
    given: ArrayLike, name: str, what: str = "one number or three", sizes: Index = (1, 3)
) -> NDArray[np.float64]:
    """Return finite numbers, (n,), as many as one of the sizes; ``name`` is that in messages."""
    try:
        array = np.asarray(given)
        if array.dtype.kind not in "fiu" or array.size not in sizes:  # nor booleans, nor strings
            raise TypeError
        with np.errstate(over="ignore"):  # of long doubles, which are found to be infinite below
            numbers = array.astype(np.float64).ravel()
    except (TypeError, ValueError, RuntimeError):
        raise GridError(f"{name} is {seen(given)}: give {what}") from None
    if not np.isfinite(numbers).all():
        raise GridError(f"{name} is {seen(given)}: it must be finite")
    return numbers


def as_triple(number: ArrayLike, name: str) -> Triple:
    """Return one number or three as three finite floats; ``name`` is that in messages."""
    x, y, z = np.broadcast_to(as_numbers(number, name), (3,)).tolist()
    return x, y, z


def check_spacing(spacing: ArrayLike) -> Triple:
    """Return the spacing as three floats; GridError unless they are positive and within range."""
    triple = as_triple(spacing, "spacing")
    least, most = min(triple), max(triple)
    if not (LEAST_SPACING <= least <= most <= MOST_SPACING and most <= least * MOST_UNEQUAL):
        raise GridError(
            f"spacing is {', '.join(f'{number:g}' for number in triple)}: give lengths from "
            f"{LEAST_SPACING:g} to {MOST_SPACING:g}, the largest at most {MOST_UNEQUAL:g} times "
            "the smallest"
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
    matrix = as_numbers(direction, "direction", what, (9,)).reshape(3, 3)
    if np.abs(np.linalg.norm(matrix, axis=0) - 1).max() > SKEW or abs(np.linalg.det(matrix)) < FLAT:
        how = "give a unit vector of each axis, as columns that lie in no plane"
        raise GridError(f"direction is {in_rows(matrix)}: {how}")
    x, y, z = (as_triple(row, "direction") for row in matrix)
    return STRAIGHT if np.abs(matrix - np.eye(3)).max() <= DIGITS else (x, y, z)


def in_rows(matrix: Any) -> str:
    """Return a matrix as text, row by row."""
    return "; ".join(", ".join(f"{entry:.4g}" for entry in row) for row in np.asarray(matrix))


def placed(
    values: Any, spacing: ArrayLike | None = None, origin: ArrayLike | None = None
) -> tuple[SampleArray, ArrayLike | None, ArrayLike | None]:
    """Return samples along x, y and z, spacing and origin; of a ``DataArray``, by its coordinates.

    What is given replaces that of the coordinates; None is not known. Dimensions are x, y and z in
    any order, besides some of length 1.
    """
    xarray: Any = sys.modules.get("xarray")
    if xarray is None or not isinstance(values, xarray.DataArray):
        return as_samples(values), spacing, origin
    array: Any = values.squeeze(drop=True) if values.ndim > len(AXES) else values
    check_kind(array.dtype, array.shape)
    wanted = UNNAMED if set(array.dims) == set(UNNAMED) else AXES
    found = [name for name in array.dims if name in array.coords]
    if set(array.dims) != set(wanted) or len(found) not in (0, len(AXES)):
        named, known = (", ".join(map(repr, names)) or "none" for names in (array.dims, found))
        how = "name them 'x', 'y' and 'z' (array.rename), with coordinates of all or none"
        raise GridError(f"dimensions are {named}, with coordinates of {known}: {how}")
    if array.chunks is not None:
        check_fits(array.nbytes, "the array of Dask, whole,", "save it as .npy and give its path")
    array = array.transpose(*wanted).sortby(found)  # falling coordinates rise then
    if found:
        first, step = zip(*(even_steps(x, array.coords[x].values) for x in wanted))
        spacing, origin = (x if x is not None else y for x, y in ((spacing, step), (origin, first)))
    return as_samples(array.values), spacing, origin


def even_steps(name: str, coordinates: NDArray[Any]) -> tuple[float, float]:
    """Return the first of some coordinates, and the step; GridError unless they are even."""
    said, count = f"coordinates of {name!r}", len(coordinates)
    places = as_numbers(coordinates, said, "numbers, in the unit of the distances", (count,))
    first, step = float(places[0]), float(places[-1] - places[0]) / (count - 1)
    off = np.abs(places - (first + step * np.arange(count))).max()
    if step == 0 or off > EVEN * abs(step) + np.spacing(np.abs(coordinates).max()):
        steps = np.diff(places)
        raise GridError(
            f"{said} are not evenly spaced, but in steps of {steps.min():.6g} to "
            f"{steps.max():.6g}: resample the array (array.interp({name}=...))"
        )
    return first, step
