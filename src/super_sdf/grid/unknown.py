"""Unknown samples far from the surface, NaN or infinite, as programs that fuse depth images leave.

An infinite sample is on the side of its sign. One that is NaN is on the side of the known samples
round the connected region of such samples that it lies in. All get the cut-off of their side: the
largest known distance there. Where a region has both sides beside it, the surface ends. The planes
are read one after the other, and only where the runs of NaN along z begin is kept in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray
from ..errors import GridError
from .planes import SampleArray, SamplePlanes, changed
from .samples import Extremes, not_finite
from .sides import count_border

Ints = NDArray[np.int64]
IsMarked = Callable[[NDArray[Any]], BoolArray]

LAYERS = 3  # of unknown samples to which the surface beside them is continued
RUN_BYTES = 32  # per sample of a plane, to number its runs
WAY_OUT = "replace each by a distance of the right sign (the cut-off value of its side)"


class KnownPlanes(SamplePlanes):
    """Samples whose unknown ones are replaced by the cut-off of their side, when they are read.

    Where both sides are near, the samples are continued linearly over ``LAYERS`` unknown ones.

    Parameters
    ----------
    source : (nx, ny, nz) array or SamplePlanes
        The samples.
    regions : Regions
        Of the samples that are NaN.
    limits : two floats
        The cut-offs: the lowest and the highest finite sample.
    outside : float
        The one of these that unknown samples get far from known ones of both sides.
    """

    name = "the grid"

    def __init__(
        self, source: SampleArray, regions: Regions, limits: Extremes, outside: float
    ) -> None:
        self.source, self.regions, self.limits, self.outside = source, regions, limits, outside
        self.shape, self.dtype = tuple(source.shape), source.dtype
        self.beside = 2 * LAYERS if regions.unsure.any() else 0

    @property
    def block(self) -> int:
        """Planes that are made at a time: more, if each needs some beside it."""
        return max(super().block, 2 * self.beside)

    @property
    def not_continued(self) -> KnownPlanes:
        """The same without continuations, which say nothing of the field."""
        planes = KnownPlanes(self.source, self.regions, self.limits, self.outside)
        planes.beside = 0
        return planes

    @property
    def unseen(self) -> SampleArray | None:
        """Which samples are unknown and have both sides, or none, beside their region."""
        return UnseenPlanes(self) if self.beside else None

    def read(self, first: int, last: int) -> NDArray[Any]:
        """Return planes ``first`` to ``last`` (exclusive), (last - first, ny, nz)."""
        start, stop = max(first - self.beside, 0), min(last + self.beside, len(self))
        planes = np.array(self.source[start:stop])
        low, high = self.limits
        unsure = np.zeros(planes.shape, bool)
        for i, plane in enumerate(planes, start):
            unknown, infinite = np.isnan(plane), np.isinf(plane)
            runs = self.regions.runs_of(i, unknown)[unknown]
            plane[unknown] = np.where(self.regions.positive[runs], high, low)
            plane[infinite] = np.where(plane[infinite] > 0, high, low)
            unsure[i - start][unknown] = self.regions.unsure[runs]
        if unsure.any():
            planes[unsure] = np.nan
            if self.beside:
                planes = continued(planes, self.limits)
            planes[np.isnan(planes)] = self.outside
        return planes[first - start : last - start]

    def working_bytes(self, planes: int) -> int:
        """Return about how much memory making that many planes takes."""
        plane, copies = self.shape[1] * self.shape[2], 10 if self.beside else 2
        return copies * (planes + 2 * self.beside) * self.plane_bytes + RUN_BYTES * plane


class UnseenPlanes(SamplePlanes):
    """Which samples are unknown, with both sides beside their region, or none."""

    name = "the grid"
    dtype = np.dtype(bool)

    def __init__(self, known: KnownPlanes) -> None:
        self.source, self.regions, self.shape = known.source, known.regions, known.shape

    def read(self, first: int, last: int) -> BoolArray:
        """Return planes ``first`` to ``last`` (exclusive), (last - first, ny, nz)."""
        planes = np.isnan(self.source[first:last])
        for i, unknown in enumerate(planes, first):
            unknown[unknown] = self.regions.unsure[self.regions.runs_of(i, unknown)[unknown]]
        return planes

    def refusal(self) -> str:
        """Return a sentence that says why no closed surface is known."""
        unsure = self.regions.unsure
        at = np.unravel_index(int(self.regions.start[unsure][0]), self.shape)
        first = ", ".join(str(int(index)) for index in at)
        value, count = getattr(self.source, "value", None), int(self.regions.size[unsure].sum())
        which = "" if value is None else f" (those that are exactly {value:g} are taken as such)"
        return (
            f"{count:,} samples are unknown{which}, values[{first}] the first, in regions that "
            "touch samples on both sides of the surface, so whether they are inside is unknown"
        )


def continued(planes: NDArray[Any], limits: Extremes) -> NDArray[Any]:
    """Return planes in which samples are continued linearly over ``LAYERS`` that are NaN."""
    for _ in range(LAYERS):
        total, count = np.zeros(planes.shape), np.zeros(planes.shape, np.int8)
        for axis in range(3):
            for flipped in (slice(None), slice(None, None, -1)):
                values = np.moveaxis(planes, axis, 0)[flipped]
                line = 2 * values[1:-1] - values[:-2]  # at the sample after these two
                known = np.isfinite(line)
                np.moveaxis(total, axis, 0)[flipped][2:] += np.where(known, line, 0)
                np.moveaxis(count, axis, 0)[flipped][2:] += known
        new = np.isnan(planes) & (count > 0)
        planes[new] = np.clip(total[new] / count[new], *limits)
    return planes


class Regions:
    """The connected regions of samples that are NaN, or marked, made of their runs along z.

    Parameters
    ----------
    samples : (nx, ny, nz) array or Planes
    is_marked : callable
        Returns which samples of a plane are.

    Attributes
    ----------
    before : (nx + 1,) int64
        How many runs there are before each plane, and in all.
    start, size, root : (n,) int64
        The first sample of each run, in C order, its length, and the first run of its region.
    positive, negative, unsure : (n,) bool
        Whether the region of a run has known samples beside it that are positive, and negative or
        0; and whether it has both, or none.
    """

    def __init__(self, samples: SampleArray, is_marked: IsMarked = np.isnan) -> None:
        self.is_marked = is_marked
        self.before = np.zeros(len(samples) + 1, np.int64)
        found = [self._look(i, *planes) for i, planes in enumerate(with_the_one_before(samples))]
        starts, sizes, joined, positive, negative = zip(*found)
        self.start, self.size = np.concatenate(starts), np.concatenate(sizes)
        self.root = root = components(len(self.start), np.concatenate(joined, axis=1))
        self.positive = _of_regions(root, np.concatenate(positive))
        self.negative = _of_regions(root, np.concatenate(negative))
        self.unsure: BoolArray = self.positive == self.negative

    def runs_of(self, i: int, unknown: BoolArray) -> Ints:
        """Return the run that each sample of plane ``i`` is in, (ny, nz); -1 for known ones."""
        numbers = np.cumsum(_begins(unknown)).reshape(unknown.shape) - 1 + self.before[i]
        return np.where(unknown, numbers, -1)

    def _look(
        self, i: int, plane: NDArray[Any], former: NDArray[Any] | None
    ) -> tuple[Ints, Ints, Ints, Ints, Ints]:
        """Return start and size of a plane's runs, pairs that touch, and runs beside known samples.

        The pairs, (2, n), and the runs beside positive and others may be of the plane before, too.
        """
        unknown = self.is_marked(plane)
        runs, start = self.runs_of(i, unknown), np.flatnonzero(_begins(unknown))
        size = np.bincount(runs[unknown] - self.before[i], minlength=len(start))
        self.before[i + 1] = self.before[i] + len(start)
        sides = [(runs[:, 1:], runs[:, :-1], plane[:, 1:], plane[:, :-1])]
        sides += [(runs[1:], runs[:-1], plane[1:], plane[:-1])]
        if former is not None:
            sides += [(runs, self.runs_of(i - 1, self.is_marked(former)), plane, former)]
        pairs, positive, negative = zip(*(_beside(*side) for side in sides))
        joined = np.concatenate(pairs, axis=1)
        return (
            start + i * plane.size,
            size,
            joined,
            np.concatenate(positive),
            np.concatenate(negative),
        )


def filled(samples: SampleArray, notes: list[str]) -> tuple[KnownPlanes, Extremes]:
    """Return samples of which the unknown ones are replaced, and the extremes of all.

    Parameters
    ----------
    samples : (nx, ny, nz) array or Planes
        Floating-point numbers, NaN or infinite where they are unknown.
    notes : list of str
        Sentences say how many were replaced, and how many may hide the surface.

    Raises
    ------
    GridError
        If no sample is known, or one that is infinite is beside the surface.
    """
    low, high, infinite = _look_at_numbers(samples)
    regions = Regions(samples)
    count = int(regions.size.sum()) + infinite
    outer = int(regions.size[regions.positive & ~regions.unsure].sum())
    notes.append(
        f"{count:,} samples are unknown ({count - infinite:,} NaN, of which {outer:,} lie on the "
        f"positive side, and {infinite:,} infinite): they are taken as cut off at {low:.6g} and "
        f"{high:.6g}"
    )
    outside = high
    if regions.unsure.any():
        below, above = count_border(samples)[0], count_border(changed(samples, np.negative))[0]
        outside = low if below > above else high
        notes.append(
            f"{int(regions.size[regions.unsure].sum()):,} of the unknown samples are in regions "
            "that touch both sides of the surface: it is open there"
        )
    return KnownPlanes(samples, regions, (low, high), outside), (low, high)


def finite_extremes(samples: SampleArray) -> Extremes:
    """Return the lowest and the highest finite sample; GridError if none is finite."""
    low, high, _ = _look_at_numbers(samples)
    return low, high


def _look_at_numbers(samples: SampleArray) -> tuple[float, float, int]:
    """Return the lowest and the highest finite sample, and the number of infinite ones.

    Raises
    ------
    GridError
        If none is finite, or one that is infinite is beside the surface.
    """
    low, high, infinite = np.inf, -np.inf, 0
    beside: list[Ints] = []
    for i, (plane, former) in enumerate(with_the_one_before(samples)):
        finite = plane[np.isfinite(plane)]
        low = min(low, float(finite.min(initial=np.inf)))
        high = max(high, float(finite.max(initial=-np.inf)))
        infinite += int(np.isinf(plane).sum())
        beside.append(_infinite_at_surface(i, plane, former))
    if low > high:
        raise not_finite(samples)
    _check_infinite(np.concatenate(beside), samples)
    return low, high, infinite


def _infinite_at_surface(i: int, plane: NDArray[Any], former: NDArray[Any] | None) -> Ints:
    """Return the infinite samples of a plane, and of that before, beside one of the other sign.

    They are (n, 3) indices.
    """
    pairs = [((0, 0, 1), plane[:, 1:], plane[:, :-1]), ((0, 1, 0), plane[1:], plane[:-1])]
    pairs += [((1, 0, 0), plane, former)] if former is not None else []
    found = [np.empty((0, 3), np.int64)]
    for step, one, other in pairs:
        known = ~(np.isnan(one) | np.isnan(other))
        crossed = known & ((one > 0) != (other > 0))
        for values, shift in ((one, step), (other, (0, 0, 0))):
            jk = np.argwhere(crossed & np.isinf(values))
            plane_of = np.full((len(jk), 1), i - step[0])
            found.append(np.concatenate([plane_of, jk], axis=1) + np.array(shift))
    return np.unique(np.concatenate(found), axis=0)


def _check_infinite(beside: Ints, samples: SampleArray) -> None:
    """Raise GridError if infinite samples, (n, 3), are beside the surface."""
    if len(beside):
        i, j, k = (int(index) for index in beside[0])
        raise GridError(
            f"values[{i}, {j}, {k}] is {samples[i][j, k]!s}, and a sample beside it has the other "
            f"sign, as at {len(np.unique(beside, axis=0)):,} infinite samples: where the surface "
            f"passes between them is unknown; {WAY_OUT}, or by NaN where nothing was seen"
        )


def _begins(unknown: BoolArray) -> BoolArray:
    """Return where runs of NaN begin along the rows of a plane."""
    begins = unknown.copy()
    begins[:, 1:] &= ~unknown[:, :-1]
    return begins


def with_the_one_before(
    samples: SampleArray,
) -> Iterator[tuple[NDArray[Any], NDArray[Any] | None]]:
    """Yield each plane with the one before it."""
    former = None
    for plane in samples:
        yield plane, former
        former = plane


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
    positive, negative = [], []
    for mine, theirs in (
        (runs[one & ~other], other_values[one & ~other]),
        (other_runs[other & ~one], values[other & ~one]),
    ):
        positive.append(mine[theirs > 0])
        negative.append(mine[theirs <= 0])
    return pairs, np.unique(np.concatenate(positive)), np.unique(np.concatenate(negative))


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


def _of_regions(root: Ints, runs: Ints) -> BoolArray:
    """Return which runs are in the region of one of some runs."""
    found = np.zeros(len(root), bool)
    found[root[runs]] = True
    return found[root]
