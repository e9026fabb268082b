"""Unknown samples far from the surface, NaN or infinite, as programs that fuse depth images leave.

An infinite sample is on the side of its sign. One that is NaN is on the side of the known samples
round the connected region of such samples that it lies in. All get the cut-off of their side: the
largest known distance there. Where a region has both sides beside it, the surface ends.

Many programs write 0, 1, -1000 or 1e10 instead. That is told by what no distance does: whole
regions of samples have exactly this value, and beside them the values jump; or they are 0.
"""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray
from ..errors import GridError
from .census import ENOUGH, Census, Extremes, Floats, Ints, Regions, as_float64, not_finite
from .samples import DerivedPlanes, SampleArray

LAYERS = 3  # of unknown samples to which the surface beside them is continued
WAY_OUT = "replace each by a distance of the right sign (the cut-off value of its side)"
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
A_SIDE = 0.75  # share of the changes of sign beside one value from which it is one side
LEAST_JUMPS = 6  # beside one value
ALIKE = 0.4  # share of equal pairs among those with a value that fills regions; of lines: a third


class Filled(NamedTuple):
    """Samples whose unknown ones are replaced by the cut-off of their side, when they are read.

    Where both sides are near, they are ``continued`` linearly over ``LAYERS`` unknown ones, which
    says nothing of the field; farther away they are outside, as in all of ``plain``. ``unseen`` is
    which of them are unknown and have both sides, or none, beside their region; None if none.
    """

    continued: SampleArray
    plain: SampleArray
    unseen: SampleArray | None
    why_open: str


def filled(census: Census, notes: list[str]) -> Filled:
    """Return samples of which the unknown ones are replaced, and say so in the notes."""
    samples, numbers, (low, high) = census.samples, census.numbers, finite_extremes(census)
    regions = Regions(samples, np.isnan)
    count = int(regions.size.sum())
    outer = int(regions.size[regions.positive & ~regions.unsure].sum())
    notes.append(
        f"{count + numbers.infinite:,} samples are unknown ({count:,} NaN, of which {outer:,} lie "
        f"on the positive side, and {numbers.infinite:,} infinite): they are taken as cut off at "
        f"{low:.6g} and {high:.6g}"
    )
    below, above, _ = numbers.border
    outside = low if below > above else high

    def known(planes: NDArray[Any], first: int, is_continued: bool = False) -> NDArray[Any]:
        planes = np.array(planes)
        for i, plane in enumerate(planes, first):
            unknown, infinite = np.isnan(plane), np.isinf(plane)
            runs = regions.runs_of(i, unknown)[unknown]
            of_side = np.where(regions.positive[runs], high, low)
            plane[unknown] = np.where(regions.unsure[runs], np.nan, of_side)
            plane[infinite] = np.where(plane[infinite] > 0, high, low)
        planes = _continued(planes, (low, high)) if is_continued else planes
        planes[np.isnan(planes)] = outside
        return planes

    def unseen(planes: NDArray[Any], first: int) -> BoolArray:
        marked: BoolArray = np.isnan(planes)
        for i, unknown in enumerate(marked, first):
            unknown[unknown] = regions.unsure[regions.runs_of(i, unknown)[unknown]]
        return marked

    plain = DerivedPlanes(samples, known, dtype=samples.dtype, numbered=True)
    if not regions.unsure.any():
        return Filled(plain, plain, None, "")
    count = int(regions.size[regions.unsure].sum())
    notes.append(
        f"{count:,} of the unknown samples are in regions that touch both sides of the surface: "
        "it is open there"
    )
    at = np.unravel_index(int(regions.start[regions.unsure][0]), census.shape)
    value = getattr(samples, "value", None)
    which = "" if value is None else f" (those that are exactly {value:g} are taken as such)"
    why = (
        f"{count:,} samples are unknown{which}, values[{', '.join(map(str, map(int, at)))}] the "
        "first, in regions that touch samples on both sides of the surface, so whether they are "
        "inside is unknown"
    )
    continued = partial(known, is_continued=True)
    return Filled(
        DerivedPlanes(samples, continued, 2 * LAYERS, samples.dtype, numbered=True),
        plain,
        DerivedPlanes(samples, unseen, dtype=bool, numbered=True),
        why,
    )


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


class Seen(DerivedPlanes):
    """Samples that are NaN in some regions of a value, when they are read."""

    def __init__(
        self, source: SampleArray, regions: Regions, unseen: BoolArray, value: float
    ) -> None:
        def hide(planes: NDArray[Any], first: int) -> Floats:
            planes = as_float64(planes)
            for i, plane in enumerate(planes, first):
                marked = regions.is_marked(plane)
                hidden = unseen[regions.runs_of(i, marked)[marked]]
                plane[marked] = np.where(hidden, np.nan, plane[marked])
            return planes

        super().__init__(source, hide, numbered=True)
        self.value = value


def finite_extremes(census: Census) -> Extremes:
    """Return the lowest and the highest finite sample; GridError as above."""
    low, high = census.extremes
    if low > high:
        raise not_finite(census.samples)
    if census.numbers.infinite:
        _check_infinite(census.samples)
    return low, high


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


def without_unseen(census: Census, notes: list[str]) -> Census:
    """Return what samples show that are NaN where they have a value that stands for unseen ones.

    Of samples that are not all known by their user, those with an extreme value may be beside any
    others: few views leave such edges. GridError if a value may stand for them, but not everywhere.
    """
    extremes = census.extremes if census.is_finite else finite_extremes(census)
    if not extremes[0] < 0 < extremes[1]:
        return census
    samples, all_known = census.samples, census.is_finite
    for value, steepest in _suspects(census.pairs, extremes):
        regions = Regions(samples, partial(np.equal, value))
        unseen = _unseen_runs(samples, regions, value, JUMP * steepest, extremes)
        if unseen.any():
            notes.append(
                f"{int(regions.size[unseen].sum()):,} samples are exactly {value:g}, where no "
                "distance is: they are taken as unknown (write NaN where nothing was seen)"
            )
            samples, all_known = Seen(samples, regions, unseen, value), False
        elif all_known and value in extremes:
            _check_jumps(census, value, int(regions.size.sum()), JUMP * steepest)
    return census if samples is census.samples else Census(samples)


def _suspects(pairs: Floats, extremes: Extremes) -> list[tuple[float, float]]:
    """Return values that may stand for unseen samples, and the steepest change of the others."""
    has_equal = np.count_nonzero(pairs[0] == pairs[1]) >= ENOUGH
    values, counts = np.unique(pairs[0] if has_equal else (), return_counts=True)
    often = values[counts >= ENOUGH][np.argsort(counts[counts >= ENOUGH])[-FREQUENT:]]
    changes = np.abs(pairs[1] - pairs[0])
    is_extreme = np.isin(pairs, extremes)
    changes[is_extreme.all(0)] = 0  # values that are cut off near the surface
    crossing = pairs[:, (pairs[0] > 0) != (pairs[1] > 0)]
    suspects = []
    for value in sorted({0.0, *extremes, *often.tolist()}):
        has, is_often = pairs == value, value not in (0, *extremes)
        alike, beside = int((has[0] & has[1]).sum()), changes[has[0] != has[1]]
        largest = np.sort(beside)[-LEAST_JUMPS] if len(beside) >= LEAST_JUMPS else 0.0
        is_plateau = value == 0 and alike >= ENOUGH
        # Beside thin flat parts the sign changes mostly beside one value.
        is_a_side = crossing.size and (crossing == value).any(0).mean() > A_SIDE
        if not (is_plateau or largest) or (value and is_a_side):
            continue
        if is_often and alike < ALIKE * (alike + len(beside)):
            continue
        steepest = _steepest(pairs, has, is_extreme)
        if value in extremes and _is_cut_near(pairs, value, steepest, extremes):
            continue
        if is_plateau or largest > JUMP * steepest:
            suspects.append((float(value), steepest))
    return suspects


def _is_cut_near(pairs: Floats, value: float, steepest: float, extremes: Extremes) -> bool:
    """Return whether the sign changes between the extremes, and others are near a value."""
    crossing = pairs[:, (pairs[0] > 0) != (pairs[1] > 0)]
    others = pairs[~np.isin(pairs, extremes)]
    near = np.abs(others - value).min(initial=np.inf) < JUMP * steepest
    has_crossing = near and crossing.size > 0  # few planes of a large grid are looked at
    return bool(has_crossing and np.isin(crossing, extremes).all(0).mean() > FILLED_IN)


def _steepest(pairs: Floats, has: BoolArray, is_extreme: BoolArray) -> float:
    """Return the steepest change of samples without a value, or all that they span, if few tell."""
    is_inner, change = ~(has | is_extreme), np.abs(pairs[1] - pairs[0])
    inner, changes = pairs[is_inner], change[~has.any(0)]
    span = np.ptp(inner) if len(inner) else 0.0  # larger changes are those to another such value
    changes = changes[(changes > 0) & (changes <= span)]
    if len(changes) < ENOUGH or len(np.unique(inner[:MANY])) < LEAST_VALUES:
        rest = pairs[~has]
        low, high = rest.min(initial=0), rest.max(initial=0)
        return FEW_SPANS * float(high - low) if low < 0 < high else np.inf
    # A field that levels off, or with far spacings along one axis, is steepest at the surface.
    across = change[is_inner.all(0) & ((pairs[0] > 0) != (pairs[1] > 0))]
    groups = [changes, across] if len(across) >= ENOUGH else [changes]
    return max(float(np.quantile(group, STEEPEST)) for group in groups)


def _check_jumps(census: Census, value: float, count: int, limit: float) -> None:
    pairs = census.pairs[:, (census.pairs[0] > 0) != (census.pairs[1] > 0)]
    jumps = _are_jumps(pairs, limit, census.extremes) & (pairs == value).any(0)
    if jumps.sum() >= LEAST_JUMPS and jumps.mean() > MIXED:
        raise GridError(
            f"{count:,} samples are exactly {value:g}, and beside some the values jump as no "
            "distance does: write NaN where nothing was seen"
        )


def _are_jumps(pairs: Floats, limit: float, extremes: Extremes) -> BoolArray:
    """Return which pairs (2, n) differ by more than a limit, but for those of both extremes.

    Values that are cut off near the surface, or filled in by hand, go from one to the other.
    """
    large: BoolArray = np.abs(pairs[1] - pairs[0]) > limit
    return large & ~np.isin(pairs, extremes).all(0)


def _unseen_runs(
    samples: SampleArray, regions: Regions, value: float, limit: float, extremes: Extremes
) -> BoolArray:
    """Return which runs of a value were never seen, (n,): beside those values jump by over a limit.

    Counted by region are the pairs of its samples with others, all but those of both extremes;
    those that jump; those with one above 0; and samples with only others of the region round them.
    """
    counts = np.zeros((4, len(regions.root)), np.int64)

    def count(which: int, runs: Ints) -> None:
        counts[which] += np.bincount(regions.root[runs], minlength=counts.shape[1])

    before: deque[tuple[Ints, NDArray[Any]]] = deque(maxlen=2)
    for i, plane in enumerate(samples):
        runs = regions.runs_of(i, regions.is_marked(plane))
        sides = [(runs[1:], plane[1:], runs[:-1], plane[:-1])]
        sides += [(runs[:, 1:], plane[:, 1:], runs[:, :-1], plane[:, :-1])]
        sides += [(runs, plane, *before[-1])] if before else []
        sides += [(other, others, one, values) for one, values, other, others in sides]
        for one, values, other, others in sides:
            at = (one >= 0) & (other < 0) & np.isfinite(others)
            pairs = np.stack([values[at], others[at]]).astype(np.float64)
            count(0, one[at][~np.isin(pairs, extremes).all(0)])
            count(1, one[at][_are_jumps(pairs, limit, extremes)])
            count(2, one[at][pairs[1] > 0])
        if len(before) == 2:
            amid = (before[0][0] >= 0) & (before[1][0] >= 0) & (runs >= 0)
            amid = amid[2:] & amid[1:-1] & amid[:-2]
            amid = amid[:, 2:] & amid[:, 1:-1] & amid[:, :-2]
            count(3, before[1][0][1:-1, 1:-1][amid])
        before.append((runs, plane))
    beside, jumps, above, among = counts
    unseen = (jumps > UNSEEN * beside) & (jumps > 0)
    unseen |= (beside == 0) & unseen.any()
    if value == 0:  # no distance is 0 throughout, though on a surface it is at corners of steps
        unseen |= among > 0
        unseen |= ((above == 0) | (above == beside)) & unseen.any()
    return np.asarray(unseen[regions.root])
