"""Distances out of values that change from sample to sample: exact, noisy, truncated and scaled.

A scaled or closely truncated field is meshed by its cubic spline, which is the same whatever the
spacings. So it becomes distances on its lattice, and unequal spacings are no matter.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..arrays import Triple
from .census import Census, Extremes
from .derived import filled_planes, normalised_planes, without_plateaus
from .field import (
    AUTO,
    NOISY,
    NONE_EXACT,
    SCALED,
    SLOPE_OFF,
    TRUNCATED,
    Evidence,
    Field,
    Interpreted,
    Request,
    is_projective,
    slope_within,
    weigh,
)
from .one_sided import UNSIGNED, find_fault
from .placement import is_cubic, steps_of
from .planes import SampleArray, changed
from .spacing import (
    choose_spacing,
    is_density,
    is_positive_inside,
    measure_spacing,
    refusal,
)

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


def by_kind(taken: Interpreted, census: Census, request: Request, notes: list[str]) -> Interpreted:
    """Return values that were taken as distances with the kind that the samples show."""
    looked = census.looked
    evidence = weigh(looked, taken.spacing)
    near = _cut_at(taken, evidence) < HARMLESS
    if is_projective(looked, taken.spacing) or (near and evidence.is_noisy):
        return _projective(taken, evidence, request, notes)
    if (near and not evidence.is_bent) or request.wanted.field == TRUNCATED:
        return _truncated(taken, evidence, request, notes)
    if evidence.is_noisy:
        notes.append(
            f"values taken as noisy (--field noisy): at {evidence.noisy:.1%} of the "
            "samples beside the surface they change by more than distances can; the noise is at "
            f"most about {evidence.roughness:.2g} voxels"
        )
        return taken.with_field(kind=NOISY, evidence=evidence.report())
    if evidence.is_scaled:
        in_unit = _in_another_unit(taken, census, notes)
        return in_unit or _scaled(taken, evidence, request, notes)
    return taken.with_field(evidence=evidence.report())


def _in_another_unit(taken: Interpreted, census: Census, notes: list[str]) -> Interpreted | None:
    spacing, looked = taken.spacing, census.looked
    if not is_cubic(spacing):
        return None
    unit, slope = measure_spacing(census) / spacing[0], weigh(looked, spacing).slope
    if np.isfinite(slope) and np.isfinite(unit):
        if abs(slope / unit - 1) > ALIKE:
            return None
        unit = slope
    evidence = weigh(looked.divided(unit), spacing)
    if not np.isfinite(unit) or evidence.is_scaled or evidence.is_noisy:
        return None
    notes.append(
        f"the values are distances in another unit: multiplied by {1 / unit:.6g} (give --scale)"
    )
    return taken.divided(unit).with_field(evidence=evidence.report())


def of_slope(
    samples: SampleArray, census: Census, request: Request, notes: list[str]
) -> Interpreted:
    """Return distances for a field of another slope; the given spacing is believed."""
    if census.is_one_sided:
        raise refusal(census, request.spacing)
    looked, positive = census.looked, is_positive_inside(census, request.inside, notes)
    spacing = request.spacing or choose_spacing(census, None, notes)
    taken = Interpreted(samples, looked.extremes, spacing, positive, Field())
    evidence = weigh(looked, spacing)
    is_cut = (evidence.cut_low or evidence.cut_high) and request.wanted.field != SCALED
    slope = evidence.slope
    if is_cut and not np.isfinite(slope):
        slope = slope_within(looked, spacing)
    if not np.isfinite(slope):
        slope = census.beside.in_finest(spacing).typical_length / min(steps_of(spacing))
    divided = taken.divided(slope)
    shown = weigh(looked.divided(slope), spacing)
    if is_cut and (shown.is_noisy or is_projective(looked, spacing)):
        return _projective(divided, shown, request, notes)
    # densities that fade out over voxels are blurred, not cut off
    fades = request.is_density and _cut_at(divided, shown) > TOO_NEAR
    if not is_cut or shown.is_bent or fades:
        return _scaled(taken, evidence._replace(slope=slope), request, notes)
    if abs(slope - 1) <= SLOPE_OFF:
        return _truncated(taken, shown, request, notes)
    notes.append(f"the values are divided by their slope, {slope:.4g} instead of 1")
    return _truncated(divided, shown, request, notes)


def _cut_at(taken: Interpreted, evidence: Evidence) -> float:
    """Return at how many of the longest spacings values are cut off; infinite if they are not."""
    low, high = _uncut(taken.extremes, evidence)
    return min(-low, high) / max(steps_of(taken.spacing))


def _uncut(extremes: Extremes, evidence: Evidence) -> Extremes:
    low, high = extremes
    return (low if evidence.cut_low else -np.inf), (high if evidence.cut_high else np.inf)


def _truncated(
    taken: Interpreted, evidence: Evidence, request: Request, notes: list[str]
) -> Interpreted:
    at, (low, high) = _cut_at(taken, evidence), _uncut(taken.extremes, evidence)
    exact = (-high, -low) if taken.positive_inside else (low, high)
    field = Field(TRUNCATED, request.wanted.field == TRUNCATED, exact, evidence=evidence.report())
    taken = replace(taken, field=field)
    if np.isfinite(at):
        notes.append(
            f"values taken as truncated (--field truncated): cut off {at:.3g} voxels from the "
            "surface"
        )
    if at < TOO_NEAR:
        return _as_spline(taken)
    if at < FILLED:
        whole = filled_planes(taken.samples, steps_of(taken.spacing), taken.extremes)
        return replace(taken, samples=whole)
    return taken


def _projective(
    taken: Interpreted, evidence: Evidence, request: Request, notes: list[str]
) -> Interpreted:
    notes.append(
        "values taken as truncated (--field truncated), and none as exact, since their slope is "
        "uneven, as that of fused depth images: the surface is that of their cubic spline"
    )
    given, report = request.wanted.field == TRUNCATED, evidence.report()
    field = Field(TRUNCATED, given, NONE_EXACT, is_uneven=True, evidence=report)
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


def _scaled(
    taken: Interpreted, evidence: Evidence, request: Request, notes: list[str]
) -> Interpreted:
    """Return a field of another slope, divided by it; its cubic spline has the surface.

    On its lattice the step is typically the mean of those of the axes.
    """
    slope = evidence.slope if np.isfinite(evidence.slope) else 1.0
    bent = f"that of a distance at {evidence.wrong:.1%} of the samples"
    wrong = f"beside the surface their slope is {slope:.4g} instead of 1"
    if abs(slope - 1) < SAME_SLOPE:
        wrong = f"beside the surface their slope is not {bent}"
    elif evidence.is_bent:
        wrong += f", and not {bent}"
    notes.append(
        f"values taken as scaled (--field scaled): {wrong}; where they are "
        "smooth, the surface is that of their cubic spline"
    )
    sign = (-1 if taken.positive_inside else 1) / slope
    steps, cubic = steps_of(taken.spacing), is_cubic(taken.spacing)
    step = steps[0] if cubic else float(np.exp(np.log(steps).mean()))
    field = Field(
        SCALED,
        request.wanted.field == SCALED,
        NONE_EXACT,
        smooth=changed(taken.samples, lambda values: values * sign),
        has_kinks=_has_distances(evidence) and cubic,
        on_lattice=not cubic,
        evidence=evidence.report(),
    )
    low, high = (x / slope for x in taken.extremes)
    samples = normalised_planes(taken.samples, min(steps), step * slope)
    return replace(taken, samples=samples, extremes=(low, high), field=field)


def _has_distances(evidence: Evidence) -> bool:
    """Return whether a field has the slope of a distance almost everywhere, as next to kinks."""
    is_cut = evidence.cut_low or evidence.cut_high
    contradictory = evidence.is_too_steep or evidence.is_contradictory
    return evidence.is_enough and not is_cut and evidence.wrong < BENT and not contradictory
