"""What the samples of a grid show, asked of as few planes as tell it, and only when it is needed.

All planes are read for the extremes and the border; for the rest evenly spread ones, with two
planes to either side. A large file is read once for all questions about spread planes.

Where a distance field is smooth its gradient has length 1 in world units, so its length in index
units is the spacing. Next to the surface of a thin part no sample is smooth, so samples away from
the surface count as well; but only those next to it tell how a field that is no distance changes
there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from math import isfinite
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, Triple
from ..errors import GridError
from .samples import SampleArray, SamplePlanes, in_blocks, is_cubic, let_go, spread_planes

Extremes: TypeAlias = tuple[float, float]
"""The smallest and the largest sample."""
Floats: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]
IsMarked: TypeAlias = Callable[[NDArray[Any]], BoolArray]

KEPT_BYTES = 1 << 25  # of a grid in a file that is read into memory to be asked
TOGETHER = 1 << 18  # samples whose numbers are looked at together
BESIDE = 2  # planes, rows and columns to either side, for fourth differences
LOOKED_PLANES, MOST_LOOKED_AT = 12, 1 << 13  # of samples beside the surface, spread evenly
GRADIENT_PLANES = 64  # unless too few samples are beside the surface there
MOST_GRADIENTS = 1 << 17  # wherever they lie; all of them up to 50^3
PAIR_PLANES, MOST_PAIRS = 32, 1 << 15
CUT_OFF = 0.01  # share of samples amid equal ones, at the lowest or highest value
MOST_BETWEEN = 0.4  # share of the samples at a boundary of labels that lie between two others
LEAST_JUMP = 0.3  # of the range of labels: so far some neighbours are apart

# Values are clamped to this, so that squares of their differences do not overflow.
LARGEST_VALUE = 1e150
ENOUGH = 30  # least number of samples for an estimate
STRAIGHT = 0.3  # largest bend (see ``Gradients``) of a field that is nearly linear
MOST_BENT = 0.6  # larger bends: lengths may agree by chance, as for the distance to a mask
# Gradients are consistent if nine in ten of the straightest ones agree within 5 %.
AGREEING, AGREEMENT = 0.9, 0.05
MOST_BESIDE = 1 << 12  # samples of a plane beside the surface of which gradients are taken
UNEQUAL = 1.3  # ratio of the spacings measured along two axes from which they differ


@dataclass(frozen=True, eq=False)
class Looked:
    """Samples (n, 5, 5, 5) round some beside the surface.

    ``cut`` (2,) are the shares that are, as their six neighbours, the lowest or the highest.
    """

    around: Floats
    cut: Floats
    extremes: Extremes

    @cached_property
    def lines(self) -> Floats:
        """Five samples in a row along each axis, (n, 3, 5)."""
        a = self.around
        return np.stack([a[:, :, BESIDE, BESIDE], a[:, BESIDE, :, BESIDE], a[:, BESIDE, BESIDE]], 1)

    @property
    def is_cut(self) -> BoolArray:
        """Whether values are cut off at the lowest, and at the highest, (2,).

        In a narrow grid only one of the two may be seen: if the other extreme is as large, values
        were cut off there, too.
        """
        cut: BoolArray = self.cut > CUT_OFF
        return cut | (cut.any() and bool(np.isclose(-self.extremes[0], self.extremes[1], atol=0)))

    def divided(self, slope: float) -> Looked:
        """Return what would have been seen of the values divided by a slope."""
        low, high = self.extremes
        return Looked(self.around / slope, self.cut, (low / slope, high / slope))


class Numbers(NamedTuple):
    """What the numbers of some planes are; the extremes are of those that are finite."""

    low: float
    high: float
    is_finite: bool
    infinite: int
    has_two: bool  # only the extremes
    border: Ints  # on the grid's faces: how many are negative, positive, the lowest


class Census:
    """What the samples of a grid, (nx, ny, nz), show."""

    def __init__(self, samples: SampleArray) -> None:
        self.samples, self.shape = samples, tuple(map(int, samples.shape))
        self._found: dict[str, list[Any]] = {}
        is_file = isinstance(samples, SamplePlanes | np.memmap)
        size = np.prod(self.shape, dtype=float) * samples.dtype.itemsize
        self._is_large = is_file and size > KEPT_BYTES
        self._kept = np.asarray(samples[:]) if is_file and not self._is_large else samples

    def _planes(self) -> dict[str, tuple[Iterable[int], Callable[..., Any]]]:
        """Return for each question the planes that are asked, and what is asked.

        Inner planes alone are asked what needs others beside them; none of a narrow grid.
        """
        count, size = self.shape[0], self.shape[1] * self.shape[2]
        far, near = (
            spread_planes(n, count - 1 - n, LOOKED_PLANES) if min(self.shape) > 2 * n else []
            for n in (BESIDE, 1)
        )
        spread = spread_planes(0, count - 1, GRADIENT_PLANES)
        inner = ([i for i in spread if 0 < i < count - 1] or [1]) if min(self.shape) > 2 else []
        each = -(-len(inner) * size // MOST_GRADIENTS)
        first = spread_planes(0, count - 2, PAIR_PLANES)
        rows = slice(0, self.shape[1] - 1, -(-len(first) * size // MOST_PAIRS))
        return {
            "around": (far, _around_surface),
            "plateaus": (far, _amid_equal),
            "beside": (spread, _beside_surface),
            "everywhere": (inner, lambda slab, at: gradients_where_straight(slab, at, each)),
            "labels": (near, _at_boundaries),
            "pairs": (first, lambda slab, at: _pairs_of(slab, at, rows)),
        }

    def _ask(self, name: str) -> list[Any]:
        """Return what is found in the planes that are asked; of a large file all at once."""
        if name not in self._found:
            asked = self._planes()
            asked = asked if self._is_large else {name: asked[name]}
            self._found |= {each: [] for each in asked}
            for i in sorted(set().union(*(planes for planes, _ in asked.values()))):
                low = max(i - BESIDE, 0)
                slab = np.asarray(self._kept[low : i + BESIDE + 1])
                for each, (planes, work) in asked.items():
                    if i in planes:
                        self._found[each].append(work(slab, i - low))
                let_go(self.samples)
        return self._found[name]

    @cached_property
    def numbers(self) -> Numbers:
        """What the numbers of the grid are; the extremes are infinite if none is finite."""
        parts = []
        for block in in_blocks(self._kept, max(TOGETHER // (self.shape[1] * self.shape[2]), 1)):
            planes = np.asarray(self._kept[block])
            parts.append(_numbers_of(planes, block.start == 0, block.stop == self.shape[0]))
            let_go(self.samples)
        low, high = min(part.low for part in parts), max(part.high for part in parts)
        ends = low, high
        return Numbers(
            low,
            high,
            all(part.is_finite for part in parts),
            sum(part.infinite for part in parts),
            all(part.has_two and part.low in ends and part.high in ends for part in parts),
            np.sum([part.border * [1, 1, part.low == low] for part in parts], 0),
        )

    @property
    def is_finite(self) -> bool:
        """Whether all samples are finite."""
        return self.numbers.is_finite

    @property
    def extremes(self) -> Extremes:
        """The smallest and the largest finite sample."""
        return self.numbers.low, self.numbers.high

    def border_shares(self) -> tuple[float, float, float]:
        """Return the shares of the faces below 0, above 0, and at the lowest; edges count twice."""
        nx, ny, nz = self.shape
        below, above, at_lowest = self.numbers.border.tolist()
        size = 2 * (nx * ny + ny * nz + nz * nx)
        return below / size, above / size, at_lowest / size

    @property
    def is_one_sided(self) -> bool:
        """Whether no value is below 0, or none above."""
        return self.numbers.low >= 0 or self.numbers.high <= 0

    @cached_property
    def has_two_values(self) -> bool:
        """Whether there are only two different values.

        They are none if they differ along an axis of two samples only: a plane is between them.
        """
        if not self.numbers.has_two or self.samples.dtype.kind in "iu" or 2 not in self.shape:
            return self.numbers.has_two
        lines = [np.moveaxis(np.asarray(self._kept[:]), axis, 0) for axis in range(3)]
        return not any(len(x) == 2 and bool((x == x[:, :1, :1]).all()) for x in lines)

    @cached_property
    def looked(self) -> Looked:
        """What the samples beside the surface are."""
        around = np.concatenate([np.empty((0, 5, 5, 5)), *self._ask("around")])
        cut, total = np.zeros(2, np.int64), 0
        for ends, counts, size in self._ask("plateaus"):
            cut += np.where(np.equal(ends, self.extremes), counts, 0)
            total += size
        return Looked(_some(around, MOST_LOOKED_AT), cut / max(total, 1), self.extremes)

    @cached_property
    def beside(self) -> Gradients:
        """Gradients at samples beside the surface, in 64 planes, in all if these have too few."""
        gradients = _gradients_of(self._ask("beside"))
        count = self.shape[0]
        if count <= GRADIENT_PLANES or (gradients.bend < STRAIGHT).sum() >= ENOUGH:
            return gradients
        slabs = ((np.asarray(self._kept[max(i - 1, 0) : i + 2]), min(i, 1)) for i in range(count))
        return _gradients_of([_beside_surface(*slab) for slab in slabs])

    @cached_property
    def everywhere(self) -> Gradients:
        """Gradients at samples anywhere in the grid at which the field is not bent."""
        parts = [(np.empty((0, 3)), np.empty(0)), *self._ask("everywhere")]
        return Gradients(*(np.concatenate(arrays) for arrays in zip(*parts)))

    @cached_property
    def pairs(self) -> Floats:
        """Finite samples beside each other along an axis, (2, n), in some rows and planes."""
        pairs = np.concatenate(self._ask("pairs"), axis=1)
        return pairs if self.is_finite else pairs[:, np.isfinite(pairs).all(0)]

    @cached_property
    def are_labels(self) -> bool:
        """Whether values look like labels: whole numbers of which regions jump to others.

        At a boundary, samples hardly ever lie between a lower and a higher neighbour.
        """
        planes = self._ask("labels")
        if not planes or None in planes:
            return False
        lows, highs, counts, jumps = zip(*planes)
        low, high = min(lows), max(highs)
        between, among = sum(
            each[0] - each[1] * (a == low) - each[2] * (b == high)
            for each, a, b in zip(counts, lows, highs)
        )
        if LEAST_JUMP * (high - low) > max(jumps) or among < ENOUGH:
            return False
        return bool(between <= MOST_BETWEEN * among)


def not_finite(values: SampleArray) -> GridError:
    """Return the error for samples of which some are NaN or infinite, which names the first."""
    bad = (np.argwhere(~np.isfinite(as_float64(plane))) for plane in values)
    i, (j, k) = next((i, places[0]) for i, places in enumerate(bad) if len(places))
    return GridError(
        f"values[{i}, {j}, {k}] is {values[i][j, k]!s}: every sample must be finite; "
        "replace unknown far samples by a large distance of the right sign"
    )


def _numbers_of(planes: NDArray[Any], is_first: bool, is_last: bool) -> Numbers:
    number = int if planes.dtype.kind in "iu" else float  # floats do not tell large ones apart
    low, high, infinite = number(planes.min()), number(planes.max()), 0
    if not (is_finite := isfinite(low) and isfinite(high)):
        finite = planes[np.isfinite(planes)]
        low, high = float(finite.min(initial=np.inf)), float(finite.max(initial=-np.inf))
        infinite = int(np.isinf(planes).sum())
    faces = [planes[:, [0, -1]], planes[:, :, [0, -1]]]
    faces += [planes[:1]] * is_first + [planes[-1:]] * is_last
    border = [[(face < 0).sum(), (face > 0).sum(), (face == low).sum()] for face in faces]
    rows = planes[0, 0], planes[len(planes) // 2, planes.shape[1] // 2]  # they mostly show it
    has_two = all(bool(((part == low) | (part == high)).all()) for part in (*rows, planes))
    return Numbers(low, high, is_finite, infinite, has_two, np.sum(border, 0))


def _some(rows: NDArray[Any], most: int) -> NDArray[Any]:
    """Return all rows, or ``most`` of them, spread evenly."""
    return rows[np.linspace(0, len(rows) - 1, most).astype(int)] if len(rows) > most else rows


def _around_surface(slab: NDArray[Any], at: int) -> Floats:
    """Return samples (n, 5, 5, 5) of the middle of five planes beside the surface."""
    near = slab[1:4]
    sides = (near > 0).astype(np.int8) - (near < 0)
    beside = (sides[0] != sides[1]) | (sides[2] != sides[1])
    _mark_crossings(sides[1], beside)
    inner = beside[BESIDE:-BESIDE, BESIDE:-BESIDE]
    found = np.flatnonzero(inner)
    j, k = np.unravel_index(_some(found, MOST_LOOKED_AT), inner.shape)
    boxes = np.lib.stride_tricks.sliding_window_view(slab, (2 * BESIDE + 1,) * 3)[0]
    return as_clamped(boxes[j, k])


def _with_neighbours(slab: NDArray[Any], at: int) -> tuple[NDArray[Any], list[NDArray[Any]]]:
    """Return the inner samples of the plane ``at``, and their six neighbours."""
    plane, inner = slab[at], slice(1, -1)
    sides = [slab[at - 1, inner, inner], slab[at + 1, inner, inner], plane[:-2, inner]]
    sides += [plane[2:, inner], plane[inner, :-2], plane[inner, 2:]]
    return plane[inner, inner], sides


def _amid_equal(slab: NDArray[Any], at: int) -> tuple[tuple[Any, Any], list[int], int]:
    """Return the extremes of the plane ``at``, how many samples are amid these, and of all."""
    ends, (centre, sides) = (slab[at].min(), slab[at].max()), _with_neighbours(slab, at)
    amid = [np.logical_and.reduce([x == end for x in (centre, *sides)])[1:-1, 1:-1] for end in ends]
    return ends, [int(x.sum()) for x in amid], amid[0].size


def _at_boundaries(slab: NDArray[Any], at: int) -> tuple[Any, Any, Ints, float] | None:
    """Return the extremes of the plane ``at``, counts, and the largest difference.

    The counts, (3, 2), are of samples between a lower and a higher neighbour, and of those with
    another neighbour: all inner ones, the lowest, and the highest. None if some are not whole.
    """
    if slab.dtype.kind == "f" and not (slab[at] == np.rint(slab[at])).all():
        return None
    centre, sides = _with_neighbours(slab, at)
    lower = np.logical_or.reduce([side < centre for side in sides])
    higher = np.logical_or.reduce([side > centre for side in sides])
    jump = max(float(np.abs(np.subtract(x, centre, dtype=np.float64)).max()) for x in sides)
    low, high = slab[at].min().item(), slab[at].max().item()
    groups = np.ones(centre.shape, bool), centre == low, centre == high
    counts = [[(g & lower & higher).sum(), (g & (lower | higher)).sum()] for g in groups]
    return low, high, np.array(counts), jump


def _pairs_of(slab: NDArray[Any], at: int, rows: slice) -> Floats:
    row = slab[at, rows]
    beside = slab[at + 1, rows], slab[at, 1:][rows]
    parts = [np.stack([row, other]).reshape(2, -1) for other in beside]
    parts.append(np.stack([row[:, :-1], row[:, 1:]]).reshape(2, -1))
    return as_float64(np.concatenate(parts, axis=1))


@dataclass(frozen=True, eq=False)
class Gradients:
    """Gradients (n, 3) of a field at some samples, in index units, and how bent it is there.

    ``bend`` (n,) is the sum of the absolute second differences over their length: 0 for a linear
    field, infinite where opposite neighbours are equal.
    """

    vectors: Floats
    bend: Floats

    def __getitem__(self, which: Any) -> Gradients:
        return Gradients(self.vectors[which], self.bend[which])

    @cached_property
    def lengths(self) -> Floats:
        """Their lengths, (n,)."""
        length: Floats = np.sqrt((self.vectors**2).sum(1))
        return length

    @cached_property
    def straighter(self) -> BoolArray:
        """Which are in the less bent half of the field, (n,); of enough, below ``STRAIGHT``."""
        limit = float(np.median(self.bend))
        if (self.bend < STRAIGHT).sum() >= ENOUGH:
            limit = min(limit, STRAIGHT)
        return self.bend <= limit

    @cached_property
    def typical_length(self) -> float:
        """The half-sample mode of the lengths at the straighter samples; GridError if none.

        Reference: Bickel and Frühwirth, "On a fast, robust estimator of the mode", 2006.
        """
        if not len(self.bend):
            raise GridError(
                "the values show no spacing, since they are smooth nowhere: give --spacing"
            )
        length: Floats = np.sort(self[self.straighter].lengths)
        while len(length) > 2:
            half = (len(length) + 1) // 2
            width = length[half - 1 :] - length[: len(length) - half + 1]
            start = int(width.argmin())
            length = length[start : start + half]
        return float(length.mean())

    def agree_with(self, measured: float) -> bool:
        """Return whether the lengths at the straighter samples are the measured spacing."""
        if len(self.bend) < ENOUGH:
            return False
        length = self[self.straighter & (self.bend <= MOST_BENT)].lengths
        agreeing = np.abs(length - measured) <= AGREEMENT * measured
        return len(length) >= ENOUGH and bool(agreeing.mean() >= AGREEING)

    def in_finest(self, spacing: Triple) -> Gradients:
        """Return them in index units of the finest axis, if the spacings differ."""
        if is_cubic(spacing):
            return self
        return Gradients(self.vectors * (min(spacing) / np.array(spacing)), self.bend)

    @cached_property
    def of_axes(self) -> dict[str, float]:
        """The spacing that the gradients along each axis show; empty unless they differ."""
        shown: dict[str, float] = {}
        for axis, name in enumerate("xyz"):
            along = (np.abs(self.vectors[:, axis]) > 0.95 * self.lengths) & (self.bend < STRAIGHT)
            if along.sum() >= ENOUGH:
                shown[name] = self[along].typical_length
        differ = shown and max(shown.values()) > UNEQUAL * min(shown.values())
        return shown if differ else {}

    @cached_property
    def spacing(self) -> Floats | None:
        """The spacings (3,) with which most gradients have length 1; None if none have.

        (g_x / h_x)^2 + (g_y / h_y)^2 + (g_z / h_z)^2 = 1 is linear in 1 / h^2. It is solved for the
        straight gradients, in the mean, then again for those that agree better and better.
        """
        squares = self.vectors[self.bend <= MOST_BENT] ** 2
        agreeing = np.ones(len(squares), bool)
        for tolerance in (0.5, 0.3, 0.2, 0.1, AGREEMENT, AGREEMENT):
            if agreeing.sum() < ENOUGH:
                return None
            inverse, _, rank, _ = np.linalg.lstsq(squares[agreeing], np.ones(agreeing.sum()), 1e-6)
            if rank < 3 or inverse.min() <= 0:
                return None
            agreeing = np.abs(np.sqrt(squares @ inverse) - 1) <= tolerance
        spacings: Floats = 1 / np.sqrt(inverse)
        return spacings if agreeing.mean() >= AGREEING else None


def _beside_surface(slab: NDArray[Any], at: int) -> tuple[NDArray[Any], ...]:
    """Return samples (n,) beside the surface in the plane ``at`` of some, and their neighbours.

    Those below and above, (2, 3, n), along each axis, and how many steps these are apart, (3, n).
    """
    inside = slab[max(at - 1, 0) : at + 2] <= 0
    own = inside[min(at, 1)]
    marks = (inside != own).any(0)
    _mark_crossings(own, marks)
    j, k = np.unravel_index(_some(np.flatnonzero(marks), MOST_BESIDE), own.shape)
    (nx, ny, nz), i = slab.shape, np.full(len(j), at)
    low = [np.maximum(x - 1, 0) for x in (i, j, k)]
    high = [np.minimum(x + 1, n - 1) for x, n in zip((i, j, k), (nx, ny, nz))]
    sides = [[slab[x, j, k], slab[i, y, k], slab[i, j, z]] for x, y, z in (low, high)]
    return slab[at, j, k], np.array(sides), np.subtract(high, low)


def _gradients_of(parts: list[tuple[NDArray[Any], ...]]) -> Gradients:
    centre, sides, steps = (np.concatenate(x, axis=-1) for x in zip(*parts))
    centre, (below, above) = as_clamped(centre), as_clamped(sides)
    change = np.where(steps == 2, np.abs(above - 2 * centre + below), 0).sum(0)
    gradient = np.ascontiguousarray(((above - below) / steps).T)
    return Gradients(gradient, _relative_bend(change, gradient))


def gradients_where_straight(slab: NDArray[Any], at: int, step: int) -> tuple[Floats, Floats]:
    """Return gradients (n, 3) and bends (n,) in every ``step``-th row where the field is not bent.

    Where the values are constant, as those of a truncated field are, there is no gradient.
    """
    inner, plane = (slice(1, -1, step), slice(1, -1)), slab[at]
    above = slab[at + 1][inner], plane[2::step, 1:-1], plane[1:-1:step, 2:]
    below = slab[at - 1][inner], plane[:-2:step, 1:-1], plane[1:-1:step, :-2]
    centre, *sides = (as_clamped(samples) for samples in (plane[inner], *above, *below))
    pairs = list(zip(sides[:3], sides[3:]))
    gradient = np.stack([(high - low) / 2 for high, low in pairs], -1).reshape(-1, 3)
    change = sum(np.abs(high - 2 * centre + low) for high, low in pairs)
    bend = _relative_bend(np.ravel(change), gradient)
    straight = bend <= MOST_BENT
    return gradient[straight], bend[straight]


def _relative_bend(change: Floats, gradient: Floats) -> Floats:
    length = np.sqrt((gradient**2).sum(1))
    bend = np.full(len(length), np.inf)
    np.divide(change, length, out=bend, where=length > 1e-9 * change)
    return bend


def _mark_crossings(sides: NDArray[Any], marks: BoolArray) -> None:
    """Mark the samples of a plane whose side is not that of a neighbour in the plane."""
    for samples, marked in ((sides, marks), (sides.T, marks.T)):
        crossed = samples[1:] != samples[:-1]
        marked[1:] |= crossed
        marked[:-1] |= crossed


def as_clamped(samples: NDArray[Any]) -> Floats:
    """Return samples as float64, clamped to ``LARGEST_VALUE``."""
    return np.clip(as_float64(samples), -LARGEST_VALUE, LARGEST_VALUE)


def as_float64(samples: NDArray[Any]) -> Floats:
    """Return samples as float64; NumPy warns of signalling NaN and of large long doubles."""
    with np.errstate(over="ignore", invalid="ignore"):
        return samples.astype(np.float64)


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
