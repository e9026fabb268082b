"""Unknown samples, NaN or infinite or a value that stands for them: their side, and distances.

An infinite sample is on the side of its sign. Others are on the side of the known samples round the
connected region of unknown ones that they lie in. All get the cut-off of their side: the largest
known distance there. A region with both sides beside it is filled in by what is round it if it is
small; else the surface ends there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray
from ..errors import GridError
from .look import Extremes, Look, border_share
from .samples import DerivedPlanes, SampleArray, changed

Ints: TypeAlias = NDArray[np.int64]
IsMarked: TypeAlias = Callable[[NDArray[Any]], BoolArray]

LAYERS = 3  # of unknown samples to which the surface beside them is continued
SMALL = 8  # samples of a region between both sides that is filled in
MOST_KNOWN = 1e-3  # of all samples: more in small regions are a pattern, and stay unknown
WAY_OUT = "replace each by a distance of the right sign (the cut-off value of its side)"


class Known(NamedTuple):
    """Samples whose unknown ones are replaced, when they are read, and their extremes.

    Where both sides are near, they are continued linearly over ``LAYERS`` unknown ones; farther
    away they are outside. ``unseen`` is which of them are unknown and in large regions with both
    sides, or none, beside them; None if none are.
    """

    samples: SampleArray
    extremes: Extremes
    unknown: int  # how many samples were
    unseen: SampleArray | None
    why_open: str


def with_known(
    samples: SampleArray, look: Look, values: Sequence[float], notes: list[str]
) -> Known:
    """Return samples without unknown ones; some ``values`` stand for these, too."""
    which, named = "", " or ".join(f"{value:g}" for value in values)
    if values:
        known = changed(samples, lambda planes: np.where(np.isin(planes, values), np.nan, planes))
        finite = [plane[np.isfinite(plane)] for plane in known]
        low, high = (float(end(np.concatenate(finite))) for end in (np.min, np.max))
        which = f" (those that are exactly {named} are taken as such)"
        samples = known
    else:
        low, high = look.low, look.high
    if look.infinite:
        _check_infinite(samples)
    regions = Regions(samples, np.isnan)
    count = int(regions.size.sum())
    if values:
        notes.append(
            f"{count:,} samples are exactly {named}, where no distance is: they are taken as "
            "unknown (write NaN where nothing was seen)"
        )
    outer = int(regions.size[regions.positive & ~regions.unsure].sum())
    notes.append(
        f"{count + look.infinite:,} samples are unknown ({count:,} NaN, of which {outer:,} lie "
        f"on the positive side, and {look.infinite:,} infinite): they are taken as cut off at "
        f"{low:.6g} and {high:.6g}"
    )
    whole = np.bincount(regions.root, regions.size, len(regions.root))[regions.root]
    small = regions.unsure & (whole <= SMALL)
    if regions.size[small].sum() > MOST_KNOWN * np.prod(samples.shape, dtype=float):
        small[:] = False
    unsure = regions.unsure & ~small
    outside = low if border_share(look, lambda x: (x < 0) & ~np.isin(x, values)) > 0.5 else high

    def known_of(planes: NDArray[Any], first: int) -> NDArray[Any]:
        planes = np.array(planes)
        for i, plane in enumerate(planes, first):
            unknown, infinite = np.isnan(plane), np.isinf(plane)
            runs = regions.runs_of(i, unknown)[unknown]
            of_side = np.where(regions.positive[runs], high, low)
            plane[unknown] = np.where(regions.unsure[runs], np.nan, of_side)
            plane[infinite] = np.where(plane[infinite] > 0, high, low)
        planes = _continued(planes, (low, high))
        planes[np.isnan(planes)] = outside
        return planes

    def unseen_of(planes: NDArray[Any], first: int) -> BoolArray:
        marked: BoolArray = np.isnan(planes)
        for i, unknown in enumerate(marked, first):
            unknown[unknown] = unsure[regions.runs_of(i, unknown)[unknown]]
        return marked

    filled = DerivedPlanes(samples, known_of, 2 * LAYERS, samples.dtype, numbered=True)
    total = count + look.infinite
    if not unsure.any():
        return Known(filled, (low, high), total, None, "")
    count = int(regions.size[unsure].sum())
    notes.append(
        f"{count:,} of the unknown samples are in regions that touch both sides of the surface: "
        "it is open there"
    )
    at = np.unravel_index(int(regions.start[unsure][0]), samples.shape)
    why = (
        f"{count:,} samples are unknown{which}, values[{', '.join(map(str, map(int, at)))}] the "
        "first, in regions that touch samples on both sides of the surface, so whether they are "
        "inside is unknown"
    )
    unseen = DerivedPlanes(samples, unseen_of, dtype=bool, numbered=True)
    return Known(filled, (low, high), total, unseen, why)


def _continued(planes: NDArray[Any], limits: Extremes) -> NDArray[Any]:
    for _ in range(LAYERS if np.isnan(planes).any() else 0):
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


def _check_infinite(samples: SampleArray) -> None:
    """Raise GridError if infinite samples are beside the surface."""
    beside: set[tuple[int, int, int]] = set()
    former: list[NDArray[Any]] = []
    for i, plane in enumerate(samples):
        slab = np.stack([*former, plane])
        former = [plane]
        at = np.indices(slab.shape)
        at[0] += i + 1 - len(slab)
        for axis in range(3):
            lines, places = np.moveaxis(slab, axis, 0), np.moveaxis(at, axis + 1, 1)
            one, other = lines[1:], lines[:-1]
            crossed = ~(np.isnan(one) | np.isnan(other)) & ((one > 0) != (other > 0))
            for values, where in ((one, places[:, 1:]), (other, places[:, :-1])):
                beside |= set(map(tuple, where[:, crossed & np.isinf(values)].T.tolist()))
    if beside:
        i, j, k = min(beside)
        raise GridError(
            f"values[{i}, {j}, {k}] is {samples[i][j, k]!s}, and a sample beside it has the other "
            f"sign, as at {len(beside):,} infinite samples: where the surface passes between them "
            f"is unknown; {WAY_OUT}, or by NaN where nothing was seen"
        )


class Regions:
    """Connected regions of marked samples, made of their runs along z; planes are read in order.

    Only the runs are kept in memory. Of each run are ``start``, its first sample in C order,
    ``size``, and ``root``, the first run of its region; and whether this has ``positive`` samples
    beside it, ``negative`` ones or 0, and both or none (``unsure``). ``before`` (nx + 1,) counts
    the runs of the planes before each.
    """

    def __init__(self, samples: SampleArray, is_marked: IsMarked) -> None:
        self.is_marked, size = is_marked, samples.shape[1] * samples.shape[2]
        self.before = np.zeros(samples.shape[0] + 1, np.int64)
        none = np.empty(0, np.int64)
        parts: list[tuple[Ints, ...]] = [(none, none, none.reshape(2, 0), none, none)]
        former: tuple[Ints, NDArray[Any]] | None = None
        for i, plane in enumerate(samples):
            marked = is_marked(plane)
            runs, begins = self.runs_of(i, marked), np.flatnonzero(_begins(marked))
            first, self.before[i + 1] = self.before[i], self.before[i] + len(begins)
            sides = [(runs[:, 1:], runs[:, :-1], plane[:, 1:], plane[:, :-1])]
            sides += [(runs[1:], runs[:-1], plane[1:], plane[:-1])]
            sides += [(runs, former[0], plane, former[1])] if former else []
            if len(begins) or (former and self.before[i] > self.before[i - 1]):
                pairs, positive, negative = zip(*(_beside(*side) for side in sides))
                sizes = np.bincount(runs[marked] - first, minlength=len(begins))
                near = np.concatenate(positive), np.concatenate(negative)
                parts.append((begins + i * size, sizes, np.concatenate(pairs, axis=1), *near))
            former = runs, plane
        self.start, self.size, joined, *beside = (np.concatenate(x, axis=-1) for x in zip(*parts))
        self.root = components(len(self.start), joined)
        has = np.zeros((2, len(self.root)), bool)
        for row, side in zip(has, beside):
            row[self.root[side]] = True
        self.positive, self.negative = has[:, self.root]
        self.unsure: BoolArray = self.positive == self.negative

    def runs_of(self, i: int, marked: BoolArray) -> Ints:
        """Return the run that each sample of plane ``i`` is in, (ny, nz); -1 for others."""
        numbers = np.cumsum(_begins(marked)).reshape(marked.shape) + (int(self.before[i]) - 1)
        return np.where(marked, numbers, -1)


def _begins(marked: BoolArray) -> BoolArray:
    begins = marked.copy()
    begins[:, 1:] &= ~marked[:, :-1]
    return begins


def _beside(
    runs: Ints, other_runs: Ints, values: NDArray[Any], other_values: NDArray[Any]
) -> tuple[Ints, Ints, Ints]:
    """Return the pairs of runs beside each other, (2, n), and the runs beside known samples.

    First those beside positive ones, then those beside others; each array is that of neighbours.
    """
    one, other = runs >= 0, other_runs >= 0
    base, both = int(max(runs.max(), other_runs.max(), 0)) + 1, one & other
    pairs = np.stack(np.divmod(np.unique(runs[both] * base + other_runs[both]), base))
    mine = np.concatenate([runs[one & ~other], other_runs[other & ~one]])
    theirs = np.concatenate([other_values[one & ~other], values[other & ~one]])
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
