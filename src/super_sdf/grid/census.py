"""One pass over the planes of a grid: all that is asked of its samples before they are meshed.

An array in memory is asked when an answer is needed (``questions`` has all that are asked).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray
from ..errors import GridError
from .planes import Few, SampleArray, SamplePlanes, over_planes
from .questions import (
    BESIDE,
    GRADIENT_PLANES,
    QUESTIONS,
    Floats,
    Numbers,
    Question,
    ask_together,
    beside_surface,
)
from .regions import Regions
from .slopes import ENOUGH, MOST_BESIDE, STRAIGHT, Gradients

Extremes = tuple[float, float]
"""The smallest and the largest sample."""

KEPT_BYTES = 1 << 25  # of a grid in a file that is read into memory to be asked
CUT_OFF = 0.01  # share of samples amid equal ones, at the lowest or highest value
MOST_BETWEEN = 0.4  # share of the samples at a boundary of labels that lie between two others
LEAST_JUMP = 0.3  # of the range of labels: so far some neighbours are apart


@dataclass(frozen=True, eq=False)
class Looked:
    """What was looked at.

    Attributes
    ----------
    around : (n, 5, 5, 5) float64
        The samples round samples that have one on the other side beside them.
    cut : (2,) float64
        Share of the samples that are, as their six neighbours, the lowest, and the highest.
    extremes : two floats
        The smallest and the largest sample.
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


class Census:
    """What the samples of a grid show.

    Parameters
    ----------
    samples : (nx, ny, nz) array or SamplePlanes
        They are read once, plane by plane; of booleans, only the numbers are asked.
    """

    def __init__(self, samples: SampleArray) -> None:
        self.samples, self.shape = samples, tuple(samples.shape)
        self._questions: dict[str, Question] = {}
        names = ("numbers", "unknown") if samples.dtype == np.bool_ else tuple(QUESTIONS)
        self._kept = samples if _is_in_memory(samples) else _small(samples)
        if self._kept is None:
            self._ask(names)

    def _ask(self, names: tuple[str, ...]) -> None:
        """Ask questions, all of each part of the planes that is read."""
        asked = {name: QUESTIONS[name](self.shape) for name in names}
        if self._kept is None:
            ask_together(self.samples, list(asked.values()))
        else:
            for ranges, work, answers in asked.values():
                for answer in over_planes(self._kept, work, ranges):
                    answers.append(answer)
        self._questions |= asked

    def _answers(self, name: str) -> Any:
        if name not in self._questions:
            self._ask((name,))
        return self._questions[name].answers

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

    @property
    def border_size(self) -> int:
        """The samples on the six faces; one on an edge counts for each of its faces."""
        nx, ny, nz = map(int, self.shape)
        return 2 * (nx * ny + ny * nz + nz * nx)

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
        answers, count = self._answers("beside"), self.shape[0]
        gradients = Gradients(*answers.joined()[1:])
        if count <= GRADIENT_PLANES or (gradients.bend < STRAIGHT).sum() >= ENOUGH:
            return gradients
        samples = self.samples if self._kept is None else self._kept
        ranges, work, _ = beside_surface(self.shape, range(count))
        answers = Few(MOST_BESIDE)
        for answer in over_planes(samples, work, ranges):
            answers.append(answer)
        return Gradients(*answers.joined()[1:])

    @cached_property
    def everywhere(self) -> Gradients:
        """Gradients at samples anywhere in the grid at which the field is not bent."""
        parts = self._answers("everywhere")
        if not parts:
            return Gradients(np.empty((0, 3)), np.empty(0))
        return Gradients(*(np.concatenate(arrays) for arrays in zip(*parts)))

    @cached_property
    def pairs(self) -> Floats:
        """Finite samples beside each other along an axis, (2, n), in some rows and planes."""
        pairs = np.concatenate(self._answers("pairs"), axis=1)
        if self.is_finite:
            return pairs
        finite = np.isfinite(pairs)
        return pairs[:, finite[0] & finite[1]]

    @cached_property
    def are_labels(self) -> bool:
        """Whether values look like labels: whole numbers of which regions jump to others.

        At the boundary of a region, a sample hardly ever lies between a lower and a higher
        neighbour; those of images and distances do.
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
    with np.errstate(over="ignore", invalid="ignore"):  # of long doubles
        bad = (np.argwhere(~np.isfinite(plane.astype(np.float64))) for plane in values)
        i, (j, k) = next((i, places[0]) for i, places in enumerate(bad) if len(places))
    return GridError(
        f"values[{i}, {j}, {k}] is {values[i][j, k]!s}: every sample must be finite; "
        "replace unknown far samples by a large distance of the right sign"
    )


def _is_in_memory(samples: SampleArray) -> bool:
    return isinstance(samples, np.ndarray) and not isinstance(samples, np.memmap)


def _small(samples: SampleArray) -> NDArray[Any] | None:
    """Return the samples of a small grid that is read here, None of others."""
    root: Any = samples
    size = np.prod(samples.shape, dtype=float) * samples.dtype.itemsize
    while isinstance(getattr(root, "source", None), np.ndarray | SamplePlanes):
        root = root.source
    is_read_here = isinstance(root, np.ndarray) or type(root).over is SamplePlanes.over
    return np.asarray(samples[0 : len(samples)]) if is_read_here and size <= KEPT_BYTES else None


def _are_layers(values: SampleArray) -> bool:
    """Return whether values differ along an axis of two samples only: a plane is between them."""
    if 2 not in values.shape:
        return False
    planes = np.asarray(values[0 : len(values)])
    return any(
        count == 2 and bool((planes == planes[_first_but(axis)]).all())
        for axis, count in enumerate(planes.shape)
    )


def _first_but(axis: int) -> tuple[slice, ...]:
    """Return an index to the first samples along all axes but one."""
    return tuple(slice(None) if n == axis else slice(1) for n in range(3))
