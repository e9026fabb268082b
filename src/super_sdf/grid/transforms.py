"""Distance transforms of masks: what tells them from exact distances.

The values of a transform follow from the sides of the samples: each is the distance to the nearest
sample of another side, in the world or on the lattice, by whatever measure, perhaps squared, less
half a voxel or a whole one, or clipped. Exact distances know where between two samples the surface
is, so they are others. Only those to a solid with all its faces on samples are the same, in which
the samples on the surface are 0. Then the surface of a mask shows by its steps: they are one sample
high wherever it is not along the axes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import permutations, product
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, Triple
from .census import BESIDE, Floats, Looked
from .placement import is_cubic

MOST_PATCHES = 1 << 12  # samples that are compared with all round them
LEAST = 20  # samples from which shares of them are evidence
MOST, MOST_APART = 0.98, 0.95  # shares of the samples that follow from the sides
ERROR = 0.01  # of values: they may have two decimals
ZERO = 1e-3  # of the step: up to this, values are 0
STEPPED = 0.03  # share of the samples beside the surface from which it has steps

AROUND = np.array(list(product(range(-BESIDE, BESIDE + 1), repeat=3)))
INNER = slice(1, -1)
Measure: TypeAlias = Callable[[NDArray[np.int64]], Floats]
"""From offsets between samples, (n, 3), to their lengths, (n,); 1 to the nearest sample."""


@dataclass(frozen=True)
class Transform:
    """A distance transform of a mask.

    Attributes
    ----------
    step : float
        The spacing of the finest axis, in the unit of the values.
    zeros : int
        The sign of the side to which samples that are 0 belong; 0 if it is the inside.
    """

    step: float
    zeros: int


@dataclass(frozen=True)
class Found:
    """What was seen of values that follow from the sides, where exact distances may not.

    Attributes
    ----------
    apart : bool
        Whether there are samples whose nearest one of another side is not along an axis. Exact
        distances to planes half-way between samples are others there.
    beyond : bool
        Whether it is along an axis for some, but not next to them: other than of planes at 45
        degrees.
    """

    apart: bool
    beyond: bool


def find_transform(looked: Looked, spacing: Triple | None) -> Transform | None:
    """Return what transform of a mask values are, None if they cannot be one.

    Parameters
    ----------
    looked : Looked
        Samples beside the surface.
    spacing : three floats, optional
        The spacing of each axis, if it is known.
    """
    steps = np.ones(3) if spacing is None or is_cubic(spacing) else np.array(spacing)
    steps = steps / steps.min()
    patches = looked.around[:: len(looked.around) // MOST_PATCHES + 1]
    sides = patches <= 0, patches < 0
    ends = next(filter(None, (_beside(patches, side, steps) for side in sides)), None)
    if ends is None:
        return None
    unit = max(ends)
    patches, clipped = patches / unit, np.abs(looked.extremes) / unit
    patches[np.abs(patches) < ZERO] = 0
    if clipped.max() < 1 + ERROR:  # two values, perhaps of labels
        return None
    if min(ends) > unit / 2:
        return _of_both_sides(patches, steps, clipped, unit)
    is_flat = clipped.max() < 2 + ERROR and looked.cut[clipped.argmax()] > 0
    side = -1 if ends[0] < ends[1] else 1
    return _with_zeros(patches, steps, clipped, unit, side, is_flat=bool(is_flat))


def _beside(patches: Floats, inside: BoolArray, steps: Floats) -> tuple[float, float] | None:
    """Return how far samples below and above 0 beside the other side are from it, if all alike.

    No sample of the other side is nearer than that along the finest axes.
    """
    beside = np.zeros(len(patches), bool)
    for axis in np.flatnonzero(steps < 1 + ZERO):
        line = np.moveaxis(inside, axis + 1, 1)[:, 1:4, BESIDE, BESIDE]
        beside |= (line != line[:, 1:2]).any(1)
    centre, is_in = (x[beside, BESIDE, BESIDE, BESIDE] for x in (patches, inside))
    ends: list[float] = []
    for side in (-centre[is_in], centre[~is_in]):
        middle = float(np.median(side)) if len(side) else 0.0
        alike = np.abs(side - middle) <= ERROR * np.abs(centre).max(initial=0)
        if len(side) < LEAST // 2 or alike.mean() < MOST:
            return None
        ends.append(middle)
    low, high = ends
    share = min(ends) / max(ends) if max(ends) > 0 else 0.5
    return (low, high) if share <= ZERO or share >= 1 - ERROR else None


def _of_both_sides(
    patches: Floats, steps: Floats, clipped: Floats, unit: float
) -> Transform | None:
    """Return the transform if values jump from one side to the other, by two voxels or by one."""
    sides = np.sign(patches)
    for measure, step in (*_euclidean(steps, unit), *_others(steps, unit, weighted=True)):
        if _follow(patches, sides, measure, (0, 0), clipped):
            return Transform(step, 0)
    for measure, step in _euclidean(steps, 2 * unit):
        if (found := _follow(patches / 2, sides, measure, (0.5, 0.5), clipped / 2)) and found.apart:
            return Transform(step, 0)
    return None


def _with_zeros(
    patches: Floats,
    steps: Floats,
    clipped: Floats,
    unit: float,
    side: int,
    *,
    is_flat: bool,
) -> Transform | None:
    """Return the transform if samples beside the surface are 0 on one side.

    ``side`` is the sign of the others there. Values that are ``is_flat`` beyond the second sample
    may be the shares of voxels that are inside, 0, 1/2 and 1.
    """
    own = np.sign(patches)
    one_sided = clipped.min() == 0
    euclidean = list(_euclidean(steps, unit))
    for measure, step in (*euclidean, *_others(steps, unit, weighted=one_sided)):
        found = _follow(patches, own, measure, (0, 0), clipped)
        if found and one_sided and is_flat and not found.apart:
            return None
        if found and (found.beyond or (measure, step) in euclidean):
            is_mask = _is_filled(own) or _is_stepped(own)
            return Transform(step, side if one_sided else _side_of_zeros(own)) if is_mask else None
    joined = np.where(own == 0, side, own)
    for measure, step in euclidean:
        found = _follow(patches, joined, measure, (side < 0, side > 0), clipped)
        if found and found.apart:
            return Transform(step, side)
    return None


def _euclidean(steps: Floats, unit: float) -> Iterator[tuple[Measure, float]]:
    """Yield the Euclidean measures, in the world, and on the lattice if that is another one.

    ``unit`` is the least value. With each is the spacing that it shows.
    """
    yield partial(_length, steps), unit
    if steps.max() > 1 + ZERO:
        yield partial(_length, np.ones(3)), unit


def _others(steps: Floats, unit: float, *, weighted: bool) -> Iterator[tuple[Measure, float]]:
    """Yield the squares of these, and ``weighted`` measures: chessboard, city-block and 3-4-5."""
    for length, _ in _euclidean(steps, unit):
        yield partial(_squared, length), unit**0.5
    if weighted:
        yield from ((partial(_weighted, weight), unit) for weight in (0.0, 1.0))
        yield partial(_weighted, 1 / 3), unit / 3


def _squared(length: Measure, offsets: NDArray[np.int64]) -> Floats:
    return length(offsets) ** 2


def _length(steps: Floats, offsets: NDArray[np.int64]) -> Floats:
    lengths: Floats = np.linalg.norm(offsets * steps, axis=1)
    return lengths


def _weighted(weight: float, offsets: NDArray[np.int64]) -> Floats:
    """Return the largest part of each offset, and the others by weight."""
    size = np.abs(offsets)
    lengths: Floats = size.max(1) * (1 - weight) + size.sum(1) * weight
    return lengths


def _follow(
    patches: Floats,
    sides: Floats,
    measure: Measure,
    less: tuple[float, float],
    clipped: Floats,
) -> Found | None:
    """Return what shows that values follow from the sides, less something on either; None if not.

    ``clipped`` are the largest values.
    """
    nearest, straight = _nearest(sides, measure)
    values = patches[:, INNER, INNER, INNER].reshape(nearest.shape)
    nearest -= np.where(values < 0, *less)
    expected = np.minimum(nearest, np.where(values < 0, *clipped))
    known = np.isfinite(expected) & (values != 0)
    agree = np.abs(np.abs(values) - expected) <= ERROR * np.maximum(expected, 1)
    free = known & (expected > nearest - ERROR)
    groups = known, free & ~straight, free & straight & (expected > 1 + ERROR)
    enough = [bool(group.sum() >= LEAST) for group in groups]
    follow = all(
        agree[group].mean() >= share
        for group, share, is_enough in zip(groups, (MOST, MOST_APART, MOST_APART), enough)
        if is_enough
    )
    return Found(*enough[1:]) if enough[0] and follow else None


def _nearest(sides: Floats, measure: Measure) -> tuple[Floats, BoolArray]:
    """Return how far the nearest sample of another side is, NaN if it may be out of the patch.

    It is that of the inner samples, (m, 27); and whether it is along an axis.
    """
    flat = sides.reshape(len(sides), -1)
    inner = AROUND[np.abs(AROUND).max(1) < BESIDE]
    nearest, straight = np.full((2, len(sides), len(inner)), np.nan)
    for number, place in enumerate(inner):
        outermost = measure(np.diag(BESIDE + 1 - np.abs(place))).min()
        lengths = measure(AROUND - place)
        parts = ((AROUND - place) != 0).sum(1)
        order = np.lexsort((parts, lengths.round(6)))
        order = order[lengths[order] < outermost * (1 + ERROR)]
        other = flat[:, order] != flat[:, (place == AROUND).all(1)]
        first = other.argmax(1)
        nearest[:, number] = np.where(other.any(1), lengths[order][first], np.nan)
        straight[:, number] = parts[order][first] < 2
    return nearest, straight != 0


def _is_filled(sides: Floats) -> bool:
    """Return whether there are zeros amid zeros, as on the other side of one-sided transforms."""
    return int((~_windows(sides).any((-3, -2, -1))).sum()) >= LEAST


def _windows(sides: Floats) -> Floats:
    """Return the neighbours of inner samples and these, (m, 3, 3, 3, 3, 3, 3)."""
    return np.lib.stride_tricks.sliding_window_view(sides, (3, 3, 3), axis=(1, 2, 3))


def _is_stepped(sides: Floats) -> bool:
    """Return whether the surface, where samples are 0, has the steps of a mask.

    Beside a step, a sample is next to zeros along two axes, of which one does not go on. Stairs go
    up one way, or two that are not opposite; what is curved or turned has steps the other way, too.
    """
    centre = sides[:, BESIDE, BESIDE, BESIDE]
    near = (sides == 0)[:, INNER, INNER, INNER]
    zero = np.concatenate([near[centre > 0], near[centre < 0][:, ::-1, ::-1, ::-1]])
    ways = [*np.eye(3, dtype=int), *-np.eye(3, dtype=int)]
    next_to = [_at(zero, way) for way in ways]
    stepped, counts = np.zeros(len(zero), bool), np.zeros((6, 6), int)
    for i, j in permutations(range(6), 2):
        if i % 3 != j % 3:
            goes_on = _at(zero, ways[i] - ways[j]) & _at(zero, ways[j] - ways[i])
            found = next_to[i] & next_to[j] & ~goes_on
            stepped |= found
            counts[i, j] = found.sum()
    share = stepped.sum() / max(np.any(next_to, 0).sum(), LEAST)
    both_ways = np.minimum(counts, np.roll(counts, (3, 3), (0, 1)))
    return bool(share > STEPPED and both_ways.any())


def _at(patches: BoolArray, offset: NDArray[np.int64]) -> BoolArray:
    """Return the samples at an offset from the middle of patches (m, 3, 3, 3)."""
    found: BoolArray = patches[(..., *(1 + offset))]
    return found


def _side_of_zeros(sides: Floats) -> int:
    """Return the sign of the side that zeros are the border of, 0 if that does not show.

    Each of them has a neighbour of the other side then, but not of its own side.
    """
    zero = sides[:, INNER, INNER, INNER] == 0
    lone = [int((zero & ~(_windows(sides) == sign).any((-3, -2, -1))).sum()) for sign in (-1, 1)]
    return int(np.sign(lone[1] - lone[0]))
