"""Distances out of values that change from sample to sample: exact, noisy, truncated and scaled.

Their sign and spacing are as given, or as the values show them. A scaled or closely truncated field
is meshed by its cubic spline, which is the same whatever the spacings. So it becomes distances on
its lattice, and unequal spacings are no matter.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..arrays import Triple
from ..errors import GridError
from ..options import AUTO, NOISY, SCALED, TRUNCATED
from .census import Census, Extremes
from .derived import filled_planes, normalised_planes, without_plateaus
from .field import (NONE_EXACT, SLOPE_OFF, Case, Evidence, Field, Interpreted, is_projective, slope_within, weigh)
from .placement import LEAST_SPACING, MOST_SPACING, check_spacing, is_cubic, steps_of
from .planes import changed
from .refusals import SNAP, UNSIGNED, find_fault, is_density, refusal, way_out
from .slopes import ENOUGH, Floats, Gradients

CLEARLY_UNEQUAL = 1.1  # ratio of estimated spacings, from which on they are taken as different
TOLERATED = 1.1  # ratio of measured to given spacing, or its inverse, above which there is a note
# Distances cannot change by more than the samples are apart. Larger ratios are refused: the first
# limit applies to gradients that agree with each other, the second to noisy or bent fields. They
# do change by less at thin parts and where they are truncated, so that is never refused.
REFUSED, REFUSED_IF_UNSURE = 1.25, 2.0
# Voxels from which on values may be cut off without a loss; up to which the rest is filled in; and
# below which too few are left for that.
HARMLESS, FILLED, TOO_NEAR = 3.0, 1.75, 0.85
ALIKE = 0.02  # slopes beside the surface and elsewhere, of distances in another unit
SAME_SLOPE = 5e-5  # from 1: in words it is 1
BENT = 0.1  # share of wrong slopes from which the network has no say in a field


def check_negative_inside(census: Census) -> None:
    """Raise GridError if most of the border is negative: the sign seems to be reversed."""
    below = census.border_shares()[0]
    if below > 0.5:
        raise GridError(
            f"{below:.0%} of the grid's border is negative, which is inside: make the grid "
            "with make_grid(values, spacing=..., inside='positive'), or inside='negative' if the "
            "solid does run out of the grid there"
        )


def _is_positive_inside(case: Case) -> bool:
    """Return whether the values are positive inside; for "auto" the border counts as outside."""
    if case.wanted.inside != AUTO:
        return case.wanted.inside == "positive"
    if case.census.is_one_sided:
        return case.census.numbers.low < 0
    below = case.census.border_shares()[0]
    positive, share = below > 0.5, max(below, 1 - below)
    if positive or share < 1:
        sign = "positive" if positive else "negative"
        case.notes.append(
            f"{sign} values are taken as inside: {share:.0%} of the grid's border has the other "
            "sign (if that is wrong, use --inside)"
        )
    return positive


def choose_spacing(
    census: Census, given: Triple | None, *, is_cut: bool = False
) -> tuple[Triple, list[str]]:
    """Return the given spacing, or else that of the values, and notes if it is not sure.

    GridError if the values change by more than the given spacing allows, or show none. Values that
    are cut off may change by less along an axis with a large spacing.
    """
    if given is not None:
        return given, _check_given(census, given, is_cut) if len(census.beside.bend) else []
    beside, everywhere = census.beside, census.everywhere
    unequal = beside.of_axes or everywhere.of_axes
    agree = len(everywhere.bend) < ENOUGH or everywhere.agree_with(everywhere.typical_length)
    each = everywhere.spacing if unequal or not agree else None
    if each is not None and each.max() > CLEARLY_UNEQUAL * each.min():
        return _snap_axes(each)
    if unequal:
        steps = ", ".join(f"{step:.4g} along {name}" for name, step in unequal.items())
        raise GridError(
            f"spacing not given: the values change by {steps} from sample to sample, and do not "
            f"show it for all axes; {way_out(census)}"
        )
    return _snap(_measure(everywhere, beside), census.shape)


def _snap_axes(each: Floats) -> tuple[Triple, list[str]]:
    """Return the estimated spacings of the axes, those that are nearly equal as one."""
    each = each.copy()
    for near in each.copy():  # axes that are equal but for the error of the estimate
        alike = np.abs(each / near - 1) <= SNAP
        each[alike] = each[alike].mean()
    spacing = check_spacing(each)
    return spacing, [
        f"spacing not given: estimated as {', '.join(f'{h:.6g}' for h in spacing)} along x, y, z "
        "from the values, so the size of the mesh is approximate (give --spacing)"
    ]


def _snap(measured: float, shape: tuple[int, ...]) -> tuple[Triple, list[str]]:
    """Return the measured spacing, or a usual one close to it."""
    if not LEAST_SPACING <= measured <= MOST_SPACING:
        raise GridError(
            f"spacing not given: the values change by {measured:.6g} from sample to sample; give "
            f"--spacing, in a unit in which it is between {LEAST_SPACING:g} and {MOST_SPACING:g}"
        )
    n = max(shape)
    usual = {"1": 1.0} | {f"{a}/{b}": a / b for a in (1, 2) for b in (n, n - 1)}
    name = min(usual, key=lambda key: abs(np.log(usual[key] / measured)))
    if abs(measured / usual[name] - 1) <= SNAP:
        note = f"spacing not given: taken as {name}, the values show {measured:.6g}"
        return (usual[name],) * 3, [note]
    return (measured,) * 3, [
        f"spacing not given: estimated as {measured:.6g} from the values, so the size of the mesh "
        "is approximate (give --spacing)"
    ]


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


def _check_given(census: Census, spacing: Triple, is_cut: bool) -> list[str]:
    """Return a note, or raise GridError, if the values contradict the given spacing.

    They do if they change by more. Exact distances change by less beside thin parts: there is no
    note if the rest of the field agrees with the spacing.
    """
    h, beside = min(steps_of(spacing)), census.beside.in_finest(spacing)
    if not is_cut:
        _check_axes(census, beside, spacing)
    measured = beside.typical_length
    named = f"{spacing[0]:.6g}" if is_cubic(spacing) else f"{h:.6g} along the finest axis"
    observed = f"the values change by {measured:.6g} from sample to sample, but spacing is {named}"
    allowed = REFUSED if beside.agree_with(measured) else REFUSED_IF_UNSURE
    if measured > allowed * h:
        raise GridError(f"{observed}: {way_out(census, spacing)}")
    if h / TOLERATED <= measured <= h * TOLERATED:
        return []
    if measured < h:
        everywhere = census.everywhere.in_finest(spacing)
        if not is_cut:
            _check_axes(census, everywhere, spacing)
        if h / TOLERATED <= _measure(everywhere, beside) <= h * TOLERATED:
            return []
    return [f"{observed}: they are not exact distances, or the unit is wrong"]


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


def as_distances(case: Case, *, is_cut: bool = False) -> Interpreted:
    """Return values that are taken as distances, exact or noisy ones, some perhaps cut off."""
    census, positive = case.census, _is_positive_inside(case)
    spacing, notes = choose_spacing(census, case.spacing, is_cut=is_cut)
    case.notes.extend(notes)
    if census.is_one_sided:  # if the user says which side is inside, there may be an offset
        if case.wanted.inside == AUTO:
            fault = find_fault(census, steps_of(spacing))
        else:
            fault = UNSIGNED if is_density(census, spacing) else ""
        if fault:
            raise refusal(census, spacing, fault)
    field = Field(NOISY, exact=NONE_EXACT) if case.wanted.field == NOISY else Field()
    return Interpreted(case.samples, census.extremes, spacing, positive, field)


def by_kind(taken: Interpreted, case: Case) -> Interpreted:
    """Return values that were taken as distances with the kind that the samples show."""
    looked = case.census.looked
    evidence = weigh(looked, taken.spacing)
    near = _cut_at(taken, evidence) < HARMLESS
    if is_projective(looked, taken.spacing) or (near and evidence.is_noisy):
        return _projective(taken, evidence, case)
    if (near and not evidence.is_bent) or case.wanted.field == TRUNCATED:
        return _truncated(taken, evidence, case)
    if evidence.is_noisy:
        case.notes.append(
            f"values taken as noisy (--field noisy): at {evidence.noisy:.1%} of the "
            "samples beside the surface they change by more than distances can; the noise is at "
            f"most about {evidence.roughness:.2g} voxels"
        )
        return taken.with_field(kind=NOISY, evidence=evidence.report())
    if evidence.is_scaled:
        return _in_another_unit(taken, evidence, case) or _scaled(taken, evidence, case)
    return taken.with_field(evidence=evidence.report())


def _in_another_unit(taken: Interpreted, evidence: Evidence, case: Case) -> Interpreted | None:
    """Return distances that only have another unit than the spacing, in the spacing's."""
    spacing, census = taken.spacing, case.census
    if not is_cubic(spacing) or not (len(census.everywhere.bend) or len(census.beside.bend)):
        return None
    unit, slope = _measure(census.everywhere, census.beside) / spacing[0], evidence.slope
    if np.isfinite(slope):
        if abs(slope / unit - 1) > ALIKE:
            return None
        unit = slope
    evidence = weigh(census.looked.divided(unit), spacing)
    if evidence.is_scaled or evidence.is_noisy:
        return None
    case.notes.append(
        f"the values are distances in another unit: multiplied by {1 / unit:.6g} (give --scale)"
    )
    return taken.divided(unit).with_field(evidence=evidence.report())


def of_slope(case: Case) -> Interpreted:
    """Return distances for a field of another slope; the given spacing is believed."""
    census, looked = case.census, case.census.looked
    if census.is_one_sided:
        raise refusal(census, case.spacing)
    positive = _is_positive_inside(case)
    spacing, notes = (case.spacing, []) if case.spacing else choose_spacing(census, None)
    case.notes.extend(notes)
    taken = Interpreted(case.samples, looked.extremes, spacing, positive, Field())
    evidence = weigh(looked, spacing)
    is_cut, slope = evidence.is_cut and case.wanted.field != SCALED, evidence.slope
    if is_cut and not np.isfinite(slope):
        slope = slope_within(looked, spacing)
    if not np.isfinite(slope):
        slope = census.beside.in_finest(spacing).typical_length / min(steps_of(spacing))
    divided = taken.divided(slope)
    shown = weigh(looked.divided(slope), spacing)
    if is_cut and (shown.is_noisy or is_projective(looked, spacing)):
        return _projective(divided, shown, case)
    # densities that fade out over voxels are blurred, not cut off
    fades = case.is_density and _cut_at(divided, shown) > TOO_NEAR
    if not is_cut or shown.is_bent or fades:
        return _scaled(taken, evidence._replace(slope=slope), case)
    if abs(slope - 1) <= SLOPE_OFF:
        return _truncated(taken, shown, case)
    case.notes.append(f"the values are divided by their slope, {slope:.4g} instead of 1")
    return _truncated(divided, shown, case)


def _cut_at(taken: Interpreted, evidence: Evidence) -> float:
    """Return at how many of the longest spacings values are cut off; infinite if they are not."""
    low, high = _uncut(taken.extremes, evidence)
    return min(-low, high) / max(steps_of(taken.spacing))


def _uncut(extremes: Extremes, evidence: Evidence) -> Extremes:
    low, high = extremes
    return (low if evidence.cut_low else -np.inf), (high if evidence.cut_high else np.inf)


def _truncated(taken: Interpreted, evidence: Evidence, case: Case) -> Interpreted:
    """Return truncated distances, the missing ones filled in if that helps."""
    at, (low, high) = _cut_at(taken, evidence), _uncut(taken.extremes, evidence)
    exact = (-high, -low) if taken.positive_inside else (low, high)
    taken = replace(taken, field=Field(TRUNCATED, exact=exact, evidence=evidence.report()))
    if np.isfinite(at):
        case.notes.append(
            f"values taken as truncated (--field truncated): cut off {at:.3g} voxels from the "
            "surface"
        )
    if at < TOO_NEAR:
        return _as_spline(taken)
    if at < FILLED:
        whole = filled_planes(taken.samples, steps_of(taken.spacing), taken.extremes)
        return replace(taken, samples=whole)
    return taken


def _projective(taken: Interpreted, evidence: Evidence, case: Case) -> Interpreted:
    """Return values of uneven slope, as fused depth images have: their spline has the surface."""
    case.notes.append(
        "values taken as truncated (--field truncated), and none as exact, since their slope is "
        "uneven, as that of fused depth images: the surface is that of their cubic spline"
    )
    field = Field(TRUNCATED, exact=NONE_EXACT, is_uneven=True, evidence=evidence.report())
    return _as_spline(replace(taken, field=field))


def _as_spline(taken: Interpreted) -> Interpreted:
    """Return distances that were cut off too near the surface, to be meshed by their spline."""
    sign = -1.0 if taken.positive_inside else 1.0
    smooth = changed(taken.samples, lambda values: values * sign)
    samples = without_plateaus(taken.samples, taken.extremes, min(steps_of(taken.spacing)))
    taken = replace(taken, samples=samples).with_field(smooth=smooth)
    if is_cubic(taken.spacing):
        return taken
    return taken.with_field(on_lattice=True, exact=NONE_EXACT)  # where spheres are none


def _scaled(taken: Interpreted, evidence: Evidence, case: Case) -> Interpreted:
    """Return a field of another slope, divided by it; its cubic spline has the surface.

    On its lattice the step is typically the mean of those of the axes. The slope of the field may
    be that of a distance almost everywhere, as next to kinks.
    """
    slope = evidence.slope if np.isfinite(evidence.slope) else 1.0
    bent = f"that of a distance at {evidence.wrong:.1%} of the samples"
    wrong = f"beside the surface their slope is {slope:.4g} instead of 1"
    if abs(slope - 1) < SAME_SLOPE:
        wrong = f"beside the surface their slope is not {bent}"
    elif evidence.is_bent:
        wrong += f", and not {bent}"
    case.notes.append(
        f"values taken as scaled (--field scaled): {wrong}; where they are "
        "smooth, the surface is that of their cubic spline"
    )
    sign = (-1 if taken.positive_inside else 1) / slope
    steps, cubic = steps_of(taken.spacing), is_cubic(taken.spacing)
    step = steps[0] if cubic else float(np.exp(np.log(steps).mean()))
    contradictory = evidence.is_too_steep or evidence.is_contradictory
    has_distances = evidence.is_enough and not evidence.is_cut and evidence.wrong < BENT
    field = Field(
        SCALED,
        exact=NONE_EXACT,
        smooth=changed(taken.samples, lambda values: values * sign),
        has_kinks=has_distances and not contradictory and cubic,
        on_lattice=not cubic,
        evidence=evidence.report(),
    )
    low, high = (x / slope for x in taken.extremes)
    samples = normalised_planes(taken.samples, min(steps), step * slope)
    return replace(taken, samples=samples, extremes=(low, high), field=field)
