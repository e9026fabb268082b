"""Distances out of values that change from sample to sample: exact, noisy, truncated and scaled.

A scaled or closely truncated field is meshed by its cubic spline, which is the same whatever the
spacings. So it becomes distances on its lattice, and unequal spacings are no matter.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..arrays import Triple
from .advice import is_density, refusal
from .census import Census, Extremes
from .evidence import SLOPE_OFF, Evidence, is_projective, slope_within, weigh
from .field import (
    AUTO,
    NOISY,
    NONE_EXACT,
    SCALED,
    TRUNCATED,
    Field,
    Interpreted,
    Request,
)
from .one_sided import UNSIGNED, find_fault
from .placement import is_cubic, steps_of
from .planes import SampleArray, changed
from .slopes import normalised_planes
from .spacing import choose_spacing, is_positive_inside, measure_spacing
from .truncation import filled_planes, without_plateaus

# Voxels from which on values may be cut off without a loss; up to which the rest is filled in; and
# below which too few are left for that.
HARMLESS, FILLED, TOO_NEAR = 3.0, 1.75, 0.85
ALIKE = 0.02  # slopes beside the surface and elsewhere, of distances in another unit
SAME_SLOPE = 5e-5  # from 1: in words it is 1
BENT = 0.1  # share of wrong slopes from which the network has no say in a field


def as_distances(
    samples: SampleArray,
    census: Census,
    request: Request,
    notes: list[str],
    *,
    is_cut: bool = False,
) -> Interpreted:
    """Return values that are taken as distances, exact or noisy ones, some perhaps cut off."""
    wanted = request.wanted.field
    positive = is_positive_inside(census, request.inside, notes)
    spacing = choose_spacing(census, request.spacing, notes, is_cut=is_cut)
    if census.is_one_sided:
        _check_thin(census, spacing, request)
    field = Field(NOISY, exact=NONE_EXACT) if wanted == NOISY else Field()
    field = replace(field, given=not request.is_auto)
    return Interpreted(samples, census.extremes, spacing, positive, field)


def _check_thin(census: Census, spacing: Triple, request: Request) -> None:
    """Raise GridError unless values on one side of 0 can be distances to a thin solid.

    If the user says which side is inside, they only must be distances: there may be an offset.
    """
    if request.inside == AUTO:
        fault = find_fault(census, steps_of(spacing))
    else:
        fault = UNSIGNED if is_density(census, spacing) else ""
    if fault:
        raise refusal(census, spacing, fault)


def by_kind(found: Interpreted, census: Census, request: Request, notes: list[str]) -> Interpreted:
    """Return values that were taken as distances with the kind that the samples show."""
    looked = census.looked
    evidence = weigh(looked, found.spacing)
    near = _cut_at(found, evidence) < HARMLESS
    if is_projective(looked, found.spacing) or (near and evidence.is_noisy):
        return _projective(found, evidence, request, notes)
    is_cut = near and not evidence.is_bent
    if is_cut or request.wanted.field == TRUNCATED:
        return _truncated(found, evidence, request, notes)
    if evidence.is_noisy:
        return _noisy(found, evidence, notes)
    if evidence.is_scaled:
        in_unit = _in_another_unit(found, census, notes)
        return in_unit or _scaled(found, evidence, request, notes)
    return replace(found, field=replace(found.field, evidence=evidence.report()))


def _in_another_unit(found: Interpreted, census: Census, notes: list[str]) -> Interpreted | None:
    """Return distances that only have another unit than the spacing, in the spacing's."""
    if not is_cubic(found.spacing):
        return None
    unit, looked = measure_spacing(census) / found.spacing[0], census.looked
    beside = weigh(looked, found.spacing)
    if np.isfinite(beside.slope) and np.isfinite(unit):
        if abs(beside.slope / unit - 1) > ALIKE:
            return None
        unit = beside.slope
    evidence = weigh(looked.divided(unit), found.spacing)
    if not np.isfinite(unit) or evidence.is_scaled or evidence.is_noisy:
        return None
    notes.append(
        f"the values are distances in another unit: multiplied by {1 / unit:.6g} (give --scale)"
    )
    divided = _divided(found, unit)
    return replace(divided, field=replace(found.field, evidence=evidence.report()))


def of_slope(
    samples: SampleArray, census: Census, request: Request, notes: list[str]
) -> Interpreted:
    """Return distances for a field of another slope; the given spacing is believed."""
    if census.is_one_sided:
        raise refusal(census, request.spacing)
    looked, positive = census.looked, is_positive_inside(census, request.inside, notes)
    spacing = request.spacing or choose_spacing(census, None, notes)
    found = Interpreted(samples, looked.extremes, spacing, positive, Field())
    evidence = weigh(looked, spacing)
    is_cut = (evidence.cut_low or evidence.cut_high) and request.wanted.field != SCALED
    slope = evidence.slope
    if is_cut and not np.isfinite(slope):
        slope = slope_within(looked, spacing)
    if not np.isfinite(slope):
        slope = census.beside.in_finest(spacing).typical_length / min(steps_of(spacing))
    divided = _divided(found, slope)
    shown = weigh(looked.divided(slope), spacing)
    if is_cut and (shown.is_noisy or is_projective(looked, spacing)):
        return _projective(divided, shown, request, notes)
    # densities that fade out over voxels are blurred, not cut off
    fades = request.is_density and _cut_at(divided, shown) > TOO_NEAR
    if not is_cut or shown.is_bent or fades:
        return _scaled(found, replace(evidence, slope=slope), request, notes)
    if abs(slope - 1) > SLOPE_OFF:
        notes.append(f"the values are divided by their slope, {slope:.4g} instead of 1")
        found = divided
    return _truncated(found, shown, request, notes)


def _divided(found: Interpreted, slope: float) -> Interpreted:
    """Return values divided by a slope."""
    low, high = found.extremes
    divided = changed(found.samples, lambda v: v / slope)
    return replace(found, samples=divided, extremes=(low / slope, high / slope))


def _cut_at(found: Interpreted, evidence: Evidence) -> float:
    """Return at how many voxels from the surface values are cut off; infinite if they are not.

    Where the spacings differ, voxels are as long as the longest one.
    """
    h = max(steps_of(found.spacing))
    low = -found.extremes[0] / h if evidence.cut_low else np.inf
    high = found.extremes[1] / h if evidence.cut_high else np.inf
    return float(min(low, high))


def _truncated(
    found: Interpreted, evidence: Evidence, request: Request, notes: list[str]
) -> Interpreted:
    """Return truncated distances, the missing ones filled in if that helps."""
    at = _cut_at(found, evidence)
    field = Field(TRUNCATED, request.wanted.field == TRUNCATED, _exact_within(found, evidence))
    found = replace(found, field=replace(field, evidence=evidence.report()))
    if np.isfinite(at):
        notes.append(
            f"values taken as truncated (--field truncated): cut off {at:.3g} voxels from the "
            "surface"
        )
    if at < TOO_NEAR:
        return _as_spline(found)
    if at < FILLED:
        filled = filled_planes(found.samples, steps_of(found.spacing), found.extremes)
        return replace(found, samples=filled)
    return found


def _projective(
    found: Interpreted, evidence: Evidence, request: Request, notes: list[str]
) -> Interpreted:
    """Return values of uneven slope, as fused depth images have: their spline has the surface."""
    notes.append(
        "values taken as truncated (--field truncated), and none as exact, since their slope is "
        "uneven, as that of fused depth images: the surface is that of their cubic spline"
    )
    given = request.wanted.field == TRUNCATED
    field = Field(TRUNCATED, given, NONE_EXACT, is_uneven=True)
    return _as_spline(replace(found, field=replace(field, evidence=evidence.report())))


def _exact_within(found: Interpreted, evidence: Evidence) -> Extremes:
    """Return the values, negative inside, between which truncated distances can be exact."""
    low = found.extremes[0] if evidence.cut_low else -np.inf
    high = found.extremes[1] if evidence.cut_high else np.inf
    return (-high, -low) if found.positive_inside else (low, high)


def _as_spline(found: Interpreted) -> Interpreted:
    """Return distances that were cut off too near the surface, to be meshed by their spline."""
    sign = -1.0 if found.positive_inside else 1.0
    smooth = changed(found.samples, lambda v: v * sign)
    field = replace(found.field, smooth=smooth)
    if not is_cubic(found.spacing):  # the spheres of samples are none on the lattice
        field = replace(field, on_lattice=True, exact=NONE_EXACT)
    samples = without_plateaus(found.samples, found.extremes, min(steps_of(found.spacing)))
    return replace(found, samples=samples, field=field)


def _noisy(found: Interpreted, evidence: Evidence, notes: list[str]) -> Interpreted:
    """Return noisy distances, and say how noisy they are."""
    notes.append(
        f"values taken as noisy (--field noisy): at {evidence.noisy:.1%} of the "
        "samples beside the surface they change by more than distances can; the noise is at "
        f"most about {evidence.roughness:.2g} voxels"
    )
    return replace(found, field=replace(found.field, kind=NOISY, evidence=evidence.report()))


def _scaled(
    found: Interpreted, evidence: Evidence, request: Request, notes: list[str]
) -> Interpreted:
    """Return a field of another slope, divided by it; its cubic spline has the surface."""
    slope = evidence.slope if np.isfinite(evidence.slope) else 1.0
    notes.append(
        f"values taken as scaled (--field scaled): {_wrong_slope(slope, evidence)}; where they are "
        "smooth, the surface is that of their cubic spline"
    )
    sign = (-1 if found.positive_inside else 1) / slope
    field = Field(
        SCALED,
        request.wanted.field == SCALED,
        NONE_EXACT,
        smooth=changed(found.samples, lambda v: v * sign),
        has_kinks=_has_distances(evidence) and is_cubic(found.spacing),
        on_lattice=not is_cubic(found.spacing),
        evidence=evidence.report(),
    )
    low, high = (x / slope for x in found.extremes)
    return replace(found, samples=_on_lattice(found, slope), extremes=(low, high), field=field)


def _has_distances(evidence: Evidence) -> bool:
    """Return whether a field has the slope of a distance almost everywhere, as next to kinks."""
    is_cut = evidence.cut_low or evidence.cut_high
    known = evidence.is_enough and not is_cut
    contradictory = evidence.is_too_steep or evidence.is_contradictory
    return known and evidence.wrong < BENT and not contradictory


def _wrong_slope(slope: float, evidence: Evidence) -> str:
    """Return a clause that says how the slope of a field is wrong."""
    typical = f"beside the surface their slope is {slope:.4g} instead of 1"
    bent = f"that of a distance at {evidence.wrong:.1%} of the samples"
    if abs(slope - 1) < SAME_SLOPE:
        return f"beside the surface their slope is not {bent}"
    return f"{typical}, and not {bent}" if evidence.is_bent else typical


def _on_lattice(found: Interpreted, slope: float) -> SampleArray:
    """Return values over their slope on the lattice, which is typically the mean of its steps."""
    steps = steps_of(found.spacing)
    step = steps[0] if is_cubic(found.spacing) else float(np.exp(np.log(steps).mean()))
    return normalised_planes(found.samples, min(steps), step * slope)
