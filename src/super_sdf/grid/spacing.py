"""The spacing of the samples and the sign inside, as given or as the values show them.

Values that are refused may be labels, densities, unsigned distances, distances in another unit, or
a field of another slope. All refusals end with the one option to try next, found from the values.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import Triple
from ..errors import GridError
from .census import CUT_OFF, Census
from .one_sided import UNSIGNED, find_walls
from .placement import LEAST_SPACING, MOST_SPACING, check_spacing, is_cubic, steps_of
from .planes import SampleArray, changed, spread_planes
from .slopes import ENOUGH, Gradients

PLANES = 12  # that are looked at, spread evenly
MOST_NAMED = 8  # labels that a message lists
ALIKE = 1.1  # ratio up to which the spacings that the axes show are one unit's
SNAP = 0.02  # a scale or spacing this close to a usual one is replaced by it
NEAR = 0.25  # of a step from the lowest value: there unsigned distances rise to both sides
VANISHING = 1e-6  # of the largest value: as good as 0
CLOSE = 0.95  # share of the full range that values reach, if it is theirs
FULL = (1, 255, 2**16 - 1)  # largest values of densities and images: the level is half of it
ROUNDS, FEW = 20, 1 << 16  # of the search for a level; samples of a plane
CLEARLY_UNEQUAL = 1.1  # ratio of estimated spacings, from which on they are taken as different
TOLERATED = 1.1  # ratio of measured to given spacing, or its inverse, above which there is a note
# Distances cannot change by more than the samples are apart. Larger ratios are refused: the first
# limit applies to gradients that agree with each other, the second to noisy or bent fields. They
# do change by less at thin parts and where they are truncated, so that is never refused.
REFUSED, REFUSED_IF_UNSURE = 1.25, 2.0


def is_positive_inside(census: Census, inside: str, notes: list[str]) -> bool:
    """Return whether the values are positive inside; for "auto" the border counts as outside."""
    if inside != "auto":
        return inside == "positive"
    if census.is_one_sided:
        return census.numbers.low < 0
    below = census.border_shares()[0]
    positive, share = below > 0.5, max(below, 1 - below)
    if positive or share < 1:
        sign = "positive" if positive else "negative"
        notes.append(
            f"{sign} values are taken as inside: {share:.0%} of the grid's border has the other "
            "sign (if that is wrong, use --inside)"
        )
    return positive


def check_negative_inside(census: Census) -> None:
    """Raise GridError if most of the border is negative: the sign seems to be reversed."""
    below = census.border_shares()[0]
    if below > 0.5:
        raise GridError(
            f"{below:.0%} of the grid's border is negative, which is inside: make the grid "
            "with make_grid(values, spacing=..., inside='positive'), or inside='negative' if the "
            "solid does run out of the grid there"
        )


def choose_spacing(
    census: Census, spacing: ArrayLike | None, notes: list[str], *, is_cut: bool = False
) -> Triple:
    """Return the given spacing, or else the one that is measured on the values.

    ``notes`` gets a sentence if the spacing was inferred or is doubtful. Values that are cut off
    (``is_cut``) may change by less along an axis with a large spacing.

    Raises
    ------
    GridError
        If the values change by more than the given spacing allows, or show none.
    """
    beside = census.beside
    if spacing is not None:
        given = check_spacing(spacing)
        if len(beside.bend):
            if not is_cut:
                _check_axes(census, beside.in_finest(given), given)
            _check_unit(census, given, notes, is_cut)
        return given
    everywhere = census.everywhere
    unequal = beside.of_axes or everywhere.of_axes
    if unequal or not _show_one_spacing(everywhere):
        each = everywhere.spacing
        if each is not None and each.max() > CLEARLY_UNEQUAL * each.min():
            return _infer_axes(each, notes)
    if unequal:
        steps = ", ".join(f"{step:.4g} along {name}" for name, step in unequal.items())
        raise GridError(
            f"spacing not given: the values change by {steps} from sample to sample, and do not "
            f"show it for all axes; {way_out(census)}"
        )
    return _infer_spacing(_measure(everywhere, beside), census.shape, notes)


def _show_one_spacing(gradients: Gradients) -> bool:
    """Return whether gradients agree on a spacing, whatever their direction."""
    return len(gradients.bend) < ENOUGH or gradients.agree_with(gradients.typical_length)


def _check_axes(census: Census, gradients: Gradients, spacing: Triple) -> None:
    """Raise GridError if gradients, scaled to one spacing, show different ones along the axes."""
    unequal, h = gradients.of_axes, dict(zip("xyz", spacing))
    if unequal:
        steps = ", ".join(
            f"{step * h[name] / min(spacing):.4g} along {name}" for name, step in unequal.items()
        )
        each = ", ".join(f"{x:g}" for x in (spacing[:1] if is_cubic(spacing) else spacing))
        raise GridError(
            f"the values change by {steps} from sample to sample, but spacing is {each}: "
            f"{way_out(census, spacing)}"
        )


def _infer_axes(each: NDArray[np.float64], notes: list[str]) -> Triple:
    """Return the estimated spacings of the axes, those that are nearly equal as one."""
    each = each.copy()
    for near in each.copy():  # axes that are equal but for the error of the estimate
        alike = np.abs(each / near - 1) <= SNAP
        each[alike] = each[alike].mean()
    spacing = check_spacing(each)
    notes.append(
        f"spacing not given: estimated as {', '.join(f'{h:.6g}' for h in spacing)} along x, y, z "
        "from the values, so the size of the mesh is approximate (give --spacing)"
    )
    return spacing


def measure_spacing(census: Census) -> float:
    """Return the change of values from sample to sample where they are smooth; NaN if nowhere."""
    if not (len(census.everywhere.bend) or len(census.beside.bend)):
        return float("nan")
    return _measure(census.everywhere, census.beside)


def _measure(everywhere: Gradients, beside: Gradients) -> float:
    """Return the change of the values from sample to sample where the field is smooth.

    It is that of the whole field, unless only the samples beside the surface agree with each other:
    then the field is no distance, and what it is at the surface matters.
    """
    if len(everywhere.bend) < ENOUGH and len(beside.bend):
        return beside.typical_length
    measured = everywhere.typical_length
    if len(beside.bend) and not everywhere.agree_with(measured):
        near = beside.typical_length
        return near if beside.agree_with(near) else measured
    return measured


def _infer_spacing(measured: float, shape: tuple[int, ...], notes: list[str]) -> Triple:
    if not LEAST_SPACING <= measured <= MOST_SPACING:
        raise GridError(
            f"spacing not given: the values change by {measured:.6g} from sample to sample; give "
            f"--spacing, in a unit in which it is between {LEAST_SPACING:g} and {MOST_SPACING:g}"
        )
    n = max(shape)
    usual = {"1": 1.0, f"1/{n}": 1 / n, f"1/{n - 1}": 1 / (n - 1)}
    usual |= {f"2/{n}": 2 / n, f"2/{n - 1}": 2 / (n - 1)}
    name = min(usual, key=lambda key: abs(np.log(usual[key] / measured)))
    if abs(measured / usual[name] - 1) <= SNAP:
        notes.append(f"spacing not given: taken as {name}, the values show {measured:.6g}")
        return (usual[name],) * 3
    notes.append(
        f"spacing not given: estimated as {measured:.6g} from the values, so the size of the mesh "
        "is approximate (give --spacing)"
    )
    return (measured,) * 3


def _check_unit(census: Census, spacing: Triple, notes: list[str], is_cut: bool) -> None:
    """Raise GridError, or add a note, if the values contradict the given spacing.

    They do if they change by more. Exact distances change by less beside thin parts: there is no
    note if the rest of the field agrees with the spacing.
    """
    h, beside = min(steps_of(spacing)), census.beside.in_finest(spacing)
    measured = beside.typical_length
    named = f"{spacing[0]:.6g}" if is_cubic(spacing) else f"{h:.6g} along the finest axis"
    observed = f"the values change by {measured:.6g} from sample to sample, but spacing is {named}"
    allowed = REFUSED if beside.agree_with(measured) else REFUSED_IF_UNSURE
    if measured > allowed * h:
        raise GridError(f"{observed}: {way_out(census, spacing)}")
    if _agree(measured, h):
        return
    if measured < h:
        everywhere = census.everywhere.in_finest(spacing)
        if not is_cut:
            _check_axes(census, everywhere, spacing)
        if _agree(_measure(everywhere, beside), h):
            return
    notes.append(f"{observed}: they are not exact distances, or the unit is wrong")


def _agree(measured: float, h: float) -> bool:
    return h / TOLERATED <= measured <= h * TOLERATED


def way_out(census: Census, spacing: Triple | None = None, fault: str = UNSIGNED) -> str:
    """Return a clause that names the option to try next for values that are refused."""
    if census.are_labels:
        return choose_label(census.samples)
    steps = _steps(census)
    if census.is_one_sided:
        if steps is None or (fault == UNSIGNED and not _has_walls(census, steps.max())):
            return choose_level(census)
        unit = _unit(steps, spacing) if spacing is not None else ""
        if unit or fault != UNSIGNED:
            return unit or fault
        inside = "negative" if census.numbers.low >= 0 else "positive"
        way = f"--inside {inside} --offset {max(spacing or steps):.4g}"
        return f"{UNSIGNED}: mesh the shell round the surface with {way}"
    if spacing is None:
        return "give --spacing X,Y,Z"
    if steps is None and census.samples.dtype.kind in "iu":
        return _level(census.samples, 0.0)
    unit = _unit(steps, spacing) if steps is not None else ""
    return unit or "they are distances in no unit: give --field scaled"


def refusal(census: Census, spacing: Triple | None, fault: str = UNSIGNED) -> GridError:
    """Return the error for values without both sides; ``fault`` is that of ``one_sided``."""
    low, high = census.extremes
    side, end, at = ("below", "smallest", low) if low >= 0 else ("above", "largest", high)
    advice = way_out(census, spacing, fault)
    return GridError(f"no value is {side} 0 (the {end} is {at:.6g}): {advice}")


def is_density(census: Census, spacing: Triple) -> bool:
    """Return whether values on one side of 0 are no distances, or cut off at 0.

    Distances to walls may be rounded so that they show no spacing.
    """
    steps, samples = _steps(census), census.samples
    if _has_walls(census, max(spacing if steps is None else steps)):
        return False
    small = VANISHING * max(map(abs, census.extremes))
    planes = [np.abs(np.asarray(samples[i])) for i in spread_planes(0, len(samples) - 1, PLANES)]
    at_zero = [float((plane <= small).mean()) for plane in planes]
    return steps is None or sum(at_zero) > CUT_OFF * len(at_zero)


def _has_walls(census: Census, step: float) -> bool:
    """Return whether values rise to both sides where they are next to 0, as unsigned distances."""
    samples, (low, high) = census.samples, census.extremes
    if min(samples.shape) < 4:  # two samples on either side of a wall
        return False
    sign, least = (1, low) if low >= 0 else (-1, -high)
    walls = near = 0
    for i in spread_planes(1, len(samples) - 3, PLANES):
        slab = (sign * np.asarray(samples[i - 1 : i + 3], np.float64) - least) / step
        walls += sum(int(find_walls(x)[0].sum()) for x in (slab, slab[1], slab[1].T))
        near += int((slab[1] <= NEAR).sum())
    return 4 * walls > near


def _unit(steps: NDArray[np.float64], spacing: Triple) -> str:
    """Return the advice for distances that show other spacings than those given, if they do."""
    ratio = np.array(spacing) / steps
    if ratio.max() > ALIKE * ratio.min():
        each = ",".join(f"{step:.4g}" for step in steps)
        return f"give the spacing of each axis (they show --spacing {each})"
    scale = float(ratio.mean())
    if 1 / ALIKE <= scale <= ALIKE:
        return ""
    usual = (10.0 ** round(np.log10(scale)), spacing[0])
    scale = next((x for x in usual if abs(scale / x - 1) <= SNAP), scale)
    return f"distances need the unit of the spacing: multiply the values, --scale {scale:.6g}"


def choose_label(samples: SampleArray) -> str:
    """Return the advice to choose a label: the most frequent one that is not the border's."""
    counts: dict[Any, int] = {}
    for plane in samples:
        for label, count in zip(*(x.tolist() for x in np.unique(plane, return_counts=True))):
            counts[label] = counts.get(label, 0) + count
    ends = np.concatenate([np.asarray(samples[i]).ravel() for i in (0, -1)])
    values, frequent = np.unique(ends, return_counts=True)
    outside = values[frequent.argmax()].item()
    best = max((label for label in counts if label != outside), key=lambda x: counts[x])
    return f"they look like labels ({named(counts)}): choose one with --label {int(best)}"


def named(labels: Any) -> str:
    """Return labels in words, the first few in order."""
    ordered = sorted(labels)
    words = ", ".join(f"{x:g}" if x % 1 else str(int(x)) for x in ordered[:MOST_NAMED])
    return words + (", ..." if len(ordered) > MOST_NAMED else "")


def choose_level(census: Census) -> str:
    """Return the advice to choose a level of densities: half of the full range, or between two."""
    (low, high), samples = census.extremes, census.samples
    least = 0.5 if samples.dtype.kind in "iu" else CLOSE
    full = next((full for full in FULL if low >= 0 and least * full < high <= full), 0)
    return _level(samples, full / 2 if low < full / 2 and full else _between(samples))


def _level(samples: SampleArray, level: float) -> str:
    """Return the advice to try a level, with what is on the border outside."""
    census = Census(changed(samples, partial(np.add, -level)))
    side = "positive" if census.border_shares()[0] > 0.5 else "negative"
    option = f"--level {level:.6g} --inside {side}"
    return f"they look like densities: give the level of their surface, such as {option}"


def _between(samples: SampleArray) -> float:
    """Return the middle of values that are cut off at both ends, else a level between two groups.

    That is half-way between the means of what is below and above it (Ridler and Calvard).
    """
    planes = [np.ravel(samples[i]) for i in spread_planes(0, len(samples) - 1, PLANES)]
    some = np.concatenate([plane[:: 1 + plane.size // FEW] for plane in planes]).astype(np.float64)
    some = some[np.isfinite(some)]
    ends = float(some.min()), float(some.max())
    if min(float((some == end).mean()) for end in ends) > CUT_OFF:
        return sum(ends) / 2
    level = float(some.mean())
    for _ in range(ROUNDS):
        above = some > level
        if above.all() or not above.any():
            break
        level = float(some[above].mean() + some[~above].mean()) / 2
    return float(f"{level:.3g}")


def _steps(census: Census) -> NDArray[np.float64] | None:
    """Return the spacing of each axis with which values are distances; None if with none."""
    gradients = census.everywhere
    if not len(gradients.bend):
        return None
    if gradients.spacing is not None:
        return gradients.spacing
    step = gradients.typical_length
    return np.full(3, step) if gradients.agree_with(step) else None
