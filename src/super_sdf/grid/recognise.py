"""What the numbers of a grid are: questions in order, of which the first that answers ends it.

1. Are there two values? A mask.
2. Are they whole numbers in regions of equal ones? Labels.
3. Do they follow from the sides of the samples, as in a distance transform? A mask.
4. Does a value of many samples stand for unknown ones? It is left out.
5. Is the commonest slope that of nearly all smooth samples, and contradicts no sample two others?
   Distances, also if they are cut off so near that few slopes are left; the slope is the spacing
   in the unit of the values. Where parts touch inside, the field is smooth.
6. Is 0 no level of theirs: one side only, few different values, or most of them near 0? Densities,
   but for distances that were rounded, which are noisy.
7. Does noise explain all that contradicts distances of the given spacing? Noisy distances.
8. Everything else is smooth: the surface at 0 is that of its cubic spline.

Lengths are in spacings, values in the slope of a distance. A comment has each threshold's gap.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray
from .look import (
    BOX,
    NEARLY,
    Floats,
    Look,
    as_labels,
    border_share,
    count_valleys,
    different_values,
    equal_neighbours,
    last_digit,
    side_of_zeros,
    smooth_gradients,
    steps_by_axis,
    typical_slope,
    which_label,
    whole_factor,
)
from .samples import SampleArray

# 2. Labels: share of the samples off the background that equal 4 or more of their 6 neighbours; of
# neighbours that differ, how many by one rank.
PLATEAUS = 0.45  # whole images and integer distances to .43, labels from .55
BY_RANK = 0.99  # integer distances 1, labels to .97, but where one is in the other
AMID = 0.1  # of these the share that equal all 6: distances 0, labels inside others .3 and more
FEW_LABELS = 8  # different values: rounded distances and images from 11, lesions and organs to 8
# 3. Transforms: share of the samples beside the surface that equal others of their side, times the
# root of the number of axes that lead to the other side or not, with unequal spacings by axis.
# Values that do not jump over 0 need the steps of a mask: a share of these samples with other sides
# along two axes, and many patterns of signs, or many of all. Else faces are along the axes.
FOLLOW = 0.97  # distances to .94 (but where faces are along the axes), transforms 1
STAIRS = 0.2  # solids along the axes to .18, masks of others from .26
PATTERNS, OF_ALL = 100, 0.4  # such solids have to 96, or .38 of few; masks from 104, or .45
COUNTED = 0.98  # that are 1 where they are beside the other side: steps 1, rounded to .96
JUMPS = 1.2  # times the largest other step: transforms 2, distances 1
HALVES = 0.4  # of steps, unequal spacings: transforms from .49, boxes midway along an axis to .24
# 4. Unknown samples: steps to a frequent value over the steepest ones; how many of them jump.
JUMP = 1.5  # cut off 1.0, sentinels from 2
# 5. Distances: share of the smooth samples whose slope is the commonest one; share of the samples
# beside the surface that differ from two others by more than they are apart.
SLOPES = 0.95  # exact from .98; smooth unions to .83, saturating to .36, noise of .05 to .66
LEAST_SMOOTH = 0.014  # of all, unless cut off: lattices of whole periods to .009, bars from .021
CONTRADICTIONS = 0.003  # exact and cut off 0; noise of .05 voxel from .009; other slopes .02
EXACT = 0.02  # spacings, and share of a slope: the error of differences of exact distances
SAME_UNIT = 0.01  # from 1: exact to .002; saturating and smooth unions from .019
ANOTHER_UNIT = 0.03  # from 1: up to this, values are divided by their slope, with a note
MOST_DIGIT = 0.12  # spacings: the last digit of rounded distances
MATTERS = 3.0  # spacings: values farther from 0 may be anything
NARROW = 4.5  # spacings up to which values that are cut off have too few slopes to judge
NEVER = 5e-4  # contradictions of these: cut off 0, fused depth images from .0018
SLOPE_NEAR = 0.5, 1.25  # of these: cut off at half a voxel .55 to 1.05, in half the unit .5 and 2
SLOPE_OFF = 0.25  # of rounded distances from 1
SEAMS = 0.05  # valleys inside per crossing: single solids to .033, touching parts from .077
THICK = 0.012  # spacings: walls of unsigned distances have no thickness, a thin ring .025
STEEP = 0.25  # slopes to a wall and from it: with .02 to .8, unsigned and walls are told apart
# 6. Densities: range over the smallest step; median of the sizes over the largest, with more
# surface at 0 than at the level that parts them best; valleys per sample of a face. Distances may
# be rounded, to this part of the spacing.
ROUNDED = 1.0
IMAGE = 1 << 17  # 16 bits have 65,535, floats 1e6 and more; of few samples less, ...
NEAREST, WHOLE = 16, 0.15  # ... but their nearest values are no whole digits apart: images to .08
ALIKE = 0.05  # by which ends differ between which distances were cut off: .004, images .2 to 1
CENTRED = 0.13  # maps of density and statistics to .11, fields from .15
UNEVEN = 1.45  # quartiles of slopes at 0: lattices over their gradient to 1.31, maps from 1.66
# 7. Noise: contradictions left when noise of the size of fourth differences is allowed; smooth
# samples of all.
NOISE = 0.05  # uniform noise of .05 to .5 voxel and Gaussian to .033; logits .087, networks .096
MOST_NOISE = 1.0  # spacings: with more, distances beside the surface say nothing of it
NOISES = 2.5  # times its deviation, by which noise may make two samples differ
SPREAD = 0.34  # of fourth differences, lowest quarter over median: noise from .39, fused to .29
SMOOTH_SHARE = 0.06  # noise of .05 voxel to .03; fields of other slopes from .10
ENOUGH = 20  # samples from which a share is evidence

MIDDLE = 62  # of the samples in a box of 5 x 5 x 5
FACES = np.array([[4, 22], [10, 16], [12, 14]])  # of 3 x 3 x 3 samples, those beside the middle


@dataclass(frozen=True, eq=False)
class Answer:
    """One of six kinds, of which labels and densities need a choice, and why; or a refusal."""

    kind: str
    why: str = ""
    facts: dict[str, Any] = field(default_factory=dict)
    refusal: str = ""


@np.errstate(all="ignore")  # a value for unknown samples may be the largest number that there is
def recognise(
    samples: SampleArray, look: Look, given: Floats | None = None, hint: str = ""
) -> Answer:
    """Return what samples are; ``given`` is the spacing (3,), ``hint`` what a file says of them."""
    facts: dict[str, Any] = {"cut": look.cut}
    is_mask = look.is_two and hint != "labels"
    may_be_labels = not is_mask or (look.unknown and look.low > 0)  # such as 1 and 2 beside NaN
    may_be_labels = hint == "labels" or (not hint and may_be_labels)
    if may_be_labels and (answer := _labels(samples, look, hint, facts)) is not None:
        return answer
    if is_mask:
        return Answer("mask", "", facts)
    if not hint and (step := _step_of_transform(look, given)):
        return Answer("mask", "", facts | {"step": step, "zeros": side_of_zeros(look)})
    look = _without_sentinels(look, facts)
    if (answer := _distances(look, given, facts)) is not None:
        return answer
    if 0.0 in look.frequent and look.low < 0 < look.high:  # no surface fills a space
        known = facts | {"unknown_values": [0.0]}
        if (answer := _distances(look.without(0.0), given, known)) is not None:
            return answer
    if hint == "density" or look.is_one_sided:
        return Answer("density", "", facts)
    if (steps := _steps_of_cut(look, given, facts)) is not None:
        return Answer("distance", "", facts | {"spacing": steps})
    return _of_both_sides(look, given, facts)


# Questions 2 and 3: labels and masks


def _labels(samples: SampleArray, look: Look, hint: str, facts: dict[str, Any]) -> Answer | None:
    factor, found = whole_factor([look.pairs]), None
    if hint or (factor and not look.infinite):
        found = different_values(as_labels(samples))
    answer = Answer("labels", "", facts, which_label(found))
    if hint:
        return answer
    if found is None or not whole_factor([found[0]]):
        return None
    distinct, counts = found
    pairs, part = (np.rint(x / factor) for x in (look.pairs, look.part))
    ranks = np.abs(np.diff(np.searchsorted(distinct, pairs), axis=0))
    facts["by_rank"] = float((ranks == 1).mean())
    inner = ~np.isnan(part) & (part != distinct[counts.argmax()])
    if len(distinct) > 3:  # images are cut off at their ends
        inner &= (part != distinct[0]) & (part != distinct[-1])
    equal = equal_neighbours(part)[inner]
    amid, level = ((equal >= n).mean() if len(equal) else 1.0 for n in (6, 4))
    has_cores = amid >= AMID or look.is_one_sided  # distances to boxes have none
    are_few = len(distinct) <= FEW_LABELS and look.low >= 0
    are_labels = are_few or (level >= PLATEAUS and has_cores)
    if len(distinct) > 3 and facts["by_rank"] >= BY_RANK:
        are_labels = amid >= AMID
    return answer if are_labels else None


def _step_of_transform(look: Look, given: Floats | None) -> float:
    """Return the typical size beside the surface of values that follow from their sides, else 0.

    Samples are equal wherever the other side is beside them along as many axes; of most transforms
    they all have one size. So have distances to faces along the axes, which differ by their steps.
    """
    fine = np.ones(3, bool) if given is None else given < 1.01 * given.min()
    around, middle = look.boxes[:, 1:4, 1:4, 1:4].reshape(-1, 27), look.boxes[:, 2, 2, 2]
    cut = [value for value in look.cut if value]
    known = np.isfinite(around).all(1) & (middle != 0)
    best, step, is_stepped = (FOLLOW, 0), 0.0, False
    for sign in (1, -1):  # 0 may be on either side
        sides = sign * around > 0
        over = (sides != sides[:, 13:14])[:, FACES].any(2)  # which axes lead to the other side
        axes = over[:, fine].sum(1)
        beside = known & (axes > 0)
        free = beside & ~np.isin(middle, cut)
        if free.sum() < max(ENOUGH, beside.sum() / 2):
            continue
        x, patterns = middle[free], np.packbits(sides[free], axis=1)
        typical = float(np.quantile(np.abs(x), 0.5))
        by_axis = over[free] & ~fine.all()
        share = max(_share_alike(x * y, by_axis, x > 0) for y in (1.0, np.sqrt(axes[free])))
        if (share, len(x)) > best:
            best, step = (share, len(x)), typical
            is_stepped = (axes[free] > 1).mean() > STAIRS and len(cut) < 2
            is_stepped &= len(np.unique(patterns, axis=0)) >= min(PATTERNS, OF_ALL * len(x))
    if not (step and (is_stepped or _jump_over_0(look, FOLLOW if fine.all() else HALVES))):
        return 0.0
    whole = look.pairs / np.abs(look.pairs[look.pairs != 0]).min()
    is_whole = fine.all() and (np.abs(whole - np.rint(whole)) <= NEARLY).all()
    return 0.0 if is_whole and not _counts_steps(look.boxes / step) else step


def _share_alike(values: Floats, *keys: BoolArray) -> float:
    """Return the share of equal values among those with the same keys, (n,) or (n, k)."""
    which = np.unique(np.column_stack(keys), axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(which, kind="stable")
    same = np.diff(which[order]) == 0
    alike = np.abs(np.diff(values[order])[same]) <= 0.01 * np.quantile(np.abs(values), 0.5)
    return float(alike.mean()) if len(alike) >= ENOUGH else 0.0


def _counts_steps(boxes: Floats) -> bool:
    """Return whether whole numbers in boxes (n, 5, 5, 5) count steps to the other side.

    Then they are 1 wherever a sample of that is beside them, by faces alone or edges and corners.
    """
    from scipy import ndimage

    shares = list[float]()
    for rank in (1, 3):
        steps, alike = ndimage.generate_binary_structure(3, rank)[None], list[BoolArray]()
        for side in (boxes, -boxes):
            is_one = ndimage.binary_dilation(side < 0.5, steps)[:, 1:4, 1:4, 1:4]
            middle = side[:, 1:4, 1:4, 1:4]
            alike.append(((middle < 1.5) == is_one)[middle > 0.5])
        shares.append(float(np.concatenate(alike).mean()))
    return max(shares) >= COUNTED


def _jump_over_0(look: Look, halves: float) -> bool:
    """Return whether all steps over 0 are larger than others, and a share of them has 0 midway."""
    one, other = look.pairs
    size, over = np.abs(one - other), (one > 0) != (other > 0)
    if over.sum() <= ENOUGH or size[over].min() <= JUMPS * size[~over].max(initial=0):
        return False
    return bool((np.abs(one + other) <= NEARLY * size)[over].mean() >= halves)


# Question 4: unknown samples


def _without_sentinels(look: Look, facts: dict[str, Any]) -> Look:
    """Return a look without values of many samples to which the others jump, if there are some."""
    if not look.low < 0 < look.high:
        return look
    change = np.abs(look.pairs[0] - look.pairs[1])
    is_frequent, found = np.isin(look.pairs, list(look.frequent)), []
    if np.count_nonzero(~is_frequent.any(0)) < ENOUGH:
        return look
    for value in look.frequent:
        at = (look.pairs == value).any(0)
        steps = change[at & ~is_frequent.all(0)]
        steps = steps if len(steps) else change[at]  # only beside samples that are cut off
        if len(steps) and (steps > JUMP * np.quantile(change[~at], 0.99)).mean() > 0.5:
            found.append(value)
    # far inside and far outside, a value may stand for "unknown" with either sign
    found += [x for x in (look.low, look.high) if -x in found and x not in found]
    if not found:
        return look
    for value in found:
        look = look.without(value)
    facts |= {"unknown_values": found, "cut": look.cut}
    return look


# Question 5: distances


def _distances(look: Look, given: Floats | None, facts: dict[str, Any]) -> Answer | None:
    """Return distances, or why they are none to a surface in the grid; None if they are none."""
    facts["digit"] = last_digit(look)
    unit = _find_unit(np.where(np.isin(look.lines, look.cut), np.nan, look.lines), given, facts)
    ends_at_0 = look.is_one_sided and (look.low if look.low >= 0 else look.high) in look.cut
    are_few = facts["smooth"] < LEAST_SMOOTH and not look.cut
    if unit is None or facts["slopes"] < SLOPES or are_few or ends_at_0:
        return None
    steps = unit * (np.ones(3) if given is None else given)
    facts["contradictions"] = _contradictions(look, steps, facts["digit"])
    return _in_unit(look, unit, given, facts) if facts["contradictions"] <= CONTRADICTIONS else None


def _find_unit(inner: Floats, given: Floats | None, facts: dict[str, Any]) -> Any:
    """Return the commonest slope, per sample or spacing, by axis if they differ, or None."""
    gradients, fourth = smooth_gradients(inner)
    facts["smooth"] = len(gradients) / max(len(inner), 1)
    facts["slopes"] = 0.0
    if len(gradients) < ENOUGH:
        return None
    h = 1.0 if given is None else float(given.max())
    gradients = gradients if given is None else gradients / given
    slope = np.sort(np.sqrt((gradients**2).sum(1)))
    third = max(len(slope) // 3, 1)  # the narrowest range that holds a third of them
    at = int(np.argmin(slope[third:] / slope[:-third]))
    facts["unit"] = unit = float(np.quantile(slope[at : at + third + 1], 0.5))
    facts["error"] = SAME_UNIT if fourth >= ENOUGH else 3 * SAME_UNIT
    error = EXACT + min(facts["digit"] / unit / h, MOST_DIGIT) / 2
    facts["slopes"] = float((np.abs(slope / unit - 1) < error).mean())
    if facts["slopes"] < SLOPES and len(gradients) > 5 * ENOUGH:
        axes = steps_by_axis(gradients)
        share = float((np.abs(np.sqrt(((gradients / axes) ** 2).sum(1)) - 1) < EXACT).mean())
        if share >= SLOPES:
            facts["slopes"] = share
            return axes
    return unit


def _contradictions(look: Look, steps: Floats, digit: float, noise: float = 0.0) -> float:
    """Return the share of samples beside the surface that two others contradict as distances."""
    if not len(look.boxes):
        return 0.0
    h = float(steps.max())
    boxes = look.boxes.reshape(len(look.boxes), -1) / h
    apart = np.sqrt(((BOX * steps / h) ** 2).sum(1))
    allowed = max(EXACT, min(digit / h, MOST_DIGIT), NOISES * noise)
    beyond = np.abs(boxes - boxes[:, MIDDLE, None]) > apart + allowed
    beyond &= np.abs(boxes) < MATTERS
    return float((np.count_nonzero(beyond, axis=1) >= 2).mean())


def _in_unit(look: Look, unit: Any, given: Floats | None, facts: dict[str, Any]) -> Answer:
    """Return distances with a unit, that of one axis or each, or why they are none to a surface."""
    steps = np.ones(3) * unit if given is None else given
    facts["spacing"] = steps
    if given is not None and np.ndim(unit):
        shown = ",".join(f"{x:.4g}" for x in given * unit)
        said = f"the values show another spacing along each axis: --spacing {shown}"
        return Answer("distance", "", facts, said)
    off = 0.0 if given is None else abs(float(unit) - 1)
    if off > ANOTHER_UNIT:
        shown = ",".join(f"{x:.4g}" for x in np.unique(steps) * unit)
        said = (
            "the distances have another unit than the spacing: multiply the values, --scale "
            f"{1 / unit:.4g} (or the spacing is wrong: the values show {shown})"
        )
        return Answer("distance", "", facts, said)
    if off > facts["error"]:
        facts["slope"] = float(unit)
    if look.is_one_sided:
        return _of_one_sign(look, steps, facts)
    outside = -1 if border_share(look, lambda x: x < 0) > 0.5 else 1  # also if none is known
    found, changes = count_valleys(look, float(steps.min()), -outside)
    facts["seams"] = found / max(changes, 1)
    if facts["seams"] > SEAMS:
        why = "distances to parts that touch or overlap, with faces of these inside"
        return Answer("smooth", why, facts | {"inside": -outside})
    return Answer("distance", "", facts)


def _of_one_sign(look: Look, steps: Floats, facts: dict[str, Any]) -> Answer:
    """Return distances to walls thinner than the spacing, or that unsigned ones have no inside.

    Along a line of samples the field falls towards a wall and rises behind it. What the distances
    on either side leave of the way between two samples is how thick it is.
    """
    thickness = list[NDArray[Any]]()
    for axis in range(3):
        lines = np.abs(np.moveaxis(look.part, axis, 0)) / steps[axis]
        before, left, right, after = (lines[i : len(lines) - 3 + i] for i in range(4))
        falling, rising = before - left, after - right
        left_over = (falling + rising) / 2 - left - right
        thickness.append(left_over[(np.minimum(falling, rising) > STEEP) & (left_over > -STEEP)])
    walls = np.concatenate(thickness)
    if len(walls) and np.median(walls) > THICK:
        return Answer("distance", "", facts)
    option = f"--inside {'negative' if look.low >= 0 else 'positive'} --offset {steps.max():.4g}"
    said = f"unsigned distances have no inside: mesh the shell round the surface with {option}"
    return Answer("distance", "", facts, said)


def _steps_of_cut(look: Look, given: Floats | None, facts: dict[str, Any]) -> Floats | None:
    """Return the steps of distances cut off, or unknown, so near that few slopes are left."""
    unit = facts.get("unit") or typical_slope(look, np.ones(3), look.cut)
    steps = np.full(3, unit) if given is None else given
    known = max(-look.low, look.high) if look.unknown or "unknown_values" in facts else np.inf
    nearest = min(map(abs, look.cut), default=known)
    if nearest >= NARROW * steps.max():
        return None
    is_even = SLOPE_NEAR[0] < typical_slope(look, steps, look.cut) < SLOPE_NEAR[1]
    return steps if is_even and _contradictions(look, steps, facts["digit"]) <= NEVER else None


# Questions 6 to 8: densities, noise, smooth fields


def _of_both_sides(look: Look, given: Floats | None, facts: dict[str, Any]) -> Answer:
    values = np.unique(np.append(look.pairs, look.boxes[:, 2, 2, 2]))
    values = values[np.isfinite(values)]
    gaps = np.diff(values)
    gaps = gaps[gaps < NEAREST * (digit := float(gaps.min()))] / digit
    if np.ptp(values) < IMAGE * digit and np.abs(gaps - np.rint(gaps)).max() < WHOLE:
        steps = _before_rounding(look, digit, given, facts)
        if steps is not None and given is not None and steps is not given:
            return _in_unit(look, float(steps[0] / given[0]), given, facts)
        if steps is not None:
            facts["noise"] = digit / float(steps.max()) / 12**0.5  # standard deviation
            why = f"distances rounded to {digit:.3g}"
            return Answer("noisy", why, facts | {"spacing": steps})
        if not look.cut or abs(look.low + look.high) >= ALIKE * look.high:
            return Answer("density", "", facts)
    middle = look.lines[np.isfinite(look.lines[:, 0, 2]), 0, 2]
    if len(middle) >= ENOUGH:
        size = np.abs(middle)
        facts["centred"] = float(np.median(size) / np.quantile(size, 0.995))
        rise = np.diff(look.box_lines[..., 1:4]).mean(2)
        slopes = np.sort(np.sqrt((rise**2).sum(1)))
        quarter = np.isfinite(slopes).sum() // 4
        facts["uneven"] = float(slopes[3 * quarter] / slopes[quarter])
        if facts["centred"] < CENTRED and facts["uneven"] > UNEVEN:
            return Answer("density", "", facts)
    if given is not None and _is_noise(look, given, facts):
        return Answer("noisy", "distances with noise", facts | {"spacing": given})
    return Answer("smooth", "the slope is not that of a distance everywhere", facts)


def _before_rounding(
    look: Look, digit: float, given: Floats | None, facts: dict[str, Any]
) -> Floats | None:
    """Return the steps of distances that were rounded to a digit; None if these are none."""
    steps = np.ones(3) if given is None else given
    if facts.get("by_rank", 0) >= BY_RANK and abs(steps.max() - 1) < SLOPE_OFF:
        return steps  # whole numbers, of neighbours one apart
    rise = (look.lines[..., 4] - look.lines[..., 0]) / (4 * steps)
    slopes = np.sort(np.append(np.sqrt((rise**2).sum(1)), np.nan))  # thin stacks have no others
    slope = float(slopes[np.isfinite(slopes).sum() // 2])
    is_off = not abs(slope - 1) < SLOPE_OFF  # in another unit, if they are
    steps = steps * slope if given is None or is_off else steps
    least = MOST_DIGIT if given is not None and is_off else 0.0  # images have finer digits
    if not least < digit / steps.max() <= ROUNDED:
        return None
    # both of two values may be half a digit off
    off = _contradictions(look, steps, 0.0, noise=1.01 * digit / steps.max() / NOISES)
    return steps if off <= CONTRADICTIONS else None


def _is_noise(look: Look, steps: Floats, facts: dict[str, Any]) -> bool:
    """Return whether noise as large as fourth differences show explains what contradicts."""
    fourth = np.abs(np.diff(look.box_lines, 4, axis=-1)[..., 0])
    fourth = fourth[np.isfinite(fourth)]
    if len(fourth) < 5 * ENOUGH or facts["smooth"] > SMOOTH_SHARE:
        return False
    # a quarter of the differences of normal noise is below .3186 sqrt(70) of its deviation
    quarter = float(np.quantile(fourth, 0.25))
    facts["noise"] = noise = quarter / 0.3186 / 70**0.5 / float(steps.max())
    if quarter < SPREAD * np.median(fourth) or noise > MOST_NOISE:
        return False
    without, allowed = (_contradictions(look, steps, facts["digit"], x) for x in (0.0, noise))
    return without > CONTRADICTIONS and allowed <= NOISE
