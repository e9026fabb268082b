"""What the samples of a grid look like: all numbers once, and some of them more closely.

All planes are read once, in order. What needs neighbours is asked of ``SLABS`` planes at most, with
two to either side: half of them where the sign changes most, the others spread evenly. A small grid
is one slab. Of these, seeded samples are kept: what is asked are shares, for which they suffice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray
from .samples import SampleArray, let_go, spread_planes

Floats: TypeAlias = NDArray[np.float64]
Extremes: TypeAlias = tuple[float, float]
"""The smallest and the largest sample."""

WHOLE = 1 << 18  # samples of a grid that is one slab
SLABS = 16
BOXES, LINES, PAIRS = 3000, 8000, 16_000  # that are kept
ORDINARY = 1e-30, 1e30  # of the largest value: others are divided by it, so that squares are finite
MOST_LABELS, FEW = 1000, 3  # different values that are listed; that are looked for first
ENOUGH = 30  # samples that tell a slope
LEVELS = 63  # that are tried
AS_GOOD = 0.9  # of the largest mean step of neighbours over a level
GROWS = 2.0  # times the share of all samples, that of the border above a level of unsigned values
SHARE, LEAST = 0.05, 20  # of the most steps over any level, and steps, that count
MOST_OUTSIDE = 0.65  # of the border, above a level: maps of noise to .55, distances from .76
MOST_NAMED = 8  # labels that a message lists
TRIED = 4096  # samples whose different values are counted first

AXES = np.array([[0, 0, 0], *np.kron(np.eye(3, dtype=int), [[-2], [-1], [1], [2]])])
ON_LINES = np.array([[1, 2, 0, 3, 4], [5, 6, 0, 7, 8], [9, 10, 0, 11, 12]])
FACES = np.array([(1, 2, 2), (3, 2, 2), (2, 1, 2), (2, 3, 2), (2, 2, 1), (2, 2, 3)])
BOX = np.indices((5, 5, 5)).reshape(3, -1).T - 2


class Slab(NamedTuple):
    """Some planes of a grid; ``own`` are those that are asked, the others are beside them."""

    planes: NDArray[Any]
    own: slice


@dataclass(frozen=True, eq=False)
class Look:
    """What is known of a grid's samples; in float64 arrays, NaN is unknown or beyond the grid."""

    shape: tuple[int, ...]
    low: float  # of the finite samples
    high: float
    unknown: int  # samples that are NaN
    infinite: int
    few: list[Any]  # different finite values, up to ``FEW`` of them, as found
    faces: NDArray[Any]  # all samples on the border of the grid
    slabs: list[Slab] = field(default_factory=list)
    scale: float = 1.0  # by which what is kept was divided
    # samples (n, 5, 5, 5) round some beside the surface at 0
    boxes: Floats = field(default_factory=lambda: np.empty((0, 5, 5, 5)))
    # (m, 3, 5), through samples that are neither the lowest nor the highest
    lines: Floats = field(default_factory=lambda: np.empty((0, 3, 5)))
    pairs: list[Floats] = field(default_factory=list)  # of each axis: different neighbours, (2, k)
    at_ends: tuple[float, float] = 0.0, 0.0  # share of the samples amid the lowest, the highest
    # other values, and their shares, of which one sample in 100 is amid equal ones
    common: dict[float, float] = field(default_factory=dict)

    @property
    def is_finite(self) -> bool:
        """Whether all samples are finite."""
        return not (self.unknown or self.infinite)

    @property
    def is_one_sided(self) -> bool:
        """Whether no value is below 0, or none above."""
        return self.low >= 0 or self.high <= 0

    @property
    def all_pairs(self) -> Floats:
        """The pairs of all axes."""
        return np.concatenate(self.pairs, axis=1)

    def without(self, value: float) -> Look:
        """Return the same with the kept samples of a value unknown."""
        boxes, lines = (np.where(x == value, np.nan, x) for x in (self.boxes, self.lines))
        sides = np.sign(boxes[(slice(None), *FACES.T)]) * np.sign(boxes[:, 2, 2, 2])[:, None]
        pairs = [x[:, (x != value).all(0)] for x in self.pairs]
        return replace(self, boxes=boxes[(sides < 0).any(1)], lines=lines, pairs=pairs)


def look_at(samples: SampleArray) -> Look:
    """Look at the samples of a grid, (nx, ny, nz)."""
    low, high, unknown, infinite = np.inf, -np.inf, 0, 0
    few: list[Any] = []
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
        changes[i] = sum(int(np.count_nonzero(a != b)) for a, b in _beside(inside, former))
        former = inside
        for part in (plane[:1], plane):
            few = few if len(few) >= FEW else _more_values(part, few)
        is_end = i in (0, len(samples) - 1)
        faces += [plane.ravel()] if is_end else []
        faces += [plane[0], plane[-1], plane[:, 0], plane[:, -1]]
        if i % SLABS == 0:
            let_go(samples)
    shape, together = tuple(map(int, samples.shape)), np.concatenate(faces)
    look = Look(shape, low, high, unknown, infinite, few, together)
    if not low < high:
        return look
    if high <= 0:
        changes = np.array([np.count_nonzero(plane < 0) for plane in samples])
    look = replace(look, slabs=_slabs(samples, changes))
    return _with_samples(look)


def _beside(plane: BoolArray, former: BoolArray | None) -> list[tuple[BoolArray, BoolArray]]:
    sides = [(plane[1:], plane[:-1]), (plane[:, 1:], plane[:, :-1])]
    return sides if former is None else [*sides, (plane, former)]


def _more_values(part: NDArray[Any], few: list[Any]) -> list[Any]:
    """Return the different finite values known so far with those of a part, ``FEW`` at most."""
    rest = part
    for value in few:
        rest = rest[rest != value]
    rest = rest[np.isfinite(rest)]
    while rest.size and len(few) < FEW:
        few = [*few, rest.flat[0].item()]
        rest = rest[rest != rest.flat[0]]
    return few


def _slabs(samples: SampleArray, changes: NDArray[np.int64]) -> list[Slab]:
    count = len(samples)
    if np.prod(samples.shape, dtype=float) <= WHOLE:
        return [Slab(np.asarray(samples[:]), slice(0, count))]
    total = np.cumsum(changes)
    where = np.searchsorted(total, (np.arange(SLABS // 2) + 0.5) / (SLABS // 2) * total[-1])
    chosen = {*where.clip(0, count - 1).tolist(), *spread_planes(0, count - 1, SLABS // 2)}
    slabs = []
    for i in sorted(chosen):
        low = max(i - 2, 0)
        slabs.append(Slab(np.asarray(samples[low : i + 3]), slice(i - low, i - low + 1)))
        let_go(samples)
    return slabs


def _with_samples(look: Look) -> Look:
    """Return a look with boxes, lines and pairs."""
    random, largest = np.random.default_rng(0), max(abs(look.low), abs(look.high))
    scale = 1.0 if ORDINARY[0] < largest < ORDINARY[1] else float(largest)
    boxes, lines, pairs = list[Floats](), list[Floats](), [list[Floats](), [], []]
    ends, count = np.zeros(2, np.int64), 0
    others: dict[float, int] = {}
    for planes, own in look.slabs:
        # beside the ends along the first axis nothing is known, even if there are more planes
        kind = np.float32 if planes.dtype in (np.float16, np.float32) else np.float64
        values = planes.astype(kind, copy=False)
        if not look.is_finite:
            values = np.where(np.isfinite(values), values, np.nan)
        padded = np.pad(values, 2, constant_values=np.nan)
        flat, step = padded.ravel(), np.array([padded[0].size, padded.shape[2], 1])
        base = 2 * int(step.sum())
        for places, offsets, most, found in (
            (_beside_surface(planes, own), BOX, BOXES, boxes),
            (_between_ends(planes, own, look), AXES, LINES, lines),
        ):
            some = _some(places, most // len(look.slabs), random)
            at = np.stack(np.unravel_index(some, planes.shape), 1) @ step + base
            found.append(flat.take(at[:, None] + offsets @ step).astype(np.float64))
        for axis in range(3):
            around = np.moveaxis(planes, axis, 0)
            one, other = around[:-1], around[1:]
            some = _some(np.flatnonzero(one != other), PAIRS // 3 // len(look.slabs), random)
            at = np.unravel_index(some, one.shape)
            pairs[axis].append(np.stack([one[at], other[at]]).astype(np.float64))
        inner, neighbours = equal_neighbours(Slab(planes, own))
        amid = inner[neighbours == 6]  # samples amid equal ones
        ends += [np.count_nonzero(amid == look.low), np.count_nonzero(amid == look.high)]
        count += inner.size
        rest = amid[(amid > look.low) & (amid < look.high)]
        for value, times in zip(*np.unique(rest, return_counts=True)):
            others[float(value)] = others.get(float(value), 0) + int(times)
    together = [np.concatenate(each, axis=1) / scale for each in pairs]
    return replace(
        look,
        scale=scale,
        boxes=(np.concatenate(boxes) / scale).reshape(-1, 5, 5, 5),
        lines=(np.concatenate(lines) / scale)[:, ON_LINES],
        pairs=[each[:, np.isfinite(each).all(0)] for each in together],
        at_ends=(ends[0] / count, ends[1] / count),
        common={x: n / count for x, n in others.items() if n > 0.01 * count},
    )


def _some(places: NDArray[np.intp], most: int, random: np.random.Generator) -> NDArray[np.intp]:
    """Return all places or, by chance, one in each of ``most`` parts of them."""
    if len(places) <= most:
        return places
    parts = np.arange(most) + random.random(most)
    return places[(parts * (len(places) / most)).astype(np.intp)]


def _beside_surface(planes: NDArray[Any], own: slice) -> NDArray[np.intp]:
    """Return the samples of the own planes (flat places) with another side beside them."""
    sides = (planes > 0).view(np.int8) - (planes < 0).view(np.int8)
    near = np.zeros(planes.shape, bool)
    known = None if planes.dtype.kind != "f" else ~np.isnan(planes)
    for axis in range(3):
        s, n = np.moveaxis(sides, axis, 0), np.moveaxis(near, axis, 0)
        crossing = s[1:] != s[:-1]
        if known is not None:
            k = np.moveaxis(known, axis, 0)
            crossing &= k[1:] & k[:-1]
        n[1:] |= crossing
        n[:-1] |= crossing
    near[: own.start] = near[own.stop :] = False
    return np.flatnonzero(near)


def _between_ends(planes: NDArray[Any], own: slice, look: Look) -> NDArray[np.intp]:
    inner = (planes > look.low) & (planes < look.high)
    inner[: own.start] = inner[own.stop :] = False
    return np.flatnonzero(inner)


def border_share(look: Look, is_marked: Callable[[NDArray[Any]], BoolArray]) -> float:
    """Return the share of the known samples on the border at which a function of them is true."""
    known = look.faces[np.isfinite(look.faces)]
    return float(is_marked(known).mean()) if known.size else 0.0


def typical_slope(look: Look, steps: Floats, cut: Sequence[float] = ()) -> float:
    """Return the median slope beside the surface, between samples that are not ``cut`` off.

    Along each axis it is the steeper one to both sides of a sample, if most are beside some that
    are cut off, else the mean. NaN if it is not known.
    """
    boxes = look.boxes[:, 1:4, 1:4, 1:4]
    lines = np.stack([boxes[:, :, 1, 1], boxes[:, 1, :, 1], boxes[:, 1, 1]], 1)
    lines = np.where(np.isin(lines, [x / look.scale for x in cut]), np.nan, lines)
    rise = np.diff(lines) / (steps[:, None] / look.scale)
    mean = np.sqrt((rise.mean(2) ** 2).sum(1))
    known = np.isfinite(mean) & (mean > 0)
    if known.sum() >= max(ENOUGH, len(lines) / 2) or not len(cut):
        return float(np.median(mean[known])) if known.any() else float("nan")
    steep = np.nan_to_num(np.abs(rise)).max(2)
    length = np.sqrt((steep**2).sum(1))[(steep > 0).all(1)]
    return float(np.median(length)) if len(length) else float("nan")


def different_values(samples: SampleArray) -> tuple[NDArray[Any], NDArray[np.int64]] | None:
    """Return the finite values of all planes and how often each is; None if they are many."""
    counts: dict[Any, int] = {}
    for plane in samples:
        flat = np.ravel(plane)
        if flat.dtype.kind == "f":
            flat = flat[np.isfinite(flat)]
        some = flat[:: max(flat.size // TRIED, 1)]
        if len(np.unique(some)) > MOST_LABELS:
            return None
        if flat.dtype.kind in "iu" and flat.dtype.itemsize == 1:
            many = np.bincount(flat.view(np.uint8), minlength=256)
            at = np.flatnonzero(many)
            found, times = at.astype(np.uint8).view(flat.dtype), many[at]
        else:  # the first sample of each run, and how long it is
            first = np.flatnonzero(np.append(flat.size > 0, flat[1:] != flat[:-1]))
            long = np.diff(np.append(first, flat.size))
            found, which = np.unique(flat[first], return_inverse=True)
            times = np.bincount(which, long).astype(np.int64)
        for value, number in zip(found.tolist(), times.tolist()):
            counts[value] = counts.get(value, 0) + number
        if len(counts) > MOST_LABELS:
            return None
    values = sorted(counts)
    kept = np.array(values, samples.dtype)
    return kept, np.array([counts[value] for value in values], np.int64)


def equal_neighbours(slab: Slab) -> tuple[NDArray[Any], NDArray[np.int8]]:
    """Return the samples of the own planes, and how many of their six neighbours equal them."""
    planes, own = slab
    equal: NDArray[np.int8] = np.zeros(planes.shape, np.int8)
    for axis in range(3):
        v, n = np.moveaxis(planes, axis, 0), np.moveaxis(equal, axis, 0)
        same = v[1:] == v[:-1]
        n[1:] += same
        n[:-1] += same
        n[0] += 1  # beyond the border the grid goes on
        n[-1] += 1
    return planes[own], equal[own]


def valleys(slab: Slab, slope: float, sign: int) -> tuple[int, int]:
    """Count valleys of slope, sign * values above 0, where 0 is near and the sign does not change.

    And the changes of sign of neighbours. Of one plane only those along it are counted.
    """
    planes, own = slab
    values: FloatArray = np.asarray(planes[own] * (sign / slope), np.float32)
    values[np.isinf(values)] = np.nan
    count = changes = 0
    for axis in range(3):
        v = np.moveaxis(values, axis, 0)
        changes += int(np.count_nonzero((v[1:] > 0) != (v[:-1] > 0)))
        before, x, after = v[:-2], v[1:-1], v[2:]
        low = (x >= 0) & (x < 0.52) & (before > x) & ((after > x) | ((after == x) & (x > 0.25)))
        count += int((low & (before + after - 2 * x > 0.9)).sum())
    return count, changes


# What a refusal names


def which_level(look: Look, *, signed: bool = False, shift: float = 0.0, unit: float = 1.0) -> str:
    """Return the advice to give a level: the one over which neighbours differ most.

    It is the shortest number among those that are about as good, and never a value of a sample.
    ``shift`` was taken from all values, which then were multiplied by ``unit``.
    """
    pairs = look.all_pairs * (look.scale / unit) + shift
    low, high = np.sort(pairs, axis=0)
    ends = np.quantile(pairs, [0.002, 0.998]).tolist()
    levels = np.linspace(ends[0], ends[1], LEVELS + 2)[1:-1]
    first, last = np.searchsorted(levels, [low, high])
    sums, counts = np.zeros((2, LEVELS + 1))
    for at, side in ((first, 1), (last, -1)):
        sums += side * np.bincount(at, high - low, LEVELS + 1)
        counts += side * np.bincount(at, None, LEVELS + 1)
    total = np.cumsum(counts)[:-1]
    steps = np.where(
        total >= max(LEAST, SHARE * total.max()), np.cumsum(sums)[:-1] / total.clip(1), 0
    )
    faces = np.sort(look.faces[np.isfinite(look.faces)]) / unit + shift
    share = np.searchsorted(faces, levels) / max(len(faces), 1)  # of the border, below a level
    middle = look.lines[:, 0, 2] * (look.scale / unit) + shift
    inner = np.array([np.mean(middle < level) for level in levels])
    # values that grow outwards: above are only the corners of the grid
    grows = (1 - share > GROWS * (1 - inner)) & (share > 0.5)
    if grows[steps.argmax()] and (all_above := share < 0.1).any():
        steps = np.where(all_above, steps, 0)
    good = levels[steps >= AS_GOOD * steps.max()]
    level = _short_number(good)
    values = np.unique(np.append(pairs, [x + shift for x in (look.low, look.high)]))
    if look.faces.dtype.kind in "iu":
        level = float(np.floor(level)) + 0.5
    at = int(np.searchsorted(values, level))
    if at < len(values) and values[at] == level:
        beside = values[at - 1] if at else values[at + 1]
        level = float(beside + values[at]) / 2
    outside = border_share(look, lambda x: x / unit > level - shift) > MOST_OUTSIDE
    option = f"--level {level:.6g} --inside {'negative' if outside else 'positive'}"
    other = " (or --field smooth, if it is at 0)" if signed else ""
    return f"they look like densities: give the level of their surface, such as {option}{other}"


def _short_number(good: Floats) -> float:
    middle = float(np.median(good))
    for digits in (1, 2, 3):
        short = float(f"{middle:.{digits}g}")
        if good.min() <= short <= good.max():
            return short
    return middle


def which_label(samples: SampleArray) -> str:
    """Return the advice to choose a label: the most frequent one that is not the border's."""
    found = different_values(samples)
    if found is None:
        return "they are labels: choose one with --label, or some with --labels"
    distinct, counts = found
    ends = np.concatenate([np.asarray(samples[i]).ravel() for i in (0, -1)])
    values, frequent = np.unique(ends, return_counts=True)
    at = np.flatnonzero(distinct != values[frequent.argmax()])
    best = distinct[at[counts[at].argmax()]] if len(at) else distinct[0]
    return (
        f"they look like labels ({named(distinct.tolist())}): choose one with "
        f"--label {round(best.item())}, or mesh all with --labels all"
    )


def named(labels: Any) -> str:
    """Return labels in words, the first eight in order."""
    ordered = sorted(labels)
    words = ", ".join(f"{x:g}" if x % 1 else str(int(x)) for x in ordered[:MOST_NAMED])
    return words + (", ..." if len(ordered) > MOST_NAMED else "")
