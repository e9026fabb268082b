"""What the values of a grid are, what the method may do with them, and the evidence for it.

exact      distances
truncated  distances that are cut off near the surface
mask       inside or outside, nothing else
scaled     a field of another slope than 1: another unit, or no distance at all
noisy      distances with noise

A distance field has slope 1 wherever it is smooth, in units of the spacing. It is bent only where
its third and fourth differences show it: at a kink between samples, or where it is curved. So a
slope that is off by more than these can explain belongs to a field that is no distance. So do
samples that differ by more than they are apart, along diagonals too, and by more than noise of the
size that fourth differences show: fast marching and other schemes make such fields. A truncated
field is constant away from the surface. A noisy one changes by more than the samples are apart.

The values of a distance transform of a mask follow from the sides of the samples: each is the
distance to the nearest sample of another side, in the world or on the lattice, by whatever measure,
perhaps squared, less half a voxel or a whole one, or clipped. Exact distances do not, as they know
where between two samples the surface is, unless all faces of the solid are on samples, which are 0
there. Then the surface of a mask shows by its steps: one sample high wherever it is not along the
axes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, permutations, product
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, Triple
from ..options import EXACT, Options
from .census import BESIDE, ENOUGH, LARGEST_VALUE, MOST_BENT, Census, Extremes, Floats, Looked
from .samples import SampleArray, changed, check_spacing, is_cubic, steps_of

NONE_EXACT: Extremes = (0.0, 0.0)

# Slopes whose fourth differences are this small are known: of exact distances half of them are 1.
# Where two kinks make them so, a third difference is half of the slope or more.
KNOWN, KINKED = 0.2, 0.45
UNEVEN = 0.025  # by which they differ near the surface and farther away if the field is no distance
# Two samples of a distance differ by no more than they are apart. In other fields this share of the
# samples differ from several by more: by this, by more than noise, and than their last digit.
CONTRADICTING, SEVERAL, APART, BY_NOISE = 0.05, 2, 0.02, 2.5
MATTERS = 3.0  # spacings from the surface, beyond which values may be anything
# A slope may be off by the third and fourth differences, and by this.
ROUNDING = 0.015
# Share of slopes that are off from which the field is no distance: where it is smooth enough for a
# typical slope, and where it is not.
WRONG_SLOPES, WRONG_IF_ROUGH = 0.01, 0.05
LIPSCHITZ, BENT, NOISY_SHARE = 1.05, 0.3, 0.02  # change, difference and share of noisy values
LEAST_SAMPLES = 100  # from which shares are evidence
# Noise makes values change by more than distances can at a share of the samples that grows with its
# standard deviation: up to 2.6 per spacing were measured, up to 4 on planes along the axes. It
# hardly makes a slope wrong that is known.
MOST_BY_NOISE = 3.0
MOST_DIGIT = 0.1  # spacings, of rounded values
OFF = 0.012  # from 1: typical slopes further off show another unit
SLOPE_OFF = 0.25  # from 1: truncated distances have another unit
# Ends of values that were divided by the truncation; where the rest is unknown, the last known
# samples are a little nearer to 0.
ENDS_ALIKE = 0.05
# Of truncated distances the steepest slopes where they are straight are hardly more than the
# typical one: up to 1.06 were measured. Along lines of sight they differ with the angle to the
# surface: 1.08 and more were.
STEEPEST, MOST_STEEP, FEW = 0.95, 1.07, 10

# Of distance transforms.
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


@dataclass(frozen=True, eq=False)
class Field:
    """The kind of a field, one of ``FIELDS`` but "auto", and what follows from it."""

    kind: str = EXACT
    given: bool = False  # whether the user said so; otherwise the samples show it
    # Only samples between these, in world units, negative inside, may be exact distances.
    exact: Extremes = (-np.inf, np.inf)
    smooth: SampleArray | None = None  # values whose spline has the surface, negative inside
    has_kinks: bool = False  # whether it is mostly a distance, of which a network refines kinks
    is_uneven: bool = False  # whether its slope jumps, as that of fused depth images
    # Whether the values are distances on the lattice of the samples, in steps of the finest
    # spacing, and not in the world. Then no axis is resampled if the spacings differ.
    on_lattice: bool = False
    evidence: dict[str, Any] = field(default_factory=dict)  # what the samples show, for ``--json``
    unseen: SampleArray | None = None  # which may hide the surface: it ends there, and stays open
    why_open: str = ""  # a sentence on them

    @property
    def has_exact(self) -> bool:
        """Whether some samples may be exact distances."""
        return self.exact[0] < self.exact[1]

    def report(self) -> dict[str, Any]:
        """Return kind and evidence as a dictionary that can be written as JSON."""
        return {"kind": self.kind, "given": self.given, **self.evidence}


@dataclass(frozen=True, eq=False)
class Case:
    """Samples, what they show, what the user says of them, and sentences on what is inferred.

    What is near unknown samples may be continued, which shows nothing: see ``census``. The spacing
    is None if it is unknown.
    """

    samples: SampleArray
    census: Census
    wanted: Options
    spacing: Triple | None
    notes: list[str]

    @property
    def is_density(self) -> bool:
        """Whether the values are densities, from which a level was taken."""
        return self.wanted.level is not None

    def with_spacing(self, spacing: float, why: str) -> Triple:
        """Return the spacing that is given, else one that is taken, and why in a note."""
        if self.spacing is not None:
            return self.spacing
        self.notes.append(f"spacing not given: taken as {spacing:.6g}, {why}")
        return check_spacing(spacing)


@dataclass(frozen=True, eq=False)
class Interpreted:
    """Distances near the surface with their extremes, and how they are to be used."""

    samples: SampleArray
    extremes: Extremes
    spacing: Triple
    positive_inside: bool
    field: Field

    def with_field(self, **changes: Any) -> Interpreted:
        """Return the same with some attributes of the field changed."""
        return replace(self, field=replace(self.field, **changes))

    def divided(self, slope: float) -> Interpreted:
        """Return values divided by a slope."""
        low, high = self.extremes
        samples = changed(self.samples, lambda values: values / slope)
        return replace(self, samples=samples, extremes=(low / slope, high / slope))


class Evidence(NamedTuple):
    """What the samples beside the surface show; lengths are in spacings."""

    samples: int  # that were looked at
    slope: float  # typical change from sample to sample; NaN if too few samples are straight
    # Shares of the samples at which the slope cannot be that of a distance, whatever its unit; that
    # differ from others by more than distances and noise can; and that change by more than
    # distances can.
    wrong: float
    contradicting: float
    noisy: float
    uneven: float  # difference of the slopes far from and near the surface, over the typical one
    roughness: float  # standard deviation of the noise, if the fourth differences were all noise
    cut_low: bool  # whether values are cut off at the lowest
    cut_high: bool
    digit: float  # the last one of the values: slopes are known no better

    @property
    def is_cut(self) -> bool:
        """Whether values are cut off."""
        return self.cut_low or self.cut_high

    def uncut(self, extremes: Extremes) -> Extremes:
        """Return between which values none is cut off."""
        low, high = extremes
        return (low if self.cut_low else -np.inf), (high if self.cut_high else np.inf)

    @property
    def is_scaled(self) -> bool:
        """Whether the values are no distances in the unit of the spacing."""
        return self.is_bent or abs(self.slope - 1) > max(OFF, self.roughness, self.digit)

    @property
    def is_bent(self) -> bool:
        """Whether the slope differs from place to place, so that no unit makes distances of it."""
        allowed = WRONG_SLOPES if np.isfinite(self.slope) else WRONG_IF_ROUGH
        uneven = abs(self.uneven) > max(UNEVEN, self.roughness, self.digit)
        is_wrong = self.wrong > allowed or uneven
        return self.is_enough and (is_wrong or self.is_contradictory)

    @property
    def is_contradictory(self) -> bool:
        """Whether samples differ by more than distances can, at more than noise explains."""
        steep = self.noisy > max(NOISY_SHARE, MOST_BY_NOISE * self.roughness)
        contradicting = self.contradicting > CONTRADICTING and self.noisy <= NOISY_SHARE
        return (steep and self.wrong > WRONG_SLOPES) or contradicting

    @property
    def is_noisy(self) -> bool:
        """Whether the values are noisy: noise makes slopes wrong, but no more than it is seen."""
        return self.is_enough and self.noisy > NOISY_SHARE and not self.is_bent

    @property
    def is_enough(self) -> bool:
        """Whether there are enough samples for shares of them to be evidence."""
        return self.samples >= LEAST_SAMPLES

    def report(self) -> dict[str, Any]:
        """Return the evidence as a dictionary that can be written as JSON."""
        names = ("slope", "wrong", "uneven", "contradicting", "noisy", "roughness")
        shares = {name: float(getattr(self, name)) for name in names}
        known = {name: round(x, 4) if np.isfinite(x) else None for name, x in shares.items()}
        known = {"wrong_slopes" if name == "wrong" else name: x for name, x in known.items()}
        return {"samples": self.samples, **known, "cut_off": [self.cut_low, self.cut_high]}


def weigh(looked: Looked, spacing: Triple) -> Evidence:
    """Return the evidence of what was looked at, with the spacing of each axis."""
    is_cut, steps = looked.is_cut, np.array(steps_of(spacing))
    lines = looked.lines
    whole = _are_whole(lines, looked)
    around = looked.around[whole]
    lines = np.clip(lines[whole] / steps[:, None], -LARGEST_VALUE, LARGEST_VALUE)
    a, b, c, d, e = np.moveaxis(lines, -1, 0)
    second, third = np.abs(d - 2 * c + b), np.abs((e - 2 * d + 2 * b - a) / 2)
    fourth = np.abs(e - 4 * d + 6 * c - 4 * b + a)
    typical, uneven = _known_slopes(lines, third, fourth)
    unit = typical if np.isfinite(typical) else 1.0
    slope = np.sqrt((((d - b) / 2) ** 2).sum(1))
    wrong = np.abs(slope / unit - 1) > (third + fourth).sum(1) / 2 / unit + ROUNDING
    apart = np.abs(np.diff(lines[..., 1:4], axis=-1)).max((1, 2), initial=0)
    noisy = (apart > LIPSCHITZ * unit) & (second.max(1, initial=0) > BENT * unit)
    h, rough, noise = max(steps), 0.0, 0.0
    if len(fourth):  # of noise, their standard deviation is sqrt(70) times its own
        rough = float(np.median(fourth.ravel())) / 70**0.5 / 0.6745
        noise = float(np.quantile(fourth, 0.25)) / 70**0.5 / 0.3186
    contradicting = _contradict(around / (h * unit), steps / h, noise / unit)
    off, beyond, steep = (float(x.mean()) if len(x) else 0.0 for x in (wrong, contradicting, noisy))
    least = float(np.diff(np.unique(lines)).min(initial=np.inf))
    digit = least if least < MOST_DIGIT else 0.0  # by so much no rounded values differ
    cut = bool(is_cut[0]), bool(is_cut[1])
    return Evidence(len(lines), typical, off, beyond, steep, uneven, rough, *cut, digit)


def _known_slopes(lines: Floats, third: Floats, fourth: Floats) -> tuple[float, float]:
    """Return the typical slope of lines (n, 3, 5), NaN if few tell, and how it changes farther off.

    Slopes are known where third and fourth differences (n, 3) are small: no kink is near.
    """
    a, b, middle, d, e = np.moveaxis(lines, -1, 0)
    slope = np.sqrt((((8 * (d - b) - (e - a)) / 12) ** 2).sum(1))
    known = (fourth.sum(1) < KNOWN * slope) & (third.max(1, initial=0) < KINKED * slope)
    slope, far = slope[known], np.abs(middle[known, 0])
    if len(slope) < ENOUGH:
        return float("nan"), 0.0
    near = far <= float(np.median(far))
    typical = float(np.median(slope))
    beyond = float(np.median(slope[~near])) if not near.all() else typical
    return typical, (beyond - float(np.median(slope[near]))) / typical


def _contradict(around: Floats, steps: Floats, noise: float) -> BoolArray:
    """Return which samples (n,) differ from several round them by more than distances can.

    Lengths are in the largest spacing; ``noise`` is a standard deviation.
    """
    matters = MATTERS * min(steps)
    boxes = np.clip(around.reshape(len(around), 5**3), -matters, matters)
    middle = boxes[:, 5**3 // 2]
    digits = np.diff(np.unique(middle.astype(np.float32)))
    digit = float(np.median(digits)) if len(digits) else 0.0
    places = np.indices((5,) * 3).reshape(3, -1).T - BESIDE
    beyond = np.abs(boxes - middle[:, None]) - np.linalg.norm(places * steps, axis=1)
    allowed = max(APART, BY_NOISE * noise, digit * (1 + ROUNDING))
    return np.asarray((beyond > allowed).sum(1) >= SEVERAL)


def slope_within(looked: Looked, spacing: Triple) -> float:
    """Return the typical slope between samples none of which is cut off; NaN if too few tell.

    Of the pairs beside the surface, the steepest along an axis gives the slope; samples that do not
    change along all axes may all be at corners.
    """
    low, high = looked.extremes
    line = looked.lines[..., 1:4]
    free = (line > low) & (line < high)
    change = np.where(free[..., 1:] & free[..., :-1], np.abs(np.diff(line)), 0).max(-1)
    known = (change > 0).all(1)
    lengths = np.sqrt(((change[known] / np.array(steps_of(spacing))) ** 2).sum(1))
    return float(np.median(lengths)) if len(lengths) >= ENOUGH else float("nan")


def is_projective(looked: Looked, spacing: Triple) -> bool:
    """Return whether values that are cut off were measured along lines of sight.

    Beside the surface the slope of fused depth images is that of a distance only where it was seen
    straight on, whatever their unit.
    """
    if not looked.is_cut.any():
        return False
    lines = looked.lines[..., 1:4]
    low, middle, high = np.moveaxis(lines[_are_whole(lines, looked)], -1, 0)
    steps = np.array(steps_of(spacing))
    slope = np.sqrt((((high - low) / steps / 2) ** 2).sum(1))
    bend = (np.abs(high - 2 * middle + low) / steps).sum(1)
    straight = slope[bend < MOST_BENT * slope]
    steep = float(np.quantile(straight, STEEPEST)) if len(straight) >= FEW else 0.0
    return steep > 0 and steep > MOST_STEEP * float(np.median(straight))


def _are_whole(lines: Floats, looked: Looked) -> BoolArray:
    ends = zip(looked.extremes, looked.is_cut, (-1, 1))
    low, high = (end if is_cut else sign * np.inf for end, is_cut, sign in ends)
    return np.asarray(((lines > low) & (lines < high)).all((1, 2)))


def is_normalised(looked: Looked, spacing: Triple) -> bool:
    """Return whether values are cut off at -T and T, or at 1, and their slope is not 1.

    So are distances that were divided by the truncation, as many programs store them.
    """
    ends = [abs(end) for end, is_cut in zip(looked.extremes, looked.is_cut) if is_cut]
    alike = len(ends) == 2 and bool(np.isclose(ends[0], ends[-1], rtol=ENDS_ALIKE))
    at_one = bool(ends) and bool(np.allclose(ends, 1, rtol=ENDS_ALIKE))
    return (alike or at_one) and abs(slope_within(looked, spacing) - 1) > SLOPE_OFF


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
    for measure, step in chain.from_iterable(_measures(steps, unit)):
        if _follow(patches, sides, measure, (0, 0), clipped):
            return Transform(step, 0)
    for measure, step in _measures(steps, 2 * unit)[0]:
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
    euclidean, squares, others = _measures(steps, unit)
    for measure, step in (*euclidean, *squares, *(others if one_sided else [])):
        seen = _follow(patches, signs, measure, (0, 0), clipped)
        if seen and one_sided and is_flat and not seen.apart:
            return None
        if seen and (seen.beyond or (measure, step) in euclidean):
            is_mask = _are_lone(signs == 0).sum() >= LEAST or _is_stepped(signs)
            zeros = side if one_sided else _side_of_zeros(signs)
            return Transform(step, zeros) if is_mask else None
    joined = np.where(signs == 0, side, signs)
    for measure, step in euclidean:
        seen = _follow(patches, joined, measure, (side < 0, side > 0), clipped)
        if seen and seen.apart:
            return Transform(step, side)
    return None


def _measures(steps: Floats, unit: float) -> list[list[tuple[Measure, float]]]:
    """Return measures and the spacings that they show: Euclidean ones, their squares, others.

    Those are Euclidean in the world and on the lattice; the others chessboard, city-block, 3-4-5.
    """
    euclidean = [partial(_length, steps)]
    euclidean += [partial(_length, np.ones(3))] if steps.max() > 1 + ZERO else []
    squares = [partial(_length, each.args[0], power=2) for each in euclidean]
    others = [(partial(_weighted, weight), unit) for weight in (0.0, 1.0)]
    return [
        [(measure, unit) for measure in euclidean],
        [(measure, unit**0.5) for measure in squares],
        [*others, (partial(_weighted, 1 / 3), unit / 3)],
    ]


def _length(steps: Floats, offsets: NDArray[np.int64], power: int = 1) -> Floats:
    lengths: Floats = np.linalg.norm(offsets * steps, axis=1) ** power
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


def _are_lone(marked: BoolArray) -> BoolArray:
    """Return round which inner samples all are marked."""
    windows = np.lib.stride_tricks.sliding_window_view(marked, (3, 3, 3), axis=(1, 2, 3))
    return np.asarray(windows.all((-3, -2, -1)))


def _is_stepped(sides: Floats) -> bool:
    """Return whether the surface, where samples are 0, has the steps of a mask.

    Beside a step, a sample is next to zeros along two axes, of which one does not go on. Stairs go
    up one way, or two that are not opposite; what is curved or turned has steps the other way, too.
    """
    centre = sides[:, BESIDE, BESIDE, BESIDE]
    near = (sides == 0)[:, INNER, INNER, INNER]
    zero = np.concatenate([near[centre > 0], near[centre < 0][:, ::-1, ::-1, ::-1]])
    ways = [*np.eye(3, dtype=int), *-np.eye(3, dtype=int)]
    next_to = [zero[(..., *(1 + way))] for way in ways]
    stepped, counts = np.zeros(len(zero), bool), np.zeros((6, 6), int)
    for i, j in permutations(range(6), 2):
        if i % 3 != j % 3:
            one, other = ((..., *(1 + way)) for way in (ways[i] - ways[j], ways[j] - ways[i]))
            goes_on = zero[one] & zero[other]
            steps = next_to[i] & next_to[j] & ~goes_on
            stepped |= steps
            counts[i, j] = steps.sum()
    share = stepped.sum() / max(np.any(next_to, 0).sum(), LEAST)
    both_ways = np.minimum(counts, np.roll(counts, (3, 3), (0, 1)))
    return bool(share > STEPPED and both_ways.any())


def _side_of_zeros(sides: Floats) -> int:
    """Return the sign of the side that zeros border, with no neighbour there; 0 if unclear."""
    zero = sides[:, INNER, INNER, INNER] == 0
    lone = [int((_are_lone(sides != sign) & zero).sum()) for sign in (-1, 1)]
    return int(np.sign(lone[1] - lone[0]))
