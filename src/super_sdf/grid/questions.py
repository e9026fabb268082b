"""What is asked of the planes of a grid, in parts that can be answered wherever they are read.

numbers     the extremes, what is not finite, the border, whether there are two values only
unknown     the runs of NaN
patches     5 x 5 x 5 samples round some beside the surface
plateaus    samples amid others of the same extreme value
beside      gradients beside the surface
everywhere  gradients where the field is not bent
labels      whole numbers, and how they change
pairs       some neighbours
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from math import isfinite
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .planes import (
    Few,
    Ranges,
    SampleArray,
    lowest,
    over_planes,
    ranks_of,
    spread_planes,
)
from .regions import runs_of_plane
from .slopes import (
    LARGEST_VALUE,
    MOST_BESIDE,
    gradients_beside_surface,
    gradients_where_straight,
    mark_crossings,
)

Floats: TypeAlias = NDArray[np.float64]
Shape: TypeAlias = tuple[int, ...]

TOGETHER = 1 << 18  # samples whose numbers are looked at together
READ_SAMPLES = 1 << 21  # about, that are read at a time
BESIDE = 2  # planes, rows and columns to either side, for fourth differences
LOOKED_PLANES, MOST_LOOKED_AT = 12, 1 << 13  # of samples beside the surface, spread evenly
GRADIENT_PLANES = 64  # unless too few samples are beside the surface there
MOST_GRADIENTS = 1 << 19  # wherever they lie; all of them up to 80^3
LABEL_PLANES = 12
PAIR_PLANES, MOST_PAIRS = 32, 1 << 15


class Question(NamedTuple):
    """What is asked of some ranges of planes, and the list of its answers."""

    ranges: Ranges
    work: Callable[..., Any]
    answers: list[Any]


class Numbers(NamedTuple):
    """What the numbers of some planes are.

    Attributes
    ----------
    low, high : number
        The extremes of those that are finite.
    is_finite : bool
        Whether all are.
    infinite : int
        How many are infinite.
    has_two : bool
        Whether there are only these two.
    border : (3,) int64
        How many on the faces of the grid are negative, positive, and the lowest.
    """

    low: float
    high: float
    is_finite: bool
    infinite: int
    has_two: bool
    border: NDArray[np.int64]


def ask_together(samples: SampleArray, questions: list[Question]) -> None:
    """Ask questions of samples, each plane of which is read once."""
    count, each = samples.shape[0], _together(tuple(samples.shape))
    least = READ_SAMPLES // (samples.shape[1] * samples.shape[2])
    step = each * -(-max(least, 2 * getattr(samples, "beside", 1)) // each)
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


def _answer_all(
    works: list[Callable[..., Any]], slab: NDArray[Any], ranges: list[Ranges]
) -> list[list[Any]]:
    """Return the answers to all questions about the ranges of some planes."""
    return [[work(slab[a:b], *more) for a, b, *more in mine] for work, mine in zip(works, ranges)]


def _together(shape: Shape) -> int:
    """Return how many planes are looked at together."""
    return max(TOGETHER // (shape[1] * shape[2]), 1)


def _numbers(shape: Shape) -> Question:
    """Ask for the numbers of all planes."""
    step, count = _together(shape), shape[0]
    ranges = [(i, min(i + step, count), i == 0, i + step >= count) for i in range(0, count, step)]
    return Question(ranges, _numbers_of, [])


def _numbers_of(planes: NDArray[Any], is_first: bool, is_last: bool) -> Numbers:
    """Return the numbers of some planes, the first and the last of the grid perhaps."""
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


def _unknown(shape: Shape) -> Question:
    """Ask for the runs of NaN of all planes."""
    ranges = [(max(i - 1, 0), i + 1) for i in range(shape[0])]
    return Question(ranges, partial(runs_of_plane, np.isnan), [])


def _spread(shape: Shape, beside: int, most: int) -> list[int]:
    """Return planes, spread evenly, that have some beside them; none of a narrow grid."""
    if min(shape) <= 2 * beside:
        return []
    return spread_planes(beside, shape[0] - 1 - beside, most)


def _patches(shape: Shape) -> Question:
    """Ask for the samples round some beside the surface."""
    size = shape[1] * shape[2]
    planes = _spread(shape, BESIDE, LOOKED_PLANES)
    ranges = [(i - BESIDE, i + BESIDE + 1, i * size) for i in planes]
    return Question(ranges, _around_surface, Few(MOST_LOOKED_AT))


def _around_surface(slab: NDArray[Any], number: int) -> tuple[NDArray[Any], ...]:
    """Return the samples round those that have one on the other side beside them.

    ``slab`` has five planes; the samples are those of the middle one, which begins with sample
    ``number``: (n,) ranks, (n, 5, 5, 5).
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
    around = boxes[j, k].astype(np.float64)
    return ranks[some], np.clip(around, -LARGEST_VALUE, LARGEST_VALUE, out=around)


def _plateaus(shape: Shape) -> Question:
    """Ask for the samples that are, as their six neighbours, the lowest or the highest."""
    planes = _spread(shape, BESIDE, LOOKED_PLANES)
    return Question([(i - 1, i + 2) for i in planes], _amid_equal, [])


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


def beside_surface(shape: Shape, planes: Iterable[int] | None = None) -> Question:
    """Ask for the gradients beside the surface in some planes."""
    count, size = shape[0], shape[1] * shape[2]
    ranges = [
        (max(i - 1, 0), min(i + 2, count), min(i, 1), i * size)
        for i in planes or spread_planes(0, count - 1, GRADIENT_PLANES)
    ]
    return Question(ranges, gradients_beside_surface, Few(MOST_BESIDE))


def _everywhere(shape: Shape) -> Question:
    """Ask for the gradients of some rows of some planes."""
    planes = [i for i in spread_planes(0, shape[0] - 1, GRADIENT_PLANES) if 0 < i < shape[0] - 1]
    planes = (planes or [1]) if min(shape) > 2 else []
    step = -(-len(planes) * shape[1] * shape[2] // MOST_GRADIENTS)
    return Question([(i - 1, i + 2, step) for i in planes], gradients_where_straight, [])


def _labels(shape: Shape) -> Question:
    """Ask how whole numbers change at boundaries."""
    ranges = [(i - 1, i + 2) for i in _spread(shape, 1, LABEL_PLANES)]
    return Question(ranges, _at_boundaries, [])


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


def _pairs(shape: Shape) -> Question:
    """Ask for some rows of some planes with their neighbours."""
    planes = spread_planes(0, shape[0] - 2, PAIR_PLANES)
    rows = slice(0, shape[1] - 1, -(-len(planes) * shape[1] * shape[2] // MOST_PAIRS))
    return Question([(i, i + 2) for i in planes], partial(_pairs_of, rows), [])


def _pairs_of(rows: slice, slab: NDArray[Any]) -> Floats:
    """Return samples of some rows of the first of two planes with those beside them, (2, n)."""
    row = slab[0, rows]
    beside = slab[1, rows], slab[0, 1:][rows]
    parts = [np.stack([row, other]).reshape(2, -1) for other in beside]
    parts.append(np.stack([row[:, :-1], row[:, 1:]]).reshape(2, -1))
    return np.concatenate(parts, axis=1).astype(np.float64)


QUESTIONS: dict[str, Callable[[Shape], Question]] = {
    "numbers": _numbers,
    "unknown": _unknown,
    "patches": _patches,
    "plateaus": _plateaus,
    "beside": beside_surface,
    "everywhere": _everywhere,
    "labels": _labels,
    "pairs": _pairs,
}
