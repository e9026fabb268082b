"""What the numbers of a grid are: questions in order, of which the first that answers ends it.

1. Are there two values? A mask.
2. Are they whole numbers in regions of equal ones? Labels.
3. Do they follow from the sides of the samples, as in a distance transform? A mask.
4. Does a value of many samples stand for unknown ones? It is left out.
5. Is the commonest slope that of nearly all smooth samples, and contradicts no sample two others?
   Distances; the slope is the spacing in the unit of the values. Where parts touch inside, the
   field is smooth.
6. Is all that contradicts distances explained by noise? Noisy distances.
7. Is 0 no level of theirs: one side only, few different values, or most of them near 0? Densities.
8. Everything else is smooth: the surface at 0 is that of its cubic spline.

Lengths are in spacings, values in the slope of a distance. Every threshold stands in a gap that was
measured; the gap is the comment beside it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .look import (
    BOX,
    FACES_OF_3,
    Floats,
    Look,
    are_no_squares,
    as_labels,
    border_share,
    count_valleys,
    counted_steps,
    different_values,
    equal_neighbours,
    last_digit,
    parting_level,
    side_of_zeros,
    smooth_gradients,
    steps_by_axis,
    typical_slope,
    which_label,
    which_level,
    whole_factor,
)
from .samples import SampleArray

# 2. Labels: share of the samples off the background that equal 4 or more of their 6 neighbours; of
# neighbours that differ, how many by one rank.
PLATEAUS = 0.45  # whole images and integer distances to .43, labels from .55
BY_RANK = 0.99  # integer distances 1, labels to .97, but where one is in the other
AMID = 0.1  # of these the share that equal all 6: distances 0, labels inside others .3 and more
FEW_LABELS = 8  # different values: rounded distances and images from 11, lesions and organs to 8
# 3. Transforms: share of the samples beside the surface that equal others with the same 27 signs.
# Values that do not jump over 0 need the steps of a mask: a share of these samples with other sides
# along two axes, and many patterns of signs, or many of all. Else faces are along the axes.
FOLLOW = 0.953  # distances to .9502 (but where faces are along the axes), transforms from .957
STAIRS = 0.2  # solids along the axes to .18, masks of others from .26
ZEROS = 0.25  # share of samples at 0 beside the surface: sides that start at 0 have .3
PATTERNS, OF_ALL = 100, 0.4  # such solids have to 96, or .38 of few; masks from 104, or .45
NOTHING = 1e-4  # of the largest: densities that fade out are less, squares of distances from 5e-4
ROUGH = 1.0  # fourth differences over slopes: lattices of short periods to .5, transforms from 4.7
COUNTED = 0.99  # multiples of one step: transforms 1, rounded distances to .976
JUMPS = 1.2  # times the largest other step: transforms 2, distances 1
# 4. Unknown samples: steps to a frequent value over the steepest ones; how many of them jump.
JUMP = 1.5  # cut off 1.0, sentinels from 2
MIXED = 0.05  # cut off 0, where it is also the cut-off value from .09
# 5. Distances: share of the smooth samples whose slope is the commonest one; share of the samples
# beside the surface that differ from two others by more than they are apart.
SLOPES = 0.95  # exact from .98; smooth unions to .83, saturating to .36, noise of .05 to .66
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
CROWDED = 0.7  # of the uncut samples, those in the last tenth: cut off to .55, tanh from .85
SEAMS = 0.05  # valleys inside per crossing: single solids to .033, touching parts from .077
THICK = 0.012  # spacings: walls of unsigned distances have no thickness, a thin ring .025
# 6. Noise: contradictions left when noise of the size of fourth differences is allowed; smooth
# samples of all.
NOISE = 0.05  # uniform noise of .05 to .5 voxel and Gaussian to .033; logits .087, networks .096
MOST_NOISE = 1.0  # spacings: with more, distances beside the surface say nothing of it
NOISES = 2.5  # times its deviation, by which noise may make two samples differ
SPREAD = 0.34  # of fourth differences, lowest quarter over median: noise from .39, fused to .29
SMOOTH_SHARE = 0.06  # noise of .05 voxel to .03; fields of other slopes from .10
# 7. Densities: range over the smallest step; median of the sizes over the largest, with more
# surface at 0 than at the level that parts them best; valleys per sample of a face. Distances may
# be rounded, to this part of the spacing.
ROUNDED = 1.0
IMAGE = 1 << 17  # 16 bits have 65,535, floats 1e6 and more
ALIKE = 0.05  # by which ends differ between which distances were cut off: .004, images .2 to 1
CENTRED = 0.13  # maps of density and statistics to .11, fields from .15
AREA = 1.0  # fields to 1.11 and d^3 1.02 with centres from .15, maps from 1.14
RISING = 0.1  # of steps between neighbours, median over steepest: images to .03, distances from .3
VALLEY = 0.2, 1.5  # unsigned distances .3 to .6; densities .05, noise 3
ENOUGH = 20  # samples from which a share is evidence

CENTRE_OF_5 = 62  # of the samples in a box of 5 x 5 x 5
TRANSFORM = "a distance transform, so only their sign says something"


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
    if hint == "labels" or (not hint and may_be_labels and _are_labels(samples, look, facts)):
        return Answer("labels", "", facts, which_label(samples))
    if is_mask:
        return Answer("mask", "there are two values", facts)
    follow = not hint and _follow_from_signs(look, given, facts)
    is_sure = follow and (facts["shape"] >= FOLLOW or facts["zeros"] >= ZEROS)
    if (is_sure and facts["stepped"]) or (follow and _jump_over_0(look)):
        return Answer("mask", TRANSFORM, facts | {"zeros": side_of_zeros(look)})
    signs = look
    look = _without_sentinels(look, facts)
    unit = _unit_of_distances(look, given, facts)
    if unit is not None:
        return _distances(look, unit, given, facts)
    if look.frequent.get(0.0) and look.low < 0 < look.high:  # no surface fills a space
        others, known = look.without(0.0), facts | {"unknown_values": [0.0]}
        if (unit := _unit_of_distances(others, given, known)) is not None:
            return _distances(others, unit, given, known)
    if follow and facts["stepped"]:
        return Answer("mask", TRANSFORM, facts | {"zeros": side_of_zeros(signs)})
    if hint == "density":
        return Answer("density", "", facts, which_level(look))
    if look.is_one_sided:
        return _of_one_side(look, facts)
    if "perhaps_unknown" in facts:
        value = facts["perhaps_unknown"]
        said = f"beside some of the samples that are {value:g} the values jump: --unknown {value:g}"
        return Answer("smooth", "", facts, said)
    unit = facts.get("unit") or typical_slope(look, np.ones(3), facts["cut"])
    steps = np.full(3, unit) if given is None else given
    if _is_cut_near(look, steps, facts):
        return Answer("distance", "", facts | {"spacing": steps})
    return _of_both_sides(look, given, facts)


# Questions 2 and 3: labels and masks


def _are_labels(samples: SampleArray, look: Look, facts: dict[str, Any]) -> bool:
    if look.infinite or not (factor := whole_factor([look.pairs])):
        return False
    found = different_values(as_labels(samples))
    if found is None or not whole_factor([found[0]]):
        return False
    distinct, counts = found
    pairs, part = (np.rint(x / factor) for x in (look.pairs, look.part))
    ranks = np.abs(np.diff(np.searchsorted(distinct, pairs), axis=0))
    facts["by_rank"] = float((ranks == 1).mean())
    inner = ~np.isnan(part) & (part != distinct[counts.argmax()])
    if len(distinct) > 3:  # images are cut off at their ends
        inner &= (part != distinct[0]) & (part != distinct[-1])
    equal = equal_neighbours(part)[inner]
    facts["amid"] = float((equal == 6).mean()) if len(equal) else 1.0
    if len(distinct) > 3 and facts["by_rank"] >= BY_RANK:
        return bool(facts["amid"] >= AMID)
    facts["plateaus"] = float((equal >= 4).mean()) if len(equal) else 1.0
    few = len(distinct) <= FEW_LABELS and look.low >= 0
    has_cores = facts["amid"] >= AMID or look.is_one_sided  # distances to boxes have none
    return bool(few or (facts["plateaus"] >= PLATEAUS and has_cores))


def _follow_from_signs(look: Look, given: Floats | None, facts: dict[str, Any]) -> bool:
    """Return whether samples beside the surface are equal wherever the 27 signs round them are.

    Of one shape they all have one size. So have distances to faces along the axes, which differ by
    their steps; others may follow by chance, which is told by their slopes.
    """
    boxes = look.boxes[:, 1:4, 1:4, 1:4]
    facts["zeros"] = float((look.boxes[:, 2, 2, 2] == 0).mean()) if len(look.boxes) else 0.0
    facts["follow"], most, largest = 0.0, 0, max(abs(look.low), abs(look.high))
    fine = np.repeat(np.ones(3, bool) if given is None else given < 1.01 * given.min(), 2)
    cut = [x for x in facts["cut"] if x]
    whole = np.isfinite(boxes).all((1, 2, 3)) & (boxes[:, 1, 1, 1] != 0)
    for signs in (boxes > 0, boxes >= 0):  # 0 may be on either side
        along = (signs != signs[:, 1:2, 1:2, 1:2])[(slice(None), *FACES_OF_3[fine].T)]
        ring = whole & along.any(1)
        free = ring & ~np.isin(boxes[:, 1, 1, 1], cut)
        x = boxes[free, 1, 1, 1]
        typical = float(np.quantile(np.abs(x), 0.5)) if len(x) else 0.0
        if len(x) < max(ENOUGH, ring.sum() / 2) or typical < NOTHING * largest:
            continue
        alike = np.abs(np.abs(x) - typical) <= 0.01 * typical
        shape = min(float(alike[side].mean()) for side in (x > 0, x < 0) if side.any())
        bits = np.packbits(signs[free].reshape(-1, 27), axis=1)
        key = np.ascontiguousarray(bits).view(np.uint32).ravel()
        order = np.argsort(key, kind="stable")
        same, share = np.diff(key[order]) == 0, shape
        if same.sum() >= 5 * ENOUGH:
            equal = np.abs(np.diff(x[order])[same]) <= 0.01 * typical
            share = max(shape, float(equal.mean()))
        if share > facts["follow"] or (share >= FOLLOW and len(x) > most):
            most, patterns = len(x), int(np.count_nonzero(~same)) + 1
            stairs = float((along[free].reshape(most, -1, 2).any(2).sum(1) > 1).mean())
            facts.update(follow=share, shape=shape, stairs=stairs, step=typical)
            is_many = patterns > min(PATTERNS, OF_ALL * most)
            facts["stepped"] = stairs > STAIRS and is_many and len(cut) < 2
    counted = counted_steps(look) if facts["zeros"] and not look.is_one_sided else np.nan
    if not np.isnan(counted):  # rounded distances may be so, too
        return counted >= COUNTED
    if facts["follow"] < FOLLOW or (look.is_one_sided and _fades_out(look, given, facts)):
        return False
    rough = np.abs(np.diff(look.box_lines, 4)[..., 0]).sum(1)
    rise = np.abs(np.diff(look.box_lines[..., 1::2])[..., 0]).sum(1) / 2
    known = np.isfinite(rough + rise)
    return bool(np.median(rough[known]) >= ROUGH * np.median(rise[known])) or not known.any()


def _fades_out(look: Look, given: Floats | None, facts: dict[str, Any]) -> bool:
    """Return whether values of one side grow as no transform does, as an image that fades to 0.

    Distances grow by a step from sample to sample, unless they are squared: then they are sums of
    squares of steps. And they have no flat top.
    """
    step, values = facts["step"], np.abs(look.pairs)
    longest = step * (1.0 if given is None else float(given.max() / given.min()))
    if np.quantile(np.abs(values[0] - values[1]), 0.99) <= 2 * longest:
        return False
    is_cut = (look.high if look.low >= 0 else look.low) in facts["cut"]
    return is_cut or are_no_squares(values / step)


def _jump_over_0(look: Look) -> bool:
    """Return whether all steps over 0 are larger than all others."""
    one, other = look.pairs
    size, over = np.abs(one - other), (one > 0) != (other > 0)
    return bool(over.sum() > ENOUGH and size[over].min() > JUMPS * size[~over].max(initial=0))


# Question 4: unknown samples


def _without_sentinels(look: Look, facts: dict[str, Any]) -> Look:
    """Return a look without values of many samples to which the others jump, if there are some."""
    if not look.low < 0 < look.high:
        return look
    change = np.abs(look.pairs[0] - look.pairs[1])
    is_frequent, found = np.isin(look.pairs, list(look.frequent)).all(0), []
    for value in look.frequent:
        at = (look.pairs == value).any(0)
        steps = change[at & ~is_frequent]
        steps = steps if len(steps) else change[at]  # only beside samples that are cut off
        if not len(steps) or at.all():
            continue
        jumps = float((steps > JUMP * np.quantile(change[~at], 0.99)).mean())
        if jumps > 0.5:
            found.append(value)
        elif jumps > MIXED and value in facts["cut"]:
            facts["perhaps_unknown"] = value
    # far inside and far outside a value may stand for "unknown" with either sign
    found += [x for x in (look.low, look.high) if -x in found and x not in found]
    if found:
        facts["unknown_values"] = found
        facts["cut"] = [x for x in facts["cut"] if x not in found]
        facts.pop("perhaps_unknown", None)
    for value in found:
        look = look.without(value)
    return look


# Question 5: distances


def _unit_of_distances(look: Look, given: Floats | None, facts: dict[str, Any]) -> Any:
    """Return the unit of values that are distances, see ``_find_unit``; None if they are none."""
    facts["digit"] = last_digit(look)
    unit = _find_unit(np.where(np.isin(look.lines, facts["cut"]), np.nan, look.lines), given, facts)
    enough = not look.is_one_sided or facts["smooth"] > SMOOTH_SHARE
    if unit is None or not enough or facts["slopes"] < SLOPES:
        return None
    steps = unit * (np.ones(3) if given is None else given)
    facts["contradictions"] = _contradictions(look, steps, facts["digit"])
    return unit if facts["contradictions"] <= CONTRADICTIONS else None


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
    beyond = np.abs(boxes - boxes[:, CENTRE_OF_5, None]) > apart + allowed
    beyond &= np.abs(boxes) < MATTERS
    return float((np.count_nonzero(beyond, axis=1) >= 2).mean())


def _distances(look: Look, unit: Any, given: Floats | None, facts: dict[str, Any]) -> Answer:
    """Return distances, or why they are none to a surface in the grid."""
    steps = np.ones(3) * unit if given is None else given
    facts["spacing"] = steps
    if given is not None and np.ndim(unit):
        shown = ",".join(f"{x:.4g}" for x in given * unit)
        said = f"the values show another spacing along each axis: --spacing {shown}"
        return Answer("distance", "", facts, said)
    off = 0.0 if given is None else abs(float(unit) - 1)
    if off > ANOTHER_UNIT:
        power, short = 10.0 ** np.round(np.log10(1 / unit)), float(f"{1 / unit:.2g}")
        scale = next((x for x in (power, short) if abs(1 / unit / x - 1) < 2e-3), 1 / unit)
        shown = ",".join(f"{x:.4g}" for x in np.unique(steps) * unit)
        said = (
            "they are distances in another unit than the spacing: multiply the values, --scale "
            f"{scale:.6g} (or the spacing is wrong: they show {shown})"
        )
        return Answer("distance", "", facts, said)
    if off > facts["error"]:
        facts["slope"] = float(unit)
    if look.is_one_sided:
        return _to_thin_walls(look, steps, facts)
    outside = -1 if border_share(look, lambda x: x < 0) > 0.5 else 1  # also if none is known
    found, changes = count_valleys(look, float(steps.min()), -outside)
    facts["seams"] = found / max(changes, 1)
    if facts["seams"] > SEAMS:
        why = "distances to parts that touch or overlap, with faces of these inside"
        return Answer("smooth", why, facts | {"inside": -outside})
    return Answer("distance", "", facts)


def _to_thin_walls(look: Look, steps: Floats, facts: dict[str, Any]) -> Answer:
    """Return distances of one side: to walls thinner than the spacing, or no surface at 0.

    Along a line of samples the field falls towards a wall and rises behind it. What the distances
    on either side leave of the way between two samples is how thick it is.
    """
    sign = 1 if look.low >= 0 else -1
    nearest = look.low if sign > 0 else look.high
    if nearest in facts["cut"]:
        return Answer("density", "", facts, which_level(look))
    if abs(nearest) > 1.05 / 2 * float(np.sqrt((steps**2).sum())):  # half a diagonal
        said = "every wall is nearer to some sample than that, so there is no surface"
        return Answer("distance", "", facts, said)
    thickness = []
    for axis in range(3):
        lines = np.moveaxis(look.part, axis, 0) * (sign / steps[axis])
        before, left, right, after = (lines[i : len(lines) - 3 + i] for i in range(4))
        falling, rising = before - left, after - right
        left_over = (falling + rising) / 2 - left - right
        thickness.append(left_over[(np.minimum(falling, rising) > 0.25) & (left_over > -0.6)])
    walls = np.concatenate(thickness)
    if not len(walls):
        said = "only samples on the border of the grid are near 0, so no surface lies in it"
        return Answer("distance", "", facts, said)
    walls = walls[walls > -0.25]
    if len(walls) and np.median(walls) > THICK:
        return Answer("distance", "", facts)
    return _unsigned(sign, float(steps.max()), facts)


def _unsigned(sign: int, h: float, facts: dict[str, Any]) -> Answer:
    """Return the refusal of distances without a sign; ``sign`` is that of all values."""
    option = f"--inside {'negative' if sign > 0 else 'positive'} --offset {h:.4g}"
    said = f"unsigned distances have no inside: mesh the shell round the surface with {option}"
    return Answer("distance", "", facts, said)


def _is_cut_near(look: Look, given: Floats, facts: dict[str, Any]) -> bool:
    """Return whether values are distances cut off, or unknown, so near that few slopes are left."""
    known = max(-look.low, look.high) if look.unknown or "unknown_values" in facts else np.inf
    nearest = min(map(abs, facts["cut"]), default=known)
    if nearest >= NARROW * given.max():
        return False
    size = np.abs(look.lines[np.isfinite(look.lines[:, 0, 2]), 0, 2]) / nearest
    facts["crowded"] = float((size > 0.9).mean()) if size.size else 0.0
    slope = typical_slope(look, given, facts["cut"])
    is_even = facts["crowded"] < CROWDED and SLOPE_NEAR[0] < slope < SLOPE_NEAR[1]
    return is_even and _contradictions(look, given, facts["digit"]) <= NEVER


# Questions 6 to 8: noise, densities, smooth fields


def _of_both_sides(look: Look, given: Floats | None, facts: dict[str, Any]) -> Answer:
    values = np.unique(np.append(look.pairs, look.boxes[:, 2, 2, 2]))
    values = values[np.isfinite(values)]
    digit = float(np.diff(values).min())
    if np.ptp(values) < IMAGE * digit:
        steps = _before_rounding(look, digit, given, facts)
        if steps is not None and given is not None and steps is not given:
            return _distances(look, float(steps[0] / given[0]), given, facts)
        if steps is not None:
            facts["noise"] = digit / float(steps.max()) / 12**0.5  # standard deviation
            why = f"distances rounded to {digit:.3g}"
            return Answer("noisy", why, facts | {"spacing": steps})
        if not facts["cut"] or abs(look.low + look.high) >= ALIKE * look.high:
            return Answer("density", "", facts, which_level(look, signed=True))
    middle = look.lines[np.isfinite(look.lines[:, 0, 2]), 0, 2]
    if len(middle) >= ENOUGH:
        size, (one, other) = np.abs(middle), look.pairs
        facts["centred"] = float(np.median(size) / np.quantile(size, 0.995))
        at_0, best = (((one > x) != (other > x)).sum() for x in (0.0, parting_level(middle)))
        facts["area"] = float(at_0 / max(best, 1))
        if facts["centred"] < CENTRED and facts["area"] > AREA:
            return Answer("density", "", facts, which_level(look, signed=True))
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
    slope = typical_slope(look, steps)
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


def _of_one_side(look: Look, facts: dict[str, Any]) -> Answer:
    """Return densities, or unsigned distances of one slope or another."""
    sign = 1 if look.low >= 0 else -1
    change = np.abs(look.pairs[0] - look.pairs[1])
    steep = float(np.quantile(change, 0.98))
    share = np.count_nonzero(~np.isnan(look.part)) / np.prod(look.shape)
    found = count_valleys(look, steep, sign)[0] / share / float(np.prod(look.shape)) ** (2 / 3)
    # steps between plateaus, with noise on them, make valleys, too
    facts["rising"] = float(np.median(change)) / steep
    is_unsigned = (look.low if sign > 0 else look.high) not in facts["cut"]
    if is_unsigned and facts["rising"] > RISING and VALLEY[0] < found < VALLEY[1]:
        return _unsigned(sign, steep, facts)
    return Answer("density", "", facts, which_level(look))
