"""From values of any kind to distances near the surface: what they are, and the best way there.

The evidence is gathered once (``evidence``); the user may overrule it. The zero level never moves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import Triple
from ..errors import GridError
from .evidence import ENOUGH, Evidence, Looked, look, weigh
from .field import AUTO, EXACT, MASK, NOISY, NONE_EXACT, SCALED, TRUNCATED, Field, Wanted
from .gradients import surface_gradients, typical_length
from .masks import extremes_of_masks, has_both_sides, is_distance_transform, mask_planes
from .one_sided import check_thin, is_one_sided
from .planes import DerivedPlanes, SampleArray
from .samples import (
    Extremes,
    check_kind,
    check_not_constant,
    check_values,
    has_two_values,
)
from .sides import check_inside, count_border, is_mostly_negative, is_positive_inside
from .slopes import normalised_planes
from .spacing import check_spacing, choose_spacing, is_cubic
from .truncation import filled_planes

# Voxels from which on values may be cut off without a loss; up to which the rest is filled in; and
# below which too few are left for that.
HARMLESS, FILLED, TOO_NEAR = 3.0, 1.75, 0.85
BENT = 0.1  # share of wrong slopes from which the network has no say in a field
SLOPE_OFF = 0.25  # from 1: truncated distances have another unit
# Densities have no ramp if half of the changes across the level are this share of all there is to
# change, the lowest and the highest values left out.
STEP, STEP_TAIL = 0.85, 0.05
MOST_LABELS = 64  # whole numbers up to this look like labels
MOST_NAMED = 8  # labels that a message lists


@dataclass(frozen=True, eq=False)
class Interpreted:
    """Distances near the surface, and how they are to be used.

    Attributes
    ----------
    samples : array or Planes
        The values.
    extremes : two floats
        Their minimum and maximum.
    spacing : three floats
    positive_inside : bool
        Whether positive values are inside.
    field : Field
    """

    samples: SampleArray
    extremes: Extremes
    spacing: Triple
    positive_inside: bool
    field: Field


def interpret(
    samples: SampleArray, wanted: Wanted, spacing: ArrayLike | None, inside: str, notes: list[str]
) -> Interpreted:
    """Return distances for the values of a grid; ``notes`` gets sentences on what was inferred.

    Raises
    ------
    GridError
        If the values have no surface, or contradict the spacing.
    OptionError
        If ``inside`` or what is wanted is unknown.
    """
    wanted.check()
    check_inside(inside)
    check_kind(samples.dtype, samples.shape)
    if wanted.label is not None:
        return _of_mask(_labelled(samples, wanted.label), wanted, spacing, _above(inside), notes)
    if samples.dtype == np.bool_:
        return _of_mask(samples, wanted, spacing, inside, notes)
    if wanted.level is not None:
        samples = _derived(samples, lambda v: v - float(wanted.level or 0))
        which = "below" if inside == "negative" else "above"
        notes.append(f"values {which} {wanted.level:g} are taken as inside (see --inside)")
        inside = _above(inside)
    if wanted.scale is not None:
        samples = _derived(samples, lambda v: v * float(wanted.scale or 1))
    extremes = check_values(samples)
    check_not_constant(extremes)
    if has_two_values(samples, extremes) or wanted.field == MASK:
        return _of_values(samples, extremes, wanted, spacing, inside, notes)
    if wanted.field in (EXACT, NOISY):
        return _as_distances(samples, extremes, wanted, spacing, inside, notes)
    return _by_evidence(samples, extremes, wanted, spacing, inside, notes)


def _above(inside: str) -> str:
    """Return which side is inside if above a level is, unless the user says otherwise."""
    return "positive" if inside == AUTO else inside


def _derived(
    samples: SampleArray, change: Callable[[NDArray[Any]], NDArray[Any]], dtype: Any = np.float64
) -> DerivedPlanes:
    """Return samples changed one by one, as float64 or of another type."""
    if dtype is np.float64:
        return DerivedPlanes(samples, lambda planes: change(planes.astype(np.float64)))
    return DerivedPlanes(samples, change, dtype=dtype)


def _labelled(samples: SampleArray, label: float) -> SampleArray:
    """Return which samples have a label; GridError if none or all have."""
    found = _derived(samples, lambda planes: planes == label, np.bool_)
    if not has_both_sides(found):
        labels = sorted({float(x) for plane in samples for x in np.unique(plane)[: MOST_NAMED + 1]})
        named = ", ".join(f"{x:g}" for x in labels[:MOST_NAMED])
        named += ", ..." if len(labels) > MOST_NAMED else ""
        which = "every sample" if (np.asarray(samples[0]) == label).any() else "no sample"
        raise GridError(f"{which} has the label {label:g}: the labels are {named}")
    return found


def _of_values(
    samples: SampleArray,
    extremes: Extremes,
    wanted: Wanted,
    spacing: ArrayLike | None,
    inside: str,
    notes: list[str],
) -> Interpreted:
    """Return the distances of a mask that numbers make: two values, or the sign of more."""
    middle = 0.0
    if wanted.level is None and has_two_values(samples, extremes):
        middle = sum(extremes) / 2
    elif wanted.level is None and extremes[1] <= 0:
        raise GridError(_label_hint(extremes))
    above = _derived(samples, lambda planes: planes > middle, np.bool_)
    return _of_mask(above, wanted, spacing, inside, notes)


def _of_mask(
    above: SampleArray, wanted: Wanted, spacing: ArrayLike | None, inside: str, notes: list[str]
) -> Interpreted:
    """Return the distances of a mask; ``above`` says on which side of a level each sample is."""
    if not has_both_sides(above):
        raise GridError(f"every value is {bool(above[0].flat[0])}: a constant field has no surface")
    positive = _is_above_inside(above, inside, notes)
    if spacing is None:
        notes.append("spacing not given: taken as 1, since a mask shows none (give --spacing)")
    chosen = check_spacing(1.0 if spacing is None else spacing)
    _check_cubic(chosen, "a mask")
    h = sum(chosen) / 3
    if not positive:
        above = _derived(above, np.logical_not, np.bool_)
    notes.append(
        "values taken as a mask (--field mask): they show the surface to half a voxel only"
    )
    field = Field(MASK, wanted.field == MASK, NONE_EXACT)
    return Interpreted(mask_planes(above, h), extremes_of_masks(h), chosen, False, field)


def _is_above_inside(above: SampleArray, inside: str, notes: list[str]) -> bool:
    """Return whether the larger value of a mask is inside: the border is outside unless given."""
    if inside != AUTO:
        return inside == "positive"
    signs = _derived(above, lambda planes: planes.astype(np.int8) * 2 - 1, np.int8)
    below, total = count_border(signs)
    positive = is_mostly_negative(below, total)
    share = max(below, total - below) / total
    if share < 1:
        notes.append(
            f"the {'larger' if positive else 'smaller'} value is taken as inside: {share:.0%} of "
            "the grid's border has the other one (if that is wrong, use --inside)"
        )
    return positive


def _as_distances(
    samples: SampleArray,
    extremes: Extremes,
    wanted: Wanted,
    spacing: ArrayLike | None,
    inside: str,
    notes: list[str],
) -> Interpreted:
    """Return values that are taken as distances, exact or noisy ones."""
    positive = is_positive_inside(samples, inside, extremes, notes)
    chosen = choose_spacing(samples, spacing, notes)
    if inside == AUTO and is_one_sided(extremes):
        check_thin(samples, chosen, extremes)
    field = Field(wanted.field, True, NONE_EXACT) if wanted.field == NOISY else Field()
    field = replace(field, given=wanted.field != AUTO)
    return Interpreted(samples, extremes, chosen, positive, field)


def _by_evidence(
    samples: SampleArray,
    extremes: Extremes,
    wanted: Wanted,
    spacing: ArrayLike | None,
    inside: str,
    notes: list[str],
) -> Interpreted:
    """Return distances for values that are no mask at first sight, by what the samples show."""
    if spacing is not None and not is_cubic(check_spacing(spacing)):
        _check_cubic(check_spacing(spacing), _named(wanted))
        return _as_distances(samples, extremes, wanted, spacing, inside, notes)
    looked = look(samples, extremes)
    transformed = is_distance_transform(looked.lines) if wanted.field == AUTO else 0.0
    if transformed:
        if spacing is None:
            notes.append(
                f"spacing not given: taken as {transformed:.6g}, the step of the transform"
            )
        notes.append("the values are a distance transform, so only their sign says something")
        spacing = transformed if spacing is None else spacing
        above = _derived(samples, lambda planes: planes > 0, np.bool_)
        return _of_mask(above, wanted, spacing, inside, notes)
    if is_one_sided(extremes) and inside == AUTO and _are_labels(samples, extremes):
        raise GridError(_label_hint(extremes))
    if wanted.level is not None and wanted.field == AUTO and _is_step(looked):
        notes.append("the densities jump from one side of the level to the other")
        above = _derived(samples, lambda planes: planes > 0, np.bool_)
        return _of_mask(above, wanted, spacing, inside, notes)
    if wanted.level is not None and spacing is None:
        notes.append("spacing not given: taken as 1, since densities show none (give --spacing)")
        spacing = 1.0
    if (
        wanted.field == SCALED
        or _is_normalised(looked, spacing)
        or (wanted.level is not None and not _is_distance(looked, spacing))
    ):
        return _of_slope(samples, looked, wanted, spacing, inside, notes)
    found = _as_distances(samples, extremes, wanted, spacing, inside, notes)
    if not is_cubic(found.spacing):
        return found
    evidence = weigh(looked, sum(found.spacing) / 3)
    return _as_shown(found, evidence, wanted, notes)


def _named(wanted: Wanted) -> str:
    """Return what the user says that the values are, "" for distances."""
    if wanted.level is not None:
        return "a field of densities"
    return "" if wanted.field in (AUTO, EXACT, NOISY) else f"a {wanted.field} field"


def _check_cubic(spacing: Triple, name: str) -> None:
    """Raise GridError if spacings differ, of a field that has a name and so is no distance."""
    if name and not is_cubic(spacing):
        each = ", ".join(f"{h:g}" for h in spacing)
        raise GridError(
            f"spacing is {each}: {name} needs the same spacing on all axes; resample it, or make "
            "distances of it first"
        )


def _are_labels(samples: SampleArray, extremes: Extremes) -> bool:
    """Return whether values look like labels: small whole numbers from 0 on."""
    whole = samples.dtype.kind in "iu" and extremes[0] == 0
    return whole and extremes[1] <= MOST_LABELS


def _label_hint(extremes: Extremes) -> str:
    """Return the message for values on one side of 0 that are a mask or labels."""
    low, high = extremes
    return (
        f"the values are whole numbers from {low:g} to {high:g}, as of labels: choose the solid "
        "with --label, or with --level if they are densities"
    )


def _is_normalised(looked: Looked, spacing: ArrayLike | None) -> bool:
    """Return whether values are cut off at -T and T, or at 1, and their slope is not 1.

    So are distances that were divided by the truncation, as many programs store them.
    """
    if spacing is None or not looked.cut.any():
        return False
    h = sum(check_spacing(spacing)) / 3
    evidence = weigh(looked, h)
    cuts = evidence.cut_low, evidence.cut_high
    ends = [abs(end) for end, is_cut in zip(looked.extremes, cuts) if is_cut]
    alike = all(cuts) and bool(np.isclose(ends[0], ends[-1], rtol=1e-3))
    at_one = bool(ends) and bool(np.allclose(ends, 1, rtol=1e-6))
    return (alike or at_one) and abs(_slope_within(looked) / h - 1) > SLOPE_OFF


def _is_distance(looked: Looked, spacing: ArrayLike | None) -> bool:
    """Return whether densities change as distances do."""
    evidence = weigh(looked, sum(check_spacing(1.0 if spacing is None else spacing)) / 3)
    return bool(np.isfinite(evidence.slope)) and not evidence.is_scaled


def _is_step(looked: Looked) -> bool:
    """Return whether densities jump over the level from sample to sample, with no ramp between.

    Then where the surface lies between two samples does not show in their values.
    """
    pairs = np.stack([looked.lines[..., 1:3], looked.lines[..., 2:4]]).reshape(-1, 2)
    across = pairs[(pairs[:, 0] > 0) != (pairs[:, 1] > 0)]
    if len(across) < ENOUGH:
        return False
    low, high = np.quantile(looked.lines, [STEP_TAIL, 1 - STEP_TAIL])
    jumps = np.abs(across[:, 1] - across[:, 0])
    return bool(np.median(jumps) > STEP * (high - low))


def _slope_within(looked: Looked) -> float:
    """Return the typical change of the values between a sample and its neighbours, none cut off.

    Of the pairs beside the surface, the steepest along an axis gives the slope.
    """
    low, high = looked.extremes
    line = looked.lines[..., 1:4]
    free = (line > low) & (line < high)
    change = np.where(free[..., 1:] & free[..., :-1], np.abs(np.diff(line)), 0).max(-1)
    known = (change > 0).all(1)
    lengths = np.sqrt((change[known] ** 2).sum(1))
    return float(np.median(lengths)) if len(lengths) else float("nan")


def _of_slope(
    samples: SampleArray,
    looked: Looked,
    wanted: Wanted,
    spacing: ArrayLike | None,
    inside: str,
    notes: list[str],
) -> Interpreted:
    """Return distances for a field of another slope; the given spacing is believed."""
    extremes = looked.extremes
    positive = is_positive_inside(samples, inside, extremes, notes)
    chosen = choose_spacing(samples, None, notes) if spacing is None else check_spacing(spacing)
    h = sum(chosen) / 3
    evidence = weigh(looked, h)
    cut = (evidence.cut_low or evidence.cut_high) and wanted.field != SCALED
    slope = _slope_within(looked) / h if cut else evidence.slope
    if not np.isfinite(slope):
        slope = typical_length(*surface_gradients(samples)) / h
    found = Interpreted(samples, extremes, chosen, positive, Field())
    scaled = _scaled_look(looked, slope)
    divided = weigh(scaled, h)
    # densities that fade out over voxels are blurred, not cut off
    fades = wanted.level is not None and _cut_at(scaled.extremes, divided, h) > TOO_NEAR
    if cut and not (divided.is_bent or fades):
        if abs(slope - 1) > SLOPE_OFF:
            notes.append(f"the values are divided by their slope, {slope:.4g} instead of 1")
            found = _divided(found, slope)
        return _truncated(found, divided, wanted, notes)
    return _scaled(found, replace(evidence, slope=slope), wanted, notes)


def _scaled_look(looked: Looked, slope: float) -> Looked:
    """Return what would have been seen of the values divided by a slope."""
    low, high = looked.extremes
    return replace(looked, lines=looked.lines / slope, extremes=(low / slope, high / slope))


def _divided(found: Interpreted, slope: float) -> Interpreted:
    """Return values divided by a slope."""
    low, high = found.extremes
    divided = _derived(found.samples, lambda v: v / slope)
    return replace(found, samples=divided, extremes=(low / slope, high / slope))


def _as_shown(
    found: Interpreted, evidence: Evidence, wanted: Wanted, notes: list[str]
) -> Interpreted:
    """Return distances with the kind that the evidence shows."""
    h = sum(found.spacing) / 3
    is_cut = _cut_at(found.extremes, evidence, h) < HARMLESS and not evidence.is_bent
    if is_cut or wanted.field == TRUNCATED:
        return _truncated(found, evidence, wanted, notes)
    if evidence.is_noisy:
        field = replace(found.field, kind=NOISY, evidence=evidence.report())
        notes.append(
            f"values taken as noisy (--field noisy): at {100 * evidence.noisy:.2g} % of the "
            "samples beside the surface they change by more than distances can; the noise is at "
            f"most about {evidence.roughness:.2g} voxels"
        )
        return replace(found, field=field)
    if evidence.is_scaled:
        return _scaled(found, evidence, wanted, notes)
    return replace(found, field=replace(found.field, evidence=evidence.report()))


def _cut_at(extremes: Extremes, evidence: Evidence, h: float) -> float:
    """Return at how many voxels from the surface values are cut off; infinite if they are not."""
    low = -extremes[0] / h if evidence.cut_low else np.inf
    high = extremes[1] / h if evidence.cut_high else np.inf
    return float(min(low, high))


def _truncated(
    found: Interpreted, evidence: Evidence, wanted: Wanted, notes: list[str]
) -> Interpreted:
    """Return truncated distances, the missing ones filled in if that helps."""
    h, limits = sum(found.spacing) / 3, found.extremes
    at = _cut_at(limits, evidence, h)
    low, high = limits if not found.positive_inside else (-limits[1], -limits[0])
    below, above = evidence.cut_low, evidence.cut_high
    if found.positive_inside:
        below, above = above, below
    exact = low if below else -np.inf, high if above else np.inf
    field = Field(TRUNCATED, wanted.field == TRUNCATED, exact, evidence=evidence.report())
    samples = found.samples
    if at < TOO_NEAR:
        sign = -1.0 if found.positive_inside else 1.0
        field = replace(field, smooth=_derived(samples, lambda v: v * sign))
    elif at < FILLED:
        samples = filled_planes(samples, h, limits)
    if np.isfinite(at):
        notes.append(
            f"values taken as truncated (--field truncated): cut off {at:.3g} voxels from the "
            "surface"
        )
    return replace(found, samples=samples, field=field)


def _scaled(
    found: Interpreted, evidence: Evidence, wanted: Wanted, notes: list[str]
) -> Interpreted:
    """Return a field of another slope, divided by it; its cubic spline has the surface."""
    h = sum(found.spacing) / 3
    slope = evidence.slope if np.isfinite(evidence.slope) else 1.0
    sign = (-1 if found.positive_inside else 1) / slope
    smooth = _derived(found.samples, lambda v: v * sign)
    field = Field(SCALED, wanted.field == SCALED, NONE_EXACT, smooth)
    field = replace(field, has_kinks=evidence.wrong < BENT, evidence=evidence.report())
    why = f"beside the surface their slope is {slope:.4g} instead of 1"
    if evidence.is_bent:
        why += f", and wrong at {100 * evidence.wrong:.2g} % of the samples"
    notes.append(
        f"values taken as scaled (--field scaled): {why}; where they are smooth, the surface is "
        "that of their cubic spline"
    )
    low, high = (x / slope for x in found.extremes)
    samples = normalised_planes(found.samples, h, slope)
    return replace(found, samples=samples, extremes=(low, high), field=field)
