"""What the samples of a grid look like: all numbers once, and some of them more closely.

All planes are read once, in order. What needs neighbours is asked of a part: a small grid as it is,
of others some planes with two to either side, half of them where the sign changes most, the others
spread evenly. Of that part some samples are kept: what is asked are shares, for which they do.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray
from .samples import SampleArray, changed, let_go, over_three

Floats: TypeAlias = NDArray[np.float64]
Extremes: TypeAlias = tuple[float, float]
"""The smallest and the largest sample."""

SMALL_GRID = 1 << 18  # samples of a grid that is a part as it is
SLABS, CLOSER = (4, 8), 1 << 20  # how many planes, least and most; samples of all of them, about
BOXES, LINES, PAIRS = 3000, 8000, 5300  # that are kept
FREQUENT = 0.01  # share of the samples of a sign, amid equal ones, that have one value
MOST_LABELS = 1000  # different values that are listed
TELLING = 30  # samples that tell a slope
LEVELS = 63  # that are tried
AS_GOOD = 0.9  # of the largest mean step of neighbours over a level
GROWS = 2.0  # times the share of all samples, that of the border above a level of unsigned values
SHARE, LEAST = 0.01, 20  # of the most steps over any level, and steps, that count
MOST_OUTSIDE = 0.65  # of the border, above a level: maps of noise to .55, distances from .76
MOST_NAMED = 8  # labels that a message lists
BENT = 0.1  # share of a slope: its differences where no kink is near; kinks have 1
NEARLY, FACTOR = 1e-3, 0.05  # off whole numbers, and from 1: nibabel 2e-10, atlases .012
GOLDEN = 0.6180339887  # its multiples, less whole numbers, are spread evenly from 0 to 1

# offsets of the samples in a box, and on the lines along the axes
BOX = np.indices((5, 5, 5)).reshape(3, -1).T - 2
CROSS = np.arange(-2, 3)[:, None] * np.eye(3, dtype=int)[:, None]


@dataclass(frozen=True, eq=False)
class Look:
    """What is known of a grid's samples; in float arrays, NaN is unknown or beyond what is seen."""

    shape: tuple[int, ...]
    low: float  # of the finite samples
    high: float
    unknown: int  # samples that are NaN
    infinite: int
    is_two: bool  # whether the finite samples have two values
    faces: NDArray[Any]  # all samples on the border of the grid
    # samples that are asked, (p, ny, nz); a plane of NaN is between planes that are not neighbours
    part: NDArray[Any]
    own: BoolArray  # (p,), the planes from which samples are kept; the others lie beside these

    @property
    def is_finite(self) -> bool:
        """Whether all samples are finite."""
        return not (self.unknown or self.infinite)

    @property
    def is_one_sided(self) -> bool:
        """Whether no value is below 0, or none above."""
        return self.low >= 0 or self.high <= 0

    @property
    def cut(self) -> list[float]:
        """The lowest and the highest value, as far as many samples have them: cut off there."""
        return [value for value in (self.low, self.high) if value in self.frequent]

    @cached_property
    def frequent(self) -> set[float]:
        """Values of many samples amid equal ones."""
        found, times = np.unique(self.part[equal_neighbours(self.part) == 6], return_counts=True)
        sides = self.part == self.part, self.part >= 0, self.part <= 0  # of values 0, over, below
        least = FREQUENT * np.array([np.count_nonzero(side) for side in sides])
        return set(found[times > least[np.sign(found).astype(int)]].tolist())

    @cached_property
    def boxes(self) -> Floats:
        """Samples (n, 5, 5, 5) round some beside the surface at 0."""
        return self._around(beside_surface(self.part), BOX, BOXES).reshape(-1, 5, 5, 5)

    @property
    def box_lines(self) -> Floats:
        """The lines (n, 3, 5) through the middles of the boxes."""
        return self.boxes[(slice(None), *np.moveaxis(CROSS + 2, -1, 0))]

    @cached_property
    def lines(self) -> Floats:
        """Lines of samples (m, 3, 5) through some that are neither the lowest nor the highest."""
        return self._around((self.part > self.low) & (self.part < self.high), CROSS, LINES)

    @cached_property
    def pairs(self) -> Floats:
        """Neighbours that differ, (2, k)."""
        pairs = list[Floats]()
        for axis in range(3):
            lines = np.moveaxis(self.part, axis, 0)
            one, other = lines[:-1], lines[1:]
            places = np.flatnonzero((one != other) & ~np.isnan(one) & ~np.isnan(other))
            at = np.unravel_index(_some(places, PAIRS), one.shape)
            pairs.append(np.stack([one[at], other[at]]).astype(np.float64))
        return np.concatenate(pairs, axis=1)

    def _around(self, asked: BoolArray, offsets: NDArray[Any], most: int) -> Floats:
        """Return the samples at offsets (..., 3) from some of those that are asked."""
        asked[~self.own] = False
        at = np.stack(np.unravel_index(_some(np.flatnonzero(asked), most), asked.shape), 1) + 2
        padded = np.pad(self.part, 2, constant_values=np.nan)
        step = np.array([padded[0].size, padded.shape[2], 1])
        places = (at @ step).reshape(-1, *[1] * (offsets.ndim - 1)) + offsets @ step
        found: Floats = padded.ravel().take(places).astype(np.float64)
        return found

    def without(self, value: float) -> Look:
        """Return the same with the samples of a value unknown."""
        return replace(self, part=np.where(self.part == value, np.nan, self.part))


def look_at(samples: SampleArray) -> Look:
    """Look at the samples of a grid, (nx, ny, nz)."""
    low, high, unknown, infinite = np.inf, -np.inf, 0, 0
    faces: list[NDArray[Any]] = []
    changes, former = np.zeros(len(samples), np.int64), None
    for i, plane in enumerate(samples):
        least, most = plane.min(), plane.max()
        if not (np.isfinite(least) and np.isfinite(most)):
            finite = plane[np.isfinite(plane)]
            unknown += int(np.isnan(plane).sum())
            infinite += int(np.isinf(plane).sum())
            least, most = finite.min(initial=np.inf), finite.max(initial=-np.inf)
        low, high = min(low, least.item()), max(high, most.item())
        inside = plane > 0
        sides = [(inside[1:], inside[:-1]), (inside[:, 1:], inside[:, :-1])]
        sides += [] if former is None else [(inside, former)]
        changes[i] = sum(int(np.count_nonzero(a != b)) for a, b in sides)
        former = inside
        ends = [plane.ravel()] if i in (0, len(samples) - 1) else []
        faces += [x.copy() for x in (*ends, plane[0], plane[-1], plane[:, 0], plane[:, -1])]
        if i % 16 == 0:
            let_go(samples)
    part, own = _part_of(samples, changes)
    shape, together = tuple(map(int, samples.shape)), np.concatenate(faces)
    is_two = _has_two([part], low, high) and _has_two(samples, low, high)
    if unknown or infinite:
        part = np.where(np.isfinite(part), part, np.nan)
    return Look(shape, low, high, unknown, infinite, is_two, together, part, own)


def _has_two(values: Iterable[NDArray[Any]], low: float, high: float) -> bool:
    return all(((x == low) | (x == high) | ~np.isfinite(x)).all() for x in values)


def _part_of(samples: SampleArray, changes: NDArray[np.int64]) -> tuple[NDArray[Any], BoolArray]:
    """Return the planes that are looked at, (p, ny, nz), and from which of them samples are kept.

    The other planes are the neighbours of these.
    """
    count, plane = len(samples), int(np.prod(samples.shape[1:]))
    small = samples.dtype in (np.float16, np.float32) or samples.dtype.itemsize < 3
    kind = np.float32 if small else np.float64
    if count * plane <= SMALL_GRID:
        return np.asarray(samples[:], kind), np.ones(count, bool)
    half = int(np.clip(CLOSER // plane, *SLABS)) // 2
    total = np.cumsum(changes)
    where = np.searchsorted(total, (np.arange(half) + 0.5) / half * total[-1]).clip(0, count - 1)
    chosen = np.unique([*where, *np.linspace(0, count - 1, half).astype(int)])
    parts, own = list[NDArray[Any]](), list[BoolArray]()
    for i in chosen.tolist():
        low = max(i - 2, 0)
        slab = np.asarray(samples[low : i + 3], kind)
        let_go(samples)
        parts += [slab, np.full((1, *slab.shape[1:]), np.nan, kind)]
        own.append(np.arange(len(slab) + 1) == i - low)
    return np.concatenate(parts), np.concatenate(own)


def _some(places: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """Return all places or one in each of ``most`` parts of them, somewhere in it."""
    if len(places) <= most:
        return places
    numbers = np.arange(most)
    parts = numbers + numbers * GOLDEN % 1
    return places[(parts * (len(places) / most)).astype(np.intp)]


def beside_surface(values: NDArray[Any]) -> BoolArray:
    """Return which samples have a known one of another sign beside them."""
    sides = (values > 0).view(np.int8) - (values < 0).view(np.int8)
    near, known = np.zeros(values.shape, bool), ~np.isnan(values)
    for axis in range(3):
        s, n, k = (np.moveaxis(x, axis, 0) for x in (sides, near, known))
        crossing = (s[1:] != s[:-1]) & k[1:] & k[:-1]
        n[1:] |= crossing
        n[:-1] |= crossing
    return near


def equal_neighbours(values: NDArray[Any]) -> NDArray[np.int8]:
    """Return how many of their six neighbours equal samples, or are not known."""
    equal, unknown = np.zeros(values.shape, np.int8), np.isnan(values)
    for axis in range(3):
        v, n, u = (np.moveaxis(x, axis, 0) for x in (values, equal, unknown))
        same = v[1:] == v[:-1]
        n[1:] += same | u[:-1]
        n[:-1] += same | u[1:]
        n[0] += 1
        n[-1] += 1
    equal[unknown] = 0
    return equal


def border_share(look: Look, is_marked: Callable[[NDArray[Any]], BoolArray]) -> float:
    """Return the share of the known samples on the border at which a function of them is true."""
    known = look.faces[np.isfinite(look.faces)]
    return float(is_marked(known).mean()) if known.size else 0.0


def typical_slope(look: Look, steps: Floats, cut: Sequence[float] = ()) -> float:
    """Return the median slope beside the surface, between samples that are not ``cut`` off.

    Along each axis it is the mean to both sides of a sample; if most are beside some that are cut
    off, the steeper one, and that at least. NaN if it is not known.
    """
    lines = look.box_lines[..., 1:4]
    rise = np.diff(np.where(np.isin(lines, cut), np.nan, lines)) / steps[:, None]
    mean = np.sqrt((rise.mean(2) ** 2).sum(1))
    known = np.isfinite(mean) & (mean > 0)
    if known.sum() >= max(TELLING, len(lines) / 2) or not len(cut):
        return float(np.median(mean[known])) if known.any() else float("nan")
    length = np.linalg.norm(np.fmax(*np.moveaxis(np.abs(np.diff(lines)), 2, 0)) / steps, axis=1)
    return float(np.nanmedian(length)) if np.isfinite(length).any() else float("nan")


def different_values(samples: SampleArray) -> tuple[NDArray[Any], NDArray[np.int64]] | None:
    """Return the finite values of all planes and how often each is; None if they are many."""
    counts = Counter[Any]()
    for plane in samples:
        flat = plane[np.isfinite(plane)]
        first = np.flatnonzero(np.append(flat.size > 0, flat[1:] != flat[:-1]))  # of equal ones
        found, which = np.unique(flat[first], return_inverse=True)
        times = np.bincount(which, np.diff(np.append(first, flat.size)))
        counts.update(dict(zip(found.tolist(), times.tolist())))
        if len(counts) > MOST_LABELS:
            return None
    values = sorted(counts)
    return np.array(values, samples.dtype), np.array([counts[x] for x in values], np.int64)


def whole_factor(parts: Iterable[NDArray[Any]]) -> float:
    """Return the factor near 1 by which all values but NaN are whole numbers, 0 if they are not."""
    least = np.inf
    for values in parts:
        sizes = np.abs(np.asarray(values, np.float64))
        least = min(least, float(sizes[sizes > NEARLY].min(initial=np.inf)))
    factor = least / max(round(least), 1) if least < np.inf else 0.0
    if abs(factor - 1) > FACTOR:
        return 0.0
    for values in parts:
        sizes = np.abs(np.asarray(values, np.float64) / factor)
        if (np.abs(sizes - np.rint(sizes)) > np.maximum(NEARLY, 1e-9 * sizes)).any():
            return 0.0
    return factor


def as_labels(samples: SampleArray, unknown: float = np.nan) -> SampleArray:
    """Return labels that were stored as floats as whole numbers; ``unknown`` is put for NaN."""
    factor = whole_factor(samples) if samples.dtype.kind == "f" else 0.0
    if not factor:
        return samples
    return changed(samples, lambda x: np.where(np.isnan(x), unknown, np.rint(x / factor)))


def count_valleys(look: Look, slope: float, sign: int) -> tuple[int, int]:
    """Count valleys of slope, sign * values above 0, where 0 is near and the sign does not change.

    And the changes of sign of neighbours.
    """
    count = changes = 0
    values = look.part * (sign / slope)
    for axis in range(3):
        v = np.moveaxis(values, axis, 0)
        changes += int(np.count_nonzero((v[1:] > 0) & (v[:-1] <= 0) | (v[1:] <= 0) & (v[:-1] > 0)))
        before, x, after = v[:-2], v[1:-1], v[2:]
        # distances fall to half a step at most, and rise by nearly one on either side
        low = (x >= 0) & (x < 0.52) & (before > x) & ((after > x) | ((after == x) & (x > 0.25)))
        count += int(np.count_nonzero(low & (before + after - 2 * x > 0.9)))
    return count, changes


def side_of_zeros(look: Look) -> int:
    """Return the side of samples that are 0: that which has none of its own beside some of them."""
    zeros, sides = look.part == 0, (look.part < 0, look.part > 0)
    lone = [np.count_nonzero(zeros & ~over_three(side, np.logical_or)) for side in sides]
    return int(np.sign(lone[1] - lone[0]))


def last_digit(look: Look) -> float:
    """Return by how much values beside the surface typically differ at least."""
    largest = max(abs(look.low), abs(look.high))
    values = (look.boxes[:, 2, 2, 2] / largest).astype(np.float32)
    values = np.unique(values[np.isfinite(values)])
    return float(np.quantile(np.diff(values), 0.5)) * largest if len(values) > 1 else 0.0


def smooth_gradients(lines: Floats) -> tuple[Floats, int]:
    """Return the gradients (n, 3) at samples, of lines (m, 3, 5), where no kink is near.

    They are of fourth order where five samples in a row are known and their fourth differences are
    small; else of second order where second differences are small. The number is of the first.
    """
    a, b, c, d, e = np.moveaxis(lines, -1, 0)
    second, fourth = (d - b) / 2, (8 * (d - b) - (e - a)) / 12
    bend = np.abs(d - 2 * c + b).sum(1)
    rough = np.abs(e - 4 * d + 6 * c - 4 * b + a).sum(1)
    kink = np.abs(e - 2 * d + 2 * b - a).max(1) / 2 if len(lines) else rough
    size, other = np.sqrt((fourth**2).sum(1)), np.sqrt((second**2).sum(1))
    smooth = (rough < BENT * size) & (kink < 2 * BENT * size)
    flat = np.isnan(size) & (bend < BENT * other)
    return np.concatenate([fourth[smooth], second[flat]]), int(smooth.sum())


def steps_by_axis(gradients: Floats) -> Floats:
    """Return the steps along the axes with which most gradients have length 1; NaN if none do."""
    keep = np.ones(len(gradients), bool)
    for _ in range(6):
        square = np.linalg.lstsq(gradients[keep] ** 2, np.ones(keep.sum()), rcond=None)[0]
        if (square <= 0).any():
            return np.full(3, np.nan)
        off = np.abs(np.sqrt(gradients**2 @ square) - 1)
        keep = off <= max(2 * np.median(off), 1e-6)
    return np.asarray(1 / np.sqrt(square))


# What a refusal names


def which_level(look: Look) -> str:
    """Return the advice to give a level: that over which neighbours differ most.

    It is the shortest number among those that are about as good, and never a value of a sample.
    """
    low, high = np.sort(look.pairs, axis=0)
    ends = np.quantile(look.pairs, [0.002, 0.998]).tolist()
    levels = np.linspace(ends[0], ends[1], LEVELS + 2)[1:-1]
    over = (low[:, None] < levels) & (high[:, None] >= levels)
    total = over.sum(0)
    steps = np.where(total >= max(LEAST, SHARE * total.max()), (high - low) @ over, 0)
    steps = steps / total.clip(1)
    faces = np.sort(look.faces[np.isfinite(look.faces)])
    share = np.searchsorted(faces, levels) / max(len(faces), 1)  # of the border, below a level
    inner = (look.lines[:, 0, 2][:, None] < levels).mean(0) if len(look.lines) else share
    # values that grow outwards: above are only the corners of the grid
    grows = (1 - share > GROWS * (1 - inner)) & (share > 0.5)
    if grows[steps.argmax()] and (all_above := share < 0.1).any():
        steps = np.where(all_above, steps, 0)
    good = levels[steps >= AS_GOOD * steps.max()]
    least, middle, most = np.quantile(good, [0.4, 0.5, 0.6]).tolist()
    short = (float(f"{middle:.{digits}g}") for digits in (1, 2, 3))
    level = next((x for x in short if least <= x <= most), middle)
    if look.faces.dtype.kind in "iu":
        level = float(np.floor(level)) + 0.5
    values = np.unique(np.append(look.pairs, (look.low, look.high)))
    at = int(np.searchsorted(values, level))
    if at < len(values) and values[at] == level:
        level = float(values[at - 1 if at else 1] + level) / 2
    outside = border_share(look, lambda x: x > level) > MOST_OUTSIDE
    option = f"--level {level:.6g} --inside {'negative' if outside else 'positive'}"
    other = " (or, if the surface is at 0, --field smooth)" if look.low < 0 < look.high else ""
    return f"the values look like densities: give the surface's level, such as {option}{other}"


def which_label(found: tuple[NDArray[Any], NDArray[np.int64]] | None) -> str:
    """Return the advice to choose a label: the most frequent besides the background."""
    if found is None:
        return "the values are labels: choose one with --label, or several with --labels"
    distinct, counts = found
    ordered = distinct[np.argsort(counts, kind="stable")[::-1]]
    first = 0 if 0 in distinct else 1  # without a 0 the background is the most frequent
    best = next((x for x in ordered[first:] if x), ordered[0]).item()
    said = f"the values look like labels ({named(distinct.tolist())})"
    return f"{said}: choose one with --label {round(best)}, or mesh all with --labels all"


def named(labels: Any) -> str:
    """Return labels in words, the first eight in order, without NaN."""
    ordered = sorted(x for x in labels if x == x)
    words = ", ".join(f"{x:g}" if x % 1 else str(int(x)) for x in ordered[:MOST_NAMED])
    return words + (", ..." if len(ordered) > MOST_NAMED else "")
