"""Connected regions of samples that are NaN, or marked, made of their runs along z.

Only where the runs begin is kept in memory, and the planes are looked at one after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray
from .planes import SampleArray

Ints = NDArray[np.int64]
IsMarked = Callable[[NDArray[Any]], BoolArray]
RUN_BYTES = 32  # per sample of a plane, to number its runs


class Regions:
    """Regions of marked samples, and of which sides the others beside them are.

    ``planes`` are those of ``runs_of_plane``; ``before`` (nx + 1,) counts their runs. Of each run
    are ``start``, its first sample in C order, ``size``, and ``root``, the first run of its region;
    and whether this has ``positive`` samples beside it, ``negative`` ones or 0, and both or none
    (``unsure``).
    """

    def __init__(
        self,
        shape: tuple[int, ...],
        planes: Iterable[tuple[Ints, ...] | None],
        is_marked: IsMarked = np.isnan,
    ) -> None:
        self.is_marked = is_marked
        self.before = np.zeros(shape[0] + 1, np.int64)
        none = np.empty(0, np.int64)
        parts: list[tuple[Ints, ...]] = [(none, none, none.reshape(2, 0), none, none)]
        for i, runs in enumerate(planes):
            self.before[i + 1] = self.before[i]
            if runs is not None:
                former, start, size, *rest = runs
                offset = self.before[i] - int(former)
                parts.append((start + i * shape[1] * shape[2], size, *(x + offset for x in rest)))
                self.before[i + 1] += len(start)
        self.start, self.size, joined, *sides = (np.concatenate(x, axis=-1) for x in zip(*parts))
        self.root = components(len(self.start), joined)
        has = np.zeros((2, len(self.root)), bool)
        for row, side in zip(has, sides):
            row[self.root[side]] = True
        self.positive, self.negative = has[:, self.root]
        self.unsure: BoolArray = self.positive == self.negative

    @classmethod
    def of(cls, samples: SampleArray, is_marked: IsMarked) -> Regions:
        """Return the regions of marked samples, reading these plane by plane."""
        slabs = with_the_one_before(samples)
        planes = (runs_of_plane(is_marked, slab) for slab in slabs)
        return cls(tuple(samples.shape), planes, is_marked)

    def runs_of(self, i: int, marked: BoolArray) -> Ints:
        """Return the run that each sample of plane ``i`` is in, (ny, nz); -1 for others."""
        return _numbered(marked, int(self.before[i]))


def with_the_one_before(samples: SampleArray) -> Iterator[NDArray[Any]]:
    """Yield each plane with the one before it, (2, ny, nz); the first alone."""
    former: list[NDArray[Any]] = []
    for plane in samples:
        yield np.stack([*former, plane])
        former = [plane]


def runs_of_plane(is_marked: IsMarked, slab: NDArray[Any]) -> tuple[Any, ...] | None:
    """Return the runs of a plane, given with the one before it unless it is the first.

    They are the number of runs of the plane before; start and size of the plane's; pairs that
    touch, (2, n); and those beside positive samples and others. Runs are counted from the first of
    the plane before. None if no sample is NaN in both planes.
    """
    plane = slab[-1]
    if is_marked is np.isnan:  # the sum of squares tells fastest
        with np.errstate(over="ignore", under="ignore"):
            if slab.dtype.kind != "f" or not np.isnan(np.vdot(slab, slab)):
                return None
    marked = is_marked(slab)
    former = _begins(marked[0]).sum() if len(slab) > 1 else 0
    runs, start = _numbered(marked[-1], int(former)), np.flatnonzero(_begins(marked[-1]))
    size = np.bincount(runs[marked[-1]] - former, minlength=len(start))
    sides = [(runs[:, 1:], runs[:, :-1], plane[:, 1:], plane[:, :-1])]
    sides += [(runs[1:], runs[:-1], plane[1:], plane[:-1])]
    if len(slab) > 1:
        sides += [(runs, _numbered(marked[0], 0), plane, slab[0])]
    pairs, positive, negative = zip(*(_beside(*side) for side in sides))
    joined = np.concatenate(pairs, axis=1)
    return former, start, size, joined, np.concatenate(positive), np.concatenate(negative)


def _begins(marked: BoolArray) -> BoolArray:
    begins = marked.copy()
    begins[:, 1:] &= ~marked[:, :-1]
    return begins


def _numbered(marked: BoolArray, first: int) -> Ints:
    """Return the run that each sample of a plane is in, counted from ``first``; -1 for others."""
    numbers = np.cumsum(_begins(marked)).reshape(marked.shape) + (first - 1)
    return np.where(marked, numbers, -1)


def _beside(
    runs: Ints, other_runs: Ints, values: NDArray[Any], other_values: NDArray[Any]
) -> tuple[Ints, Ints, Ints]:
    """Return the pairs of runs beside each other, (2, n), and the runs beside known samples.

    First those beside positive ones, then those beside others; each array is that of neighbours.
    """
    one, other = runs >= 0, other_runs >= 0
    both = one & other
    base = int(max(runs.max(initial=0), other_runs.max(initial=0))) + 1
    pairs = np.stack(np.divmod(np.unique(runs[both] * base + other_runs[both]), base))
    lone, lone_other = one & ~other, other & ~one
    mine = np.concatenate([runs[lone], other_runs[lone_other]])
    theirs = np.concatenate([other_values[lone], values[lone_other]])
    return pairs, np.unique(mine[theirs > 0]), np.unique(mine[theirs <= 0])


def components(count: int, pairs: Ints) -> Ints:
    """Return the lowest of the numbers from 0 to ``count`` that each is joined to by pairs."""
    root = np.arange(count)
    while True:
        one, other = root[pairs]
        apart = one != other
        if not apart.any():
            return root
        pairs, low = pairs[:, apart], np.minimum(one, other)[apart]
        np.minimum.at(root, np.maximum(one, other)[apart], low)
        while (root != root[root]).any():
            root = root[root]
