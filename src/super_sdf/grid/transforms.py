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
from functools import partial
from itertools import permutations, product
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, Triple
from .census import BESIDE, Looked
from .placement import is_cubic
from .slopes import Floats

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


class Transform(NamedTuple):
    """A distance transform."""

    step: float  # the spacing of the finest axis
    zeros: int  # the sign of the side of samples that are 0; 0 if it is the inside


class Apart(NamedTuple):
    """Whether values follow from the sides at samples at which exact distances may not."""

    apart: bool  # from an axis: exact distances to planes half-way between samples are others there
    beyond: bool  # the next one along an axis: so are those to all but planes at 45 degrees


def find_transform(looked: Looked, spacing: Triple | None) -> Transform | None:
    """Return what transform of a mask the values beside the surface are; None if of none."""
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
    """Return how far samples below and above 0 beside the other side are from it, if all alike."""
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
    share = min(ends) / max(ends) if max(ends) > 0 else 0.5
    return (ends[0], ends[1]) if share <= ZERO or share >= 1 - ERROR else None


def _of_both_sides(
    patches: Floats, steps: Floats, clipped: Floats, unit: float
) -> Transform | None:
    """Return the transform if values jump from one side to the other, by two voxels or by one."""
    sides = np.sign(patches)
    for measure, step in (*_euclidean(steps, unit), *_others(steps, unit, weighted=True)):
        if _follow(patches, sides, measure, (0, 0), clipped):
            return Transform(step, 0)
    for measure, step in _euclidean(steps, 2 * unit):
        seen = _follow(patches / 2, sides, measure, (0.5, 0.5), clipped / 2)
        if seen and seen.apart:
            return Transform(step, 0)
    return None


def _with_zeros(
    patches: Floats, steps: Floats, clipped: Floats, unit: float, side: int, *, is_flat: bool
) -> Transform | None:
    """Return the transform if samples beside the surface are 0 on one side, the other is ``side``.

    Values that are ``is_flat`` beyond the second sample may be the shares of voxels that are
    inside, 0, 1/2 and 1.
    """
    signs = np.sign(patches)
    one_sided = clipped.min() == 0
    euclidean = list(_euclidean(steps, unit))
    for measure, step in (*euclidean, *_others(steps, unit, weighted=one_sided)):
        seen = _follow(patches, signs, measure, (0, 0), clipped)
        if seen and one_sided and is_flat and not seen.apart:
            return None
        if seen and (seen.beyond or (measure, step) in euclidean):
            is_mask = _count_lone(signs == 0) >= LEAST or _is_stepped(signs)
            zeros = side if one_sided else _side_of_zeros(signs)
            return Transform(step, zeros) if is_mask else None
    joined = np.where(signs == 0, side, signs)
    for measure, step in euclidean:
        seen = _follow(patches, joined, measure, (side < 0, side > 0), clipped)
        if seen and seen.apart:
            return Transform(step, side)
    return None


def _euclidean(steps: Floats, unit: float) -> Iterator[tuple[Measure, float]]:
    """Yield Euclidean measures, in the world and on the lattice, and the spacings they show."""
    yield partial(_length, steps), unit
    if steps.max() > 1 + ZERO:
        yield partial(_length, np.ones(3)), unit


def _others(steps: Floats, unit: float, *, weighted: bool) -> Iterator[tuple[Measure, float]]:
    """Yield the squares of these, and ``weighted`` measures: chessboard, city-block and 3-4-5."""
    for length, _ in _euclidean(steps, unit):
        yield lambda offsets, length=length: length(offsets) ** 2, unit**0.5  # type: ignore[misc]
    if weighted:
        yield from ((partial(_weighted, weight), unit) for weight in (0.0, 1.0))
        yield partial(_weighted, 1 / 3), unit / 3


def _length(steps: Floats, offsets: NDArray[np.int64]) -> Floats:
    lengths: Floats = np.linalg.norm(offsets * steps, axis=1)
    return lengths


def _weighted(weight: float, offsets: NDArray[np.int64]) -> Floats:
    """Return the largest part of each offset, and the others by weight."""
    size = np.abs(offsets)
    lengths: Floats = size.max(1) * (1 - weight) + size.sum(1) * weight
    return lengths


def _follow(
    patches: Floats, sides: Floats, measure: Measure, less: tuple[float, float], clipped: Floats
) -> Apart | None:
    """Return where values follow from the sides, ``less`` something on either; None if nowhere."""
    nearest, straight = _nearest(sides, measure)
    values = patches[:, INNER, INNER, INNER].reshape(nearest.shape)
    nearest -= np.where(values < 0, *less)
    expected = np.minimum(nearest, np.where(values < 0, *clipped))
    known = np.isfinite(expected) & (values != 0)
    agree = np.abs(np.abs(values) - expected) <= ERROR * np.maximum(expected, 1)
    free = known & (expected > nearest - ERROR)
    groups = known, free & ~straight, free & straight & (expected > 1 + ERROR)
    enough = [bool(group.sum() >= LEAST) for group in groups]
    shares = zip(groups, (MOST, MOST_APART, MOST_APART), enough)
    follow = all(agree[group].mean() >= share for group, share, is_enough in shares if is_enough)
    return Apart(*enough[1:]) if enough[0] and follow else None


def _nearest(sides: Floats, measure: Measure) -> tuple[Floats, BoolArray]:
    """Return how far from inner samples (m, 27) the nearest of another side is; if along an axis.

    It is NaN if it may be out of the patch.
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


def _count_lone(marked: BoolArray, centre: BoolArray | None = None) -> int:
    """Count inner samples, those of ``centre`` if given, round which all are marked."""
    windows = np.lib.stride_tricks.sliding_window_view(marked, (3, 3, 3), axis=(1, 2, 3))
    alone = windows.all((-3, -2, -1))
    return int((alone if centre is None else alone & centre).sum())


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
            steps = next_to[i] & next_to[j] & ~goes_on
            stepped |= steps
            counts[i, j] = steps.sum()
    share = stepped.sum() / max(np.any(next_to, 0).sum(), LEAST)
    both_ways = np.minimum(counts, np.roll(counts, (3, 3), (0, 1)))
    return bool(share > STEPPED and both_ways.any())


def _at(patches: BoolArray, offset: NDArray[np.int64]) -> BoolArray:
    return np.asarray(patches[(..., *(1 + offset))])


def _side_of_zeros(sides: Floats) -> int:
    """Return the sign of the side that zeros border, with no neighbour there; 0 if unclear."""
    zero = sides[:, INNER, INNER, INNER] == 0
    lone = [_count_lone(sides != sign, zero) for sign in (-1, 1)]
    return int(np.sign(lone[1] - lone[0]))
