"""One pass over the planes of a grid: all that is asked of its samples before they are meshed.

Each question is about some ranges of planes, so that its parts are answered wherever these are
read. An array in memory is asked when an answer is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, partial
from math import isfinite
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray
from ..errors import GridError
from .planes import (Few, Ranges, SampleArray, SamplePlanes, lowest, over_planes, ranks_of, spread_planes)
from .regions import Regions, runs_of_plane
from .slopes import (ENOUGH, MOST_BESIDE, STRAIGHT, Floats, Gradients, as_clamped, as_float64, gradients_beside_surface, gradients_where_straight, mark_crossings)

Extremes: TypeAlias = tuple[float, float]
"""The smallest and the largest sample."""
Shape: TypeAlias = tuple[int, ...]

KEPT_BYTES = 1 << 25  # of a grid in a file that is read into memory to be asked
TOGETHER = 1 << 18  # samples whose numbers are looked at together
READ_SAMPLES = 1 << 21  # about, that are read at a time
BESIDE = 2  # planes, rows and columns to either side, for fourth differences
LOOKED_PLANES, MOST_LOOKED_AT = 12, 1 << 13  # of samples beside the surface, spread evenly
GRADIENT_PLANES = 64  # unless too few samples are beside the surface there
MOST_GRADIENTS = 1 << 19  # wherever they lie; all of them up to 80^3
PAIR_PLANES, MOST_PAIRS = 32, 1 << 15
CUT_OFF = 0.01  # share of samples amid equal ones, at the lowest or highest value
MOST_BETWEEN = 0.4  # share of the samples at a boundary of labels that lie between two others
LEAST_JUMP = 0.3  # of the range of labels: so far some neighbours are apart


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

        In a narrow grid the one is seen only; if the other is as large, it is where they were, too.
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
    border: NDArray[np.int64]  # on the grid's faces: how many are negative, positive, the lowest


class Census:
    """What the samples of a grid, (nx, ny, nz), show; planes in files are read once, in order."""

    def __init__(self, samples: SampleArray) -> None:
        self.samples, self.shape = samples, tuple(samples.shape)
        self._given: dict[str, list[Any]] = {}
        is_file = isinstance(samples, SamplePlanes | np.memmap)
        self._kept = _small(samples) if is_file else samples
        if self._kept is None:
            questions = _questions(self.shape)
            if samples.dtype == np.bool_:
                questions = {name: questions[name] for name in ("numbers", "unknown")}
            self._given = dict(zip(questions, _ask_together(samples, list(questions.values()))))

    def _answers(self, name: str) -> Any:
        if name not in self._given:
            self._given[name] = self._ask(_questions(self.shape)[name])
        return self._given[name]

    def _ask(self, question: Question) -> list[Any]:
        ranges, work, answers = question
        samples = self.samples if self._kept is None else self._kept
        for answer in over_planes(samples, work, ranges):
            answers.append(answer)
        return answers

    @cached_property
    def numbers(self) -> Numbers:
        """What the numbers of the grid are; the extremes are infinite if none is finite."""
        parts: list[Numbers] = self._answers("numbers")
        low, high = min(part.low for part in parts), max(part.high for part in parts)
        ends = low, high
        border = sum(part.border * [1, 1, part.low == low] for part in parts)
        return Numbers(
            low,
            high,
            all(part.is_finite for part in parts),
            sum(part.infinite for part in parts),
            all(part.has_two and part.low in ends and part.high in ends for part in parts),
            np.asarray(border),
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
        nx, ny, nz = map(int, self.shape)
        below, above, at_lowest = self.numbers.border.tolist()
        size = 2 * (nx * ny + ny * nz + nz * nx)
        return below / size, above / size, at_lowest / size

    @property
    def is_one_sided(self) -> bool:
        """Whether no value is below 0, or none above."""
        return self.numbers.low >= 0 or self.numbers.high <= 0

    @property
    def has_two_values(self) -> bool:
        """Whether there are only two different values, and not as beside a plane."""
        is_whole = self.samples.dtype.kind in "iu"
        return self.numbers.has_two and (is_whole or not _are_layers(self.samples))

    @cached_property
    def unknown(self) -> Regions:
        """The regions of NaN."""
        return Regions(self.shape, self._answers("unknown"))

    @cached_property
    def looked(self) -> Looked:
        """What the samples beside the surface are."""
        patches = self._answers("patches")
        around = patches.joined()[1] if patches else np.empty((0, 5, 5, 5))
        cut, total = np.zeros(2, np.int64), 0
        for ends, counts, size in self._answers("plateaus"):
            cut += np.where(np.equal(ends, self.extremes), counts, 0)
            total += size
        return Looked(around, cut / max(total, 1), self.extremes)

    @cached_property
    def beside(self) -> Gradients:
        """Gradients at samples beside the surface, in 64 planes, in all if these have too few."""
        gradients = Gradients(*self._answers("beside").joined()[1:])
        count = self.shape[0]
        if count <= GRADIENT_PLANES or (gradients.bend < STRAIGHT).sum() >= ENOUGH:
            return gradients
        few: Any = self._ask(_beside(self.shape, range(count)))
        return Gradients(*few.joined()[1:])

    @cached_property
    def everywhere(self) -> Gradients:
        """Gradients at samples anywhere in the grid at which the field is not bent."""
        parts = [(np.empty((0, 3)), np.empty(0)), *self._answers("everywhere")]
        return Gradients(*(np.concatenate(arrays) for arrays in zip(*parts)))

    @cached_property
    def pairs(self) -> Floats:
        """Finite samples beside each other along an axis, (2, n), in some rows and planes."""
        pairs = np.concatenate(self._answers("pairs"), axis=1)
        return pairs if self.is_finite else pairs[:, np.isfinite(pairs).all(0)]

    @cached_property
    def are_labels(self) -> bool:
        """Whether values look like labels: whole numbers of which regions jump to others.

        At a boundary, samples hardly ever lie between a lower and a higher neighbour.
        """
        planes = self._answers("labels")
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


def _small(samples: SampleArray) -> NDArray[Any] | None:
    """Return the samples of a small grid that is read here, None of others."""
    size = np.prod(samples.shape, dtype=float) * samples.dtype.itemsize
    return np.asarray(samples[0 : len(samples)]) if size <= KEPT_BYTES else None


def _are_layers(values: SampleArray) -> bool:
    """Return whether values differ along an axis of two samples only: a plane is between them."""
    if 2 not in values.shape:
        return False
    planes = np.asarray(values[0 : len(values)])
    lines = [np.moveaxis(planes, axis, 0) for axis in range(3)]
    return any(len(line) == 2 and bool((line == line[:, :1, :1]).all()) for line in lines)


class Question(NamedTuple):
    """What is asked of some ranges of planes, and the list of its answers."""

    ranges: Ranges
    work: Callable[..., Any]
    answers: list[Any]


def _questions(shape: Shape) -> dict[str, Question]:
    """Return by name the work of the census: which planes each part needs, and who answers."""
    count, size, step = shape[0], shape[1] * shape[2], _planes_together(shape)
    numbers = [(i, min(i + step, count), i == 0, i + step >= count) for i in range(0, count, step)]
    far, near = (  # planes with others beside them; none of a narrow grid
        spread_planes(n, count - 1 - n, LOOKED_PLANES) if min(shape) > 2 * n else []
        for n in (BESIDE, 1)
    )
    spread = spread_planes(0, count - 1, GRADIENT_PLANES)
    inner = ([i for i in spread if 0 < i < count - 1] or [1]) if min(shape) > 2 else []
    each = -(-len(inner) * size // MOST_GRADIENTS)
    first = spread_planes(0, count - 2, PAIR_PLANES)
    rows = slice(0, shape[1] - 1, -(-len(first) * size // MOST_PAIRS))
    before = [(max(i - 1, 0), i + 1) for i in range(count)]
    around = [(i - BESIDE, i + BESIDE + 1, i * size) for i in far]
    return {
        "numbers": Question(numbers, _numbers_of, []),
        "unknown": Question(before, partial(runs_of_plane, np.isnan), []),
        "patches": Question(around, _around_surface, Few(MOST_LOOKED_AT)),
        "plateaus": Question([(i - 1, i + 2) for i in far], _amid_equal, []),
        "beside": _beside(shape, spread),
        "everywhere": Question([(i - 1, i + 2, each) for i in inner], gradients_where_straight, []),
        "labels": Question([(i - 1, i + 2) for i in near], _at_boundaries, []),
        "pairs": Question([(i, i + 2) for i in first], partial(_pairs_of, rows), []),
    }


def _beside(shape: Shape, planes: Iterable[int]) -> Question:
    count, size = shape[0], shape[1] * shape[2]
    ranges = [(max(i - 1, 0), min(i + 2, count), min(i, 1), i * size) for i in planes]
    return Question(ranges, gradients_beside_surface, Few(MOST_BESIDE))


def _planes_together(shape: Shape) -> int:
    return max(TOGETHER // (shape[1] * shape[2]), 1)


def _ask_together(samples: SampleArray, questions: list[Question]) -> list[list[Any]]:
    """Return the answers to questions of samples, each plane of which is read once."""
    count, each = samples.shape[0], _planes_together(tuple(samples.shape))
    least = READ_SAMPLES // (samples.shape[1] * samples.shape[2])
    step = each * -(-max(least, 2 * max(getattr(samples, "beside", 1), 1)) // each)
    ranges = []
    for first in range(0, count, step):
        low = max(first - BESIDE, 0)
        mine = [
            [
                (a - low, b - low, *more)
                for a, b, *more in question.ranges
                if first <= (a + b - 1) // 2 < first + step
            ]
            for question in questions
        ]
        ranges.append((low, min(first + step + BESIDE, count), mine))
    work = partial(_answer_all, [question.work for question in questions])
    for parts in over_planes(samples, work, ranges):
        for question, answers in zip(questions, parts):
            for answer in answers:
                question.answers.append(answer)
    return [question.answers for question in questions]


def _answer_all(
    works: list[Callable[..., Any]], slab: NDArray[Any], ranges: list[Ranges]
) -> list[list[Any]]:
    return [[work(slab[a:b], *more) for a, b, *more in mine] for work, mine in zip(works, ranges)]


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


def _around_surface(slab: NDArray[Any], number: int) -> tuple[NDArray[Any], ...]:
    """Return samples (n, 5, 5, 5) of the middle of five planes beside the surface, and ranks (n,).

    ``number`` is that of the first sample of the middle plane.
    """
    slab = np.asarray(slab)
    near = slab[1:4]
    sides = (near > 0).astype(np.int8) - (near < 0)
    beside = (sides[0] != sides[1]) | (sides[2] != sides[1])
    mark_crossings(sides[1], beside)
    inner = beside[BESIDE:-BESIDE, BESIDE:-BESIDE]
    at = np.flatnonzero(inner)
    ranks = ranks_of(at + number)
    some = lowest(ranks, MOST_LOOKED_AT)
    j, k = np.unravel_index(at[some], inner.shape)
    boxes = np.lib.stride_tricks.sliding_window_view(slab, (2 * BESIDE + 1,) * 3)[0]
    return ranks[some], as_clamped(boxes[j, k])


def _amid_equal(slab: NDArray[Any]) -> tuple[tuple[Any, Any], list[int], int]:
    """Return the extremes of the middle plane of three, how many are amid these, and of all."""
    middle = slab[1]
    ends, counts = (middle.min(), middle.max()), []
    for end in ends:
        amid = (middle == end) & (slab[0] == end) & (slab[2] == end)
        amid[1:-1] &= middle[2:] == end
        amid[1:-1] &= middle[:-2] == end
        amid[:, 1:-1] &= middle[:, 2:] == end
        amid[:, 1:-1] &= middle[:, :-2] == end
        counts.append(int(amid[BESIDE:-BESIDE, BESIDE:-BESIDE].sum()))
    return ends, counts, amid[BESIDE:-BESIDE, BESIDE:-BESIDE].size


def _at_boundaries(slab: NDArray[Any]) -> tuple[Any, Any, NDArray[np.int64], float] | None:
    """Return the extremes of the middle plane of three, counts, and the largest difference.

    The counts, (3, 2), are of samples between a lower and a higher neighbour, and of those with
    another neighbour: all inner ones, the lowest, and the highest. None if some are not whole.
    """
    middle = slab[1]
    if middle.dtype.kind == "f" and not (middle == np.rint(middle)).all():
        return None
    centre = middle[1:-1, 1:-1]
    sides = [slab[0, 1:-1, 1:-1], slab[2, 1:-1, 1:-1], middle[:-2, 1:-1], middle[2:, 1:-1]]
    sides += [middle[1:-1, :-2], middle[1:-1, 2:]]
    lower = np.logical_or.reduce([side < centre for side in sides])
    higher = np.logical_or.reduce([side > centre for side in sides])
    jump = max(float(np.abs(np.subtract(x, centre, dtype=np.float64)).max()) for x in sides)
    low, high = middle.min().item(), middle.max().item()
    groups = np.ones(centre.shape, bool), centre == low, centre == high
    counts = [
        [(group & lower & higher).sum(), (group & (lower | higher)).sum()] for group in groups
    ]
    return low, high, np.array(counts), jump


def _pairs_of(rows: slice, slab: NDArray[Any]) -> Floats:
    row = slab[0, rows]
    beside = slab[1, rows], slab[0, 1:][rows]
    parts = [np.stack([row, other]).reshape(2, -1) for other in beside]
    parts.append(np.stack([row[:, :-1], row[:, 1:]]).reshape(2, -1))
    return as_float64(np.concatenate(parts, axis=1))
