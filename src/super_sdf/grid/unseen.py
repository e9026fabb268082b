"""Values that stand for samples that were never seen, such as 0, 1, -1000 or 1e10.

Many programs write one where others write NaN. It is told by what no distance does: whole regions
of samples have exactly this value, and beside them the values jump; or they are 0 throughout.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray
from ..errors import GridError
from .planes import SampleArray, SamplePlanes, over_planes, spread_planes
from .samples import Extremes
from .unknown import RUN_BYTES, Ints, Regions, with_the_one_before

MOST_PLANES, MOST_LOOKED = 32, 1 << 15  # planes and samples that show which values are tried
FREQUENT, LEAST_VALUES = 8, 6  # values that are tried, and different ones that tell steepness
# From sample to sample values change by at most ``JUMP`` times the steepest typical change, but
# beside unseen ones: nearly all changes there are larger.
STEEPEST, JUMP, UNSEEN = 0.95, 1.5, 0.9
# Share of the changes of sign that are jumps from where values are cut off: .00 where all was seen,
# .15 and more where the unseen has that value, too; also at the edges of what few views saw, but
# there the unseen was filled in, and the sign changes as often from one extreme to the other.
MIXED, FILLED_IN = 0.1, 0.03
FEW_SPANS = 3.0  # times what few values span is more than they change by
MANY = 4096  # samples among which different values are counted
ENOUGH = 30  # changes from which the steepest is known
LEAST_JUMPS = 6  # beside one sample

Floats = NDArray[np.float64]


class SeenPlanes(SamplePlanes):
    """Samples that are NaN in some regions of a value, when they are read."""

    name = "the grid"
    dtype = np.dtype(np.float64)

    def __init__(
        self, source: SampleArray, regions: Regions, unseen: BoolArray, value: float
    ) -> None:
        self.source, self.regions, self.unseen, self.value = source, regions, unseen, value
        self.shape = tuple(source.shape)

    def read(self, first: int, last: int) -> NDArray[Any]:
        """Return planes ``first`` to ``last`` (exclusive), (last - first, ny, nz)."""
        planes = np.array(self.source[first:last], np.float64)
        for i, plane in enumerate(planes, first):
            marked = self.regions.is_marked(plane)
            runs = self.regions.runs_of(i, marked)[marked]
            plane[marked] = np.where(self.unseen[runs], np.nan, plane[marked])
        return planes

    def working_bytes(self, planes: int) -> int:
        """Return about how much memory making that many planes takes."""
        return 2 * planes * self.plane_bytes + RUN_BYTES * self.shape[1] * self.shape[2]


def without_unseen(
    samples: SampleArray, extremes: Extremes, notes: list[str], *, all_known: bool
) -> SampleArray:
    """Return samples that are NaN where they have a value that stands for unseen ones.

    Of samples that are not ``all_known`` by their user, those with an extreme value may be beside
    any others: few views leave such edges.

    Raises
    ------
    GridError
        If a value may stand for them, but not everywhere.
    """
    if not extremes[0] < 0 < extremes[1]:
        return samples
    for value, steepest in _suspects(samples, extremes):
        regions = Regions(samples, partial(np.equal, value))
        unseen = _unseen_runs(samples, regions, value, steepest, extremes)
        if unseen.any():
            notes.append(
                f"{int(regions.size[unseen].sum()):,} samples are exactly {value:g}, where no "
                "distance is: they are taken as unknown (write NaN where nothing was seen)"
            )
            samples, all_known = SeenPlanes(samples, regions, unseen, value), False
        elif all_known and value in extremes:
            _check_jumps(samples, value, steepest, extremes)
    return samples


def _suspects(samples: SampleArray, extremes: Extremes) -> list[tuple[float, float]]:
    """Return values that may stand for unseen samples, and the steepest change of the others."""
    pairs = _some_pairs(samples)
    values, counts = np.unique(pairs[0], return_counts=True)
    often = values[counts >= ENOUGH][np.argsort(counts[counts >= ENOUGH])[-FREQUENT:]]
    found = []
    for value in np.unique([0.0, *extremes, *often]):
        steepest = _steepest(pairs, value, extremes)
        if value in extremes and _is_cut_near(pairs, value, steepest, extremes):
            continue
        has = pairs == value
        jumps = _are_jumps(pairs, JUMP * steepest, extremes) & (has[0] != has[1])
        if jumps.sum() >= LEAST_JUMPS or (value == 0 and has.all(0).sum() >= ENOUGH):
            found.append((float(value), steepest))
    return found


def _is_cut_near(pairs: Floats, value: float, steepest: float, extremes: Extremes) -> bool:
    """Return whether the sign changes from one extreme to the other, and others are near a value.

    So it does where values are cut off near the surface, or what is unseen was filled in by hand.
    """
    crossing = pairs[:, (pairs[0] > 0) != (pairs[1] > 0)]
    others = pairs[~_are_any(pairs, extremes)]
    near = np.abs(others - value).min(initial=np.inf) < JUMP * steepest
    return bool(near and _are_any(crossing, extremes).all(0).mean() > FILLED_IN)


def _steepest(pairs: Floats, value: float, extremes: Extremes) -> float:
    """Return the steepest change of samples without a value, or all that they span, if few tell."""
    rest, inner = pairs[pairs != value], pairs[~_are_any(pairs, (value, *extremes))]
    changes = np.abs(pairs[1] - pairs[0])[(pairs != value).all(0)]
    span = np.ptp(inner) if len(inner) else 0.0  # larger changes are those to another such value
    changes = changes[(changes > 0) & (changes <= span)]
    if len(changes) < ENOUGH or len(np.unique(inner[:MANY])) < LEAST_VALUES:
        low, high = rest.min(initial=0), rest.max(initial=0)
        return FEW_SPANS * float(high - low) if low < 0 < high else np.inf
    return float(np.quantile(changes, STEEPEST))


def _check_jumps(samples: SampleArray, value: float, steepest: float, extremes: Extremes) -> None:
    """Raise GridError if the sign changes mostly by jumps from where values are cut off."""
    pairs = _some_pairs(samples)
    pairs = pairs[:, (pairs[0] > 0) != (pairs[1] > 0)]
    jumps = _are_jumps(pairs, JUMP * steepest, extremes) & (pairs == value).any(0)
    if jumps.mean() > MIXED and jumps.sum() >= LEAST_JUMPS:
        count = sum(np.count_nonzero(plane == value) for plane in samples)
        raise GridError(
            f"{count:,} samples are exactly {value:g}, and beside some the values jump as no "
            "distance does: write NaN where nothing was seen"
        )


def _some_pairs(samples: SampleArray) -> Floats:
    """Return pairs of samples beside each other along an axis, (2, n), in some rows and planes."""
    nx, ny, nz = samples.shape
    planes = spread_planes(0, nx - 2, MOST_PLANES)
    rows = slice(0, ny - 1, -(-len(planes) * ny * nz // MOST_LOOKED))
    ranges = [(i, i + 2) for i in planes]
    pairs = np.concatenate(list(over_planes(samples, partial(_pairs_of, rows), ranges)), axis=1)
    return pairs[:, np.isfinite(pairs).all(0)]


def _pairs_of(rows: slice, slab: NDArray[Any]) -> Floats:
    """Return samples of some rows of the first of two planes with those beside them, (2, n)."""
    here = slab[0, rows]
    beside = slab[1, rows], slab[0, 1:][rows]
    parts = [np.stack([here, other]).reshape(2, -1) for other in beside]
    parts.append(np.stack([here[:, :-1], here[:, 1:]]).reshape(2, -1))
    return np.concatenate(parts, axis=1).astype(np.float64)


def _are_any(values: Floats, some: tuple[float, ...]) -> BoolArray:
    """Return which values are one of some."""
    found = np.zeros(values.shape, bool)
    for one in some:
        found |= values == one
    return found


def _are_jumps(pairs: Floats, limit: float, extremes: Extremes) -> BoolArray:
    """Return which pairs (2, n) differ by more than a limit, but for those of both extremes.

    Values that are cut off near the surface, or filled in by hand, go from one to the other.
    """
    large: BoolArray = np.abs(pairs[1] - pairs[0]) > limit
    return large & ~_are_any(pairs, extremes).all(0)


def _unseen_runs(
    samples: SampleArray, regions: Regions, value: float, steepest: float, extremes: Extremes
) -> BoolArray:
    """Return which runs of a value were never seen, (n,)."""
    beside, jumps, above, amid = _beside_regions(samples, regions, JUMP * steepest, extremes)
    unseen = (jumps > UNSEEN * beside) & (jumps > 0)
    unseen |= (beside == 0) & unseen.any()
    if value == 0:  # no distance is 0 throughout, though on a surface it is at corners of steps
        unseen |= amid > 0
        unseen |= ((above == 0) | (above == beside)) & unseen.any()
    return unseen[regions.root]


def _beside_regions(
    samples: SampleArray, regions: Regions, limit: float, extremes: Extremes
) -> tuple[Ints, Ints, Ints, Ints]:
    """Count, by the first run of each region, the pairs of its samples with others, (n,) each.

    All but those of both extremes; those that differ by more than a limit; those with one above 0;
    and samples that have only others of the region round them.
    """
    counts = np.zeros((4, len(regions.root)), np.int64)

    def count(which: int, runs: Ints) -> None:
        counts[which] += np.bincount(regions.root[runs], minlength=counts.shape[1])

    def look(runs: Ints, values: NDArray[Any], other_runs: Ints, others: NDArray[Any]) -> None:
        at = (runs >= 0) & (other_runs < 0) & np.isfinite(others)
        pairs = np.stack([values[at], others[at]]).astype(np.float64)
        count(0, runs[at][~_are_any(pairs, extremes).all(0)])
        count(1, runs[at][_are_jumps(pairs, limit, extremes)])
        count(2, runs[at][pairs[1] > 0])

    before: list[tuple[Ints, NDArray[Any]]] = []
    for i, (plane, _) in enumerate(with_the_one_before(samples)):
        runs = regions.runs_of(i, regions.is_marked(plane))
        sides = [(runs[1:], plane[1:], runs[:-1], plane[:-1])]
        sides += [(runs[:, 1:], plane[:, 1:], runs[:, :-1], plane[:, :-1])]
        sides += [(runs, plane, *before[-1])] if before else []
        for one, values, other, others in sides:
            look(one, values, other, others)
            look(other, others, one, values)
        before = [*before[-2:], (runs, plane)]
        if len(before) == 3:
            count(3, _amid(*(runs for runs, _ in before)))
    return counts[0], counts[1], counts[2], counts[3]


def _amid(before: Ints, runs: Ints, after: Ints) -> Ints:
    """Return the runs of samples of a plane that are marked, as the 26 round them."""
    amid = (before >= 0) & (runs >= 0) & (after >= 0)
    amid = amid[2:] & amid[1:-1] & amid[:-2]
    return runs[1:-1, 1:-1][amid[:, 2:] & amid[:, 1:-1] & amid[:, :-2]]
