"""Gradients at samples, and what spacing they show.

Where a distance field is smooth its gradient has length 1 in world units, so its length in index
units is the spacing. Next to the surface of a thin part no sample is smooth, so samples away from
the surface count as well; but only those next to it tell how a field that is no distance changes
there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, Triple
from ..errors import GridError
from .placement import is_cubic
from .planes import lowest, ranks_of

# Values are clamped to this, so that squares of their differences do not overflow.
LARGEST_VALUE = 1e150
ENOUGH = 30  # least number of samples for an estimate
STRAIGHT = 0.3  # largest bend (see ``Gradients``) of a field that is nearly linear
BENT = 0.6  # larger bends: lengths may agree by chance, as for the distance to a mask
# Gradients are consistent if nine in ten of the straightest ones agree within 5 %.
AGREEING, AGREEMENT = 0.9, 0.05
UNEQUAL = 1.3  # ratio of the spacings measured along two axes from which they differ
MOST_BESIDE = 1 << 18  # samples beside the surface of which gradients are taken

Floats: TypeAlias = NDArray[np.float64]

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
        length = self[self.straighter & (self.bend <= BENT)].lengths
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
        squares = self.vectors[self.bend <= BENT] ** 2
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


def gradients_beside_surface(slab: NDArray[Any], middle: int, number: int) -> tuple[Any, ...]:
    """Return ranks, gradients (n, 3) and bends (n,) beside the surface in the ``middle`` plane.

    ``number`` is that of the plane's first sample.
    """
    slab = np.asarray(slab)
    inside = slab <= 0
    marks = (inside != inside[middle]).any(0)
    mark_crossings(inside[middle], marks)
    beside = np.flatnonzero(marks)
    ranks = ranks_of(beside + number)
    some = lowest(ranks, MOST_BESIDE)
    at = [np.full(1, middle), *np.unravel_index(beside[some], slab.shape[1:])]
    centre = as_clamped(slab[tuple(at)])
    gradient, change = np.empty((len(centre), 3)), np.zeros(len(centre))
    for axis in range(3):
        low, high = list(at), list(at)
        low[axis] = np.maximum(at[axis] - 1, 0)
        high[axis] = np.minimum(at[axis] + 1, slab.shape[axis] - 1)
        below, above = as_clamped(slab[tuple(low)]), as_clamped(slab[tuple(high)])
        steps = high[axis] - low[axis]
        gradient[:, axis] = (above - below) / steps
        change += np.where(steps == 2, np.abs(above - 2 * centre + below), 0)
    return ranks[some], gradient, _relative_bend(change, gradient)


def gradients_where_straight(slab: NDArray[Any], step: int) -> tuple[Floats, Floats]:
    """Return gradients (n, 3) and bends (n,) in every ``step``-th row where the field is not bent.

    Where the values are constant, as those of a truncated field are, there is no gradient.
    """
    inner = slice(1, -1, step), slice(1, -1)
    above = slab[2][inner], slab[1, 2::step, 1:-1], slab[1, 1:-1:step, 2:]
    below = slab[0][inner], slab[1, :-2:step, 1:-1], slab[1, 1:-1:step, :-2]
    centre, *sides = (as_clamped(samples) for samples in (slab[1][inner], *above, *below))
    pairs = list(zip(sides[:3], sides[3:]))
    gradient = np.stack([(high - low) / 2 for high, low in pairs], -1).reshape(-1, 3)
    change = sum(np.abs(high - 2 * centre + low) for high, low in pairs)
    bend = _relative_bend(np.ravel(change), gradient)
    straight = bend <= BENT
    return gradient[straight], bend[straight]


def _relative_bend(change: Floats, gradient: Floats) -> Floats:
    length = np.sqrt((gradient**2).sum(1))
    bend = np.full(len(length), np.inf)
    np.divide(change, length, out=bend, where=length > 1e-9 * change)
    return bend


def mark_crossings(sides: NDArray[Any], marks: BoolArray) -> None:
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
