"""Arrays of samples whose planes are read or made when they are needed."""

from __future__ import annotations

import mmap
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from math import prod
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..arrays import FloatArray
from ..errors import GridError
from ..threads import check_fits

FAR = 1e6  # spacings
BLOCK_BYTES = 1 << 20  # read at a time when iterating over all planes
LEAST_AT_ONCE = 4  # planes
LARGE_FILE = 1 << 27  # bytes
WORKING_BYTES = 1 << 26  # taken at a time when planes are made of others
EVENLY = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio: its multiples, modulo 2^64

Result = TypeVar("Result")
Index: TypeAlias = Sequence[int] | NDArray[Any]
"""One index per axis."""
Ranges: TypeAlias = Sequence[tuple[Any, ...]]
"""Ranges of planes: the first, that after the last, and what else a function gets."""


class SamplePlanes(ABC):
    """A 3D array, (nx, ny, nz), whose planes along the first axis are made when they are needed.

    ``name`` is what it is called in messages.
    """

    ndim = 3
    beside = 0  # planes, and rows, to either side on which those that are made depend
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    name: str = "the grid"

    @abstractmethod
    def read(self, first: int, last: int) -> NDArray[Any]:
        """Return planes ``first`` to ``last`` (exclusive), (last - first, ny, nz)."""

    def crop(self, low: Index, high: Index) -> SampleArray:
        """Return the samples from index ``low`` to before ``high``, read when they are needed."""
        return CroppedPlanes(self, low, high)

    @property
    def block(self) -> int:
        """Planes that are best made at a time when iterating over all."""
        plane = self.shape[1] * self.shape[2] * self.dtype.itemsize
        return max(BLOCK_BYTES // plane, 2 * self.beside, 1)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, which: int | slice) -> NDArray[Any]:
        """Return one plane or a range of planes, as indexing an array would."""
        if isinstance(which, slice):
            first, last, step = which.indices(len(self))
            return self.read(first, last) if step == 1 else self.loaded[which]
        number = range(len(self))[which]
        plane: NDArray[Any] = self.read(number, number + 1)[0]
        return plane

    def __iter__(self) -> Iterator[NDArray[Any]]:
        for first, last in in_blocks(self):
            yield from self.read(first, last)

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

    ``make`` takes some planes of ``source`` and returns as many, in ``unit``; it takes ``each``
    bytes per sample. Values depend on ``beside`` planes, and rows, to either side.
    """

    def __init__(
        self,
        source: SampleArray,
        make: Callable[[NDArray[Any]], NDArray[Any]],
        beside: int = 0,
        dtype: DTypeLike = np.float64,
        *,
        unit: float = 1.0,
        each: int = 16,
    ) -> None:
        self.source, self.make, self.beside = source, make, beside
        self.unit, self.each = unit, each
        self.shape, self.dtype = tuple(source.shape), np.dtype(dtype)

    def crop(self, low: Index, high: Index) -> SampleArray:
        """Return the samples in a box, made of those of the source in a box around it."""
        around = [max(n - self.beside, 0) for n in low]
        beyond = [min(n + self.beside, count) for n, count in zip(high, self.shape)]
        source = cropped(self.source, around, beyond)
        made = DerivedPlanes(
            source, self.make, self.beside, self.dtype, unit=self.unit, each=self.each
        )
        inner = ([a - b for a, b in zip(ends, around)] for ends in (low, high))
        return CroppedPlanes(made, *inner)

    def read(self, first: int, last: int) -> NDArray[Any]:
        """Return planes ``first`` to ``last`` (exclusive); some rows at a time, to save memory."""
        low, high = max(first - self.beside, 0), min(last + self.beside, len(self))
        if last <= first:
            return np.empty((0, *self.shape[1:]), self.dtype)
        source = np.asarray(self.source[low:high])
        out = np.empty((last - first, *self.shape[1:]), self.dtype)
        step = WORKING_BYTES // (len(source) * self.shape[2] * self.each)
        if step < self.shape[1]:
            step = max(step - 2 * self.beside, 2 * self.beside, 1)
        for start in range(0, self.shape[1], step):
            stop, low_row = min(start + step, self.shape[1]), max(start - self.beside, 0)
            made = self.make(source[:, low_row : stop + self.beside])[first - low : last - low]
            out[:, start:stop] = made[:, start - low_row : stop - low_row]
        return out if self.unit == 1 else np.multiply(out, self.unit, out=out)


class NoPlanes(SamplePlanes):
    """Shape and type of an array whose samples are not at hand."""

    def __init__(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        self.shape, self.dtype = tuple(shape), dtype

    def read(self, first: int, last: int) -> NDArray[Any]:
        """Raise GridError: there are none."""
        raise GridError("the samples of the grid are not at hand")

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what is known."""
        return NoPlanes, (self.shape, self.dtype)


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


def over_planes(
    samples: SampleArray, work: Callable[..., Result], ranges: Ranges
) -> Iterator[Result]:
    """Yield what a function makes of ranges of planes, in order.

    Planes that are made, and that a range shares with the one before, are not made again; they are
    valid during the call.
    """
    if not isinstance(samples, SamplePlanes):
        for first, last, *more in ranges:
            yield work(samples[first:last], *more)
            let_go(samples)
        return
    held = max((last - first for first, last, *_ in ranges), default=0)
    planes = np.empty((held, *samples.shape[1:]), samples.dtype)
    start = end = 0  # of the planes that are held
    for first, last, *more in ranges:
        kept = end - first if start <= first < end else 0
        if kept and first > start:
            planes[:kept] = planes[first - start : end - start]
        for low in range(first + kept, last, samples.block):  # which stay in the cache
            high = min(low + samples.block, last)
            planes[low - first : high - first] = samples[low:high]
        start, end = first, max(last, first + kept)
        yield work(planes[: last - first], *more)


def let_go(samples: SampleArray) -> None:
    """Let the system take back the pages of a large mapped file: they count as held memory."""
    while hasattr(samples, "source"):
        samples = samples.source
    mapped: Any = getattr(samples, "_mmap", None)
    if hasattr(mapped, "madvise") and len(mapped) > LARGE_FILE:
        mapped.madvise(mmap.MADV_DONTNEED)


def in_blocks(samples: SampleArray) -> list[tuple[int, int]]:
    """Return ranges of all planes, those together that are read together."""
    step = samples.block if isinstance(samples, SamplePlanes) else 1
    return [(i, min(i + step, len(samples))) for i in range(0, len(samples), step)]


def planes_at_once(samples: SampleArray) -> int:
    """Return how many planes are best made at a time: not few, if each needs many beside it."""
    return max(2 * getattr(samples, "beside", 0), LEAST_AT_ONCE)


def spread_planes(first: int, last: int, most: int) -> list[int]:
    """Return evenly spread planes from ``first`` to ``last`` (inclusive), a limited number."""
    return sorted({int(i) for i in np.linspace(first, last, most)})


def in_spacings(values: NDArray[Any], unit: float) -> FloatArray:
    """Return values over a unit as float32; from ``FAR`` on their size does not matter."""
    return np.clip(values.astype(np.float64) / unit, -FAR, FAR).astype(np.float32)


def ranks_of(numbers: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Return a rank for the number of each sample: the lowest ranks are spread evenly over all."""
    return numbers.astype(np.uint64) * EVENLY


def lowest(ranks: NDArray[np.uint64], most: int) -> NDArray[np.bool_] | slice:
    """Return which are the ``most`` lowest of different ranks; all if there are not more."""
    return ranks <= np.partition(ranks, most - 1)[most - 1] if len(ranks) > most else slice(None)


class Few(list[tuple[NDArray[Any], ...]]):
    """Arrays of rows, of which few are held: of at most ``most`` samples, those of lowest rank.

    Each part has the ranks of n samples, and arrays of n rows; how they are parted does not matter.
    """

    def __init__(self, most: int) -> None:
        super().__init__()
        self.most = most

    def append(self, part: tuple[NDArray[Any], ...]) -> None:
        """Add a part."""
        super().append(part)
        if sum(len(ranks) for ranks, *_ in self) > 2 * self.most:
            self[:] = [self.joined()]

    def joined(self) -> tuple[NDArray[Any], ...]:
        """Return the ranks and the arrays of those that are kept; there is at least one part."""
        arrays = [np.concatenate(parts) for parts in zip(*self)]
        some = lowest(arrays[0], self.most)
        return tuple(array[some] for array in arrays)
