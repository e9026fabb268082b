"""From values of any kind to distances near the surface: what they are, and the best way there.

The evidence is gathered once (``census``, ``field``); the user may overrule it. The zero level
never moves. A scaled or closely truncated field is meshed by its cubic spline, which is the same
whatever the spacings: it becomes distances on its lattice.

Of values that are refused, the message names the one option to try next. Those without a sample
inside are the hardest. A wall thinner than the spacing may pass between the samples, which are then
all outside, but the sphere of each touches the wall and contains none of it. Other fields have no
inside either: unsigned distances to a thick solid, and values that stay above 0.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import CENTRE, NEIGHBOURHOOD, STRIDES, BoolArray, Triple
from ..errors import GridError
from ..options import AUTO, EXACT, MASK, NOISY, SCALED, TRUNCATED, Options
from ..threads import chunks_of
from . import derived
from .census import CUT_OFF, ENOUGH, Census, Floats, Gradients, Looked, not_finite
from .field import (
    NONE_EXACT,
    SLOPE_OFF,
    Case,
    Evidence,
    Field,
    Interpreted,
    Transform,
    find_transform,
    is_normalised,
    is_projective,
    slope_within,
    weigh,
)
from .samples import (
    LEAST_SPACING,
    MOST_SPACING,
    SampleArray,
    changed,
    check_kind,
    check_spacing,
    is_cubic,
    spread_planes,
    steps_of,
)
from .unknown import Filled, filled, without_unseen

# Densities have no ramp if half of the changes across the level are this share of all there is to
# change, the lowest and the highest values left out.
STEP, STEP_TAIL = 0.85, 0.05
CLEARLY_UNEQUAL = 1.1  # ratio of estimated spacings, from which on they are taken as different
TOLERATED = 1.1  # ratio of measured to given spacing, or its inverse, above which there is a note
# Distances cannot change by more than the samples are apart. Larger ratios are refused: the first
# limit applies to gradients that agree with each other, the second to noisy or bent fields. They
# do change by less at thin parts and where they are truncated, so that is never refused.
REFUSED, REFUSED_IF_UNSURE = 1.25, 2.0
# Voxels from which on values may be cut off without a loss; up to which the rest is filled in; and
# below which too few are left for that.
HARMLESS, FILLED, TOO_NEAR = 3.0, 1.75, 0.85
SAME_UNIT = 0.02  # slopes beside the surface and elsewhere, of distances in another unit
SAME_SLOPE = 5e-5  # from 1: in words it is 1
TOO_BENT = 0.1  # share of wrong slopes from which the network has no say in a field

# Of what is refused. All lengths are in spacings, the coarsest one if they differ between axes.
MARGIN = 1.05  # on half the diagonal of a voxel
# Along a line of samples the field falls towards a wall and rises behind it, both at least so
# steeply: lines that graze the wall do not tell where it is.
STEEP = 0.25
# No wall passes between neighbouring samples whose distances add up to more than their spacing.
# Where walls cut off a region that holds a sample as deep as this, either it is the inside of a
# solid in an unsigned field, and the walls have no thickness, or the walls are thin and enclose it.
FREE, DEEP = 1.001, 0.75
# To unsigned distances a constant may have been added: then most walls are thinner than nothing.
NO_THICKNESS, UNSIGNED_SHARE, LEAST_THICKNESS = 0.03, 0.05, 0.05
MOST_FLOODED = 1 << 21  # samples; of a larger grid every second one, or third, is as exact
CANDIDATES_IN_PLANE, CANDIDATES = 8, 512  # samples near 0 whose neighbours are looked at
LIPSCHITZ, LIPSCHITZ_SHARE = 1.05, 0.9  # distances change by no more, at most samples
# Most samples' spheres touch a point that lies in no other sphere, but for the error in the
# direction to it, and the field rises from there by about 1.
TOUCHING, TOUCHING_SHARE, LEAST_RISE, MOST_RISE = 0.1, 0.5, 0.75, 3**0.5

PLANES = 12  # that are looked at, spread evenly
MOST_NAMED = 8  # labels that a message lists
ALIKE = 1.1  # ratio up to which the spacings that the axes show are one unit's
SNAP = 0.02  # a scale or spacing this close to a usual one is replaced by it
NEAR = 0.25  # of a step from the lowest value: there unsigned distances rise to both sides
VANISHING = 1e-6  # of the largest value: as good as 0
CLOSE = 0.95  # share of the full range that values reach, if it is theirs
FULL = (1, 255, 2**16 - 1)  # largest values of densities and images: the level is half of it
ROUNDS, FEW = 20, 1 << 16  # of the search for a level; samples of a plane

FAR = "every wall is nearer to some sample than that, so there is no surface"
BEYOND = "only samples on the border of the grid are near 0, so no surface lies in it"
UNSIGNED = "unsigned distances have no inside"
APPROXIMATE = "from the values, so the size of the mesh is approximate (give --spacing)"


def interpret(
    samples: SampleArray, wanted: Options, spacing: ArrayLike | None
) -> tuple[Interpreted, list[str]]:
    """Return distances for the values of a grid, and sentences on what was inferred."""
    steps = None if spacing is None else check_spacing(spacing)
    check_kind(samples.dtype, samples.shape)
    notes: list[str] = []
    if wanted.inside == AUTO and (wanted.label is not None or wanted.level is not None):
        wanted = replace(wanted, inside="positive")
    if wanted.label is not None or samples.dtype == np.bool_:
        census = Census(samples) if wanted.label is None else labelled(samples, wanted.label)
        low, high = census.extremes
        if low == high:
            raise GridError(f"every value is {bool(low)}: a constant field has no surface")
        case = Case(census.samples, census, wanted, steps, notes)
        taken = _of_mask(case, census.samples, census.border_shares()[2])
    else:
        taken = _of_numbers(samples, wanted, steps, notes)
    return taken.with_field(given=wanted.field == taken.field.kind), notes


def _of_numbers(
    given: SampleArray, wanted: Options, spacing: Triple | None, notes: list[str]
) -> Interpreted:
    samples = given
    if wanted.level is not None:
        samples = changed(samples, partial(np.add, -float(wanted.level)))
        which = "below" if wanted.inside == "negative" else "above"
        notes.append(f"values {which} {wanted.level:g} are taken as inside (see --inside)")
    if wanted.scale is not None:
        samples = changed(samples, partial(np.multiply, float(wanted.scale)))
    case = Case(samples, Census(samples), wanted, spacing, notes)
    if wanted.scale is not None and not case.is_density:
        one_sided = case.census.is_finite and case.census.is_one_sided
        if one_sided and is_density(case.census, spacing or (1.0, 1.0, 1.0)):
            raise refusal(Census(given), None)  # densities have no unit; a level is one of theirs
    case, transform, known = _known(case)
    low, high = case.census.extremes
    if case.is_density and (low > 0 or high < 0):
        level = float(wanted.level or 0)
        low, high = (x / (wanted.scale or 1) + level for x in (low, high))
        raise GridError(
            f"no value is {'above' if high < level else 'below'} the level {level:g} (they go from "
            f"{low:.6g} to {high:.6g}): {choose_level(Census(given))}"
        )
    taken = _of_known(case, transform)
    if known is None or known.unseen is None:
        return taken
    return taken.with_field(unseen=known.unseen, why_open=known.why_open)


def _known(case: Case) -> tuple[Case, Transform | None, Filled | None]:
    """Return samples of which unknown ones are filled in, and of which transform they are.

    All of a transform, and all labels, are known, though they may jump beside many equal ones.
    """
    census = case.census
    if not census.is_finite and case.samples.dtype.itemsize > 8:  # long doubles, inf as float64
        raise not_finite(case.samples)
    if census.is_finite:
        transform = find_transform(census.looked, case.spacing)
        if transform or case.is_density or census.are_labels:
            return case, transform, None
    seen = census if case.is_density else without_unseen(census, case.notes)
    if seen is census and census.is_finite:
        return case, None, None
    known = filled(seen, case.notes)
    census = Census(known.plain)
    case = replace(case, samples=known.continued, census=census)
    return case, find_transform(census.looked, case.spacing), known


def _of_known(case: Case, transform: Transform | None) -> Interpreted:
    wanted, census, (low, high) = case.wanted, case.census, case.census.extremes
    if low == high:
        raise GridError(f"every value is {low:.6g}: a constant field has no surface")
    if census.has_two_values:
        lower = 0.0 if case.is_density else low
        if high <= lower:
            raise GridError("every value is False: a constant field has no surface")
        return _of_mask(case, _above(case.samples, lower), census.border_shares()[2])
    if wanted.field == MASK:
        return _of_signs(case)
    if transform is not None and wanted.field == AUTO:
        steps = case.with_spacing(transform.step, "the step of the transform")
        case.notes.append("the values are a distance transform, so only their sign says something")
        return _of_signs(replace(case, spacing=steps), transform.zeros)
    if not case.is_density and census.are_labels:
        raise GridError(f"no solid is chosen: {choose_label(census.samples)}")
    if wanted.field in (EXACT, NOISY):
        return _as_distances(case)
    looked = census.looked
    if case.is_density and wanted.field == AUTO and _is_step(looked):
        case.notes.append("the densities jump from one side of the level to the other")
        return _of_mask(case, _above(case.samples, 0), 1 - census.border_shares()[1])
    if case.is_density:
        steps = case.with_spacing(1, "since densities show none (give --spacing)")
        case = replace(case, spacing=steps)
    if _has_other_slope(case):
        return _of_slope(case)
    return _by_kind(_as_distances(case, is_cut=bool(looked.is_cut.any())), case)


def _has_other_slope(case: Case) -> bool:
    """Return whether the values are no distances in the unit of the spacing, as far as is given."""
    looked, spacing = case.census.looked, case.spacing
    if case.wanted.field == SCALED or spacing is None:
        return case.wanted.field == SCALED
    if is_normalised(looked, spacing) or is_projective(looked, spacing):
        return True
    evidence = weigh(looked, spacing) if case.is_density else None
    return bool(evidence and (not np.isfinite(evidence.slope) or evidence.is_scaled))


def labelled(samples: SampleArray, label: int) -> Census:
    """Return which samples have a label; GridError if none or all have."""
    value = as_sample(label, samples.dtype)
    if value is not None:
        census = Census(changed(samples, partial(np.equal, value), np.bool_))
        if census.extremes == (0, 1):
            return census
    labels = {x.item() for plane in samples for x in np.unique(plane)[: MOST_NAMED + 1]}
    which = "every sample" if value is not None and labels == {value} else "no sample"
    raise GridError(f"{which} has the label {label}: the labels are {named(labels)}")


def as_sample(label: int, dtype: np.dtype[Any]) -> Any:
    """Return the sample that is exactly a label, None if the type has none."""
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            value = dtype.type(label)
        return value if np.isfinite(value) and int(value) == label else None
    low, high = (0, 1) if dtype.kind == "b" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
    return dtype.type(label) if low <= label <= high else None


def _is_step(looked: Looked) -> bool:
    """Return whether densities jump over the level from sample to sample, with no ramp between."""
    pairs = np.stack([looked.lines[..., 1:3], looked.lines[..., 2:4]]).reshape(-1, 2)
    across: NDArray[np.float64] = pairs[(pairs[:, 0] > 0) != (pairs[:, 1] > 0)]
    if len(across) < ENOUGH:
        return False
    low, high = np.quantile(looked.lines, [STEP_TAIL, 1 - STEP_TAIL])
    return bool(np.median(np.abs(across[:, 1] - across[:, 0])) > STEP * (high - low))


def _of_signs(case: Case, zeros: int = 0) -> Interpreted:
    """Return the distances of the mask that the signs make; 0 is on the side ``zeros``.

    If that is 0, it is on the one side or, of both sides, on the inside.
    """
    low, high = case.census.extremes
    if low > 0 or high < 0:
        raise GridError(
            f"every value is {'above' if low > 0 else 'below'} 0 (they go from {low:.6g} to "
            f"{high:.6g}), so their signs make no mask: {way_out(case.census)}"
        )
    below, above, _ = case.census.border_shares()
    is_positive = below > 0.5 if case.wanted.inside == AUTO else case.wanted.inside == "positive"
    if high == 0 or zeros > 0 or (low < 0 and zeros == 0 and is_positive):
        return _of_mask(case, changed(case.samples, partial(np.less_equal, 0), np.bool_), below)
    return _of_mask(case, _above(case.samples, 0), 1 - above)


def _above(samples: SampleArray, level: float) -> SampleArray:
    return changed(samples, partial(np.less, level), np.bool_)


def _of_mask(case: Case, mask: SampleArray, lower: float) -> Interpreted:
    """Return the distances, on its lattice, of which samples are on the upper side of a level.

    ``lower`` is the share of the grid's border that is on the lower side.
    """
    positive = case.wanted.inside == "positive"
    if case.wanted.inside == AUTO:  # the border is outside
        positive, share = lower > 0.5, max(lower, 1 - lower)
        if share < 1:
            case.notes.append(
                f"the {'larger' if positive else 'smaller'} value is taken as inside: {share:.0%} "
                "of the grid's border has the other one (if that is wrong, use --inside)"
            )
    if not positive:
        mask = changed(mask, np.logical_not, np.bool_)
    spacing = case.with_spacing(1, "since a mask shows none (give --spacing)")
    case.notes.append(
        "values taken as a mask (--field mask): they show the surface to half a voxel only"
    )
    h = min(steps_of(spacing))
    field = Field(MASK, exact=NONE_EXACT, on_lattice=not is_cubic(spacing))
    return Interpreted(
        derived.mask_planes(mask, h), derived.extremes_of_masks(h), spacing, False, field
    )


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
        each = each.copy()
        for near in each.copy():  # axes that are equal but for the error of the estimate
            alike = np.abs(each / near - 1) <= SNAP
            each[alike] = each[alike].mean()
        spacing = check_spacing(each)
        shown = f"{', '.join(f'{h:.6g}' for h in spacing)} along x, y, z"
        return spacing, [f"spacing not given: estimated as {shown} {APPROXIMATE}"]
    if unequal:
        steps = ", ".join(f"{step:.4g} along {name}" for name, step in unequal.items())
        raise GridError(
            f"spacing not given: the values change by {steps} from sample to sample, and do not "
            f"show it for all axes; {way_out(census)}"
        )
    measured, n = _measure(everywhere, beside), max(census.shape)
    if not LEAST_SPACING <= measured <= MOST_SPACING:
        raise GridError(
            f"spacing not given: the values change by {measured:.6g} from sample to sample; give "
            f"--spacing, in a unit in which it is between {LEAST_SPACING:g} and {MOST_SPACING:g}"
        )
    usual = {"1": 1.0} | {f"{a}/{b}": a / b for a in (1, 2) for b in (n, n - 1)}
    name = min(usual, key=lambda key: abs(np.log(usual[key] / measured)))
    if abs(measured / usual[name] - 1) > SNAP:
        return (measured,) * 3, [f"spacing not given: estimated as {measured:.6g} {APPROXIMATE}"]
    said = f"spacing not given: taken as {name}, the values show {measured:.6g}"
    return (usual[name],) * 3, [said]


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


def _as_distances(case: Case, *, is_cut: bool = False) -> Interpreted:
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


def _by_kind(taken: Interpreted, case: Case) -> Interpreted:
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
        if abs(slope / unit - 1) > SAME_UNIT:
            return None
        unit = slope
    evidence = weigh(census.looked.divided(unit), spacing)
    if evidence.is_scaled or evidence.is_noisy:
        return None
    case.notes.append(
        f"the values are distances in another unit: multiplied by {1 / unit:.6g} (give --scale)"
    )
    return taken.divided(unit).with_field(evidence=evidence.report())


def _of_slope(case: Case) -> Interpreted:
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
    low, high = evidence.uncut(taken.extremes)
    return min(-low, high) / max(steps_of(taken.spacing))


def _truncated(taken: Interpreted, evidence: Evidence, case: Case) -> Interpreted:
    """Return truncated distances, the missing ones filled in if that helps."""
    at, (low, high) = _cut_at(taken, evidence), evidence.uncut(taken.extremes)
    exact = (-high, -low) if taken.positive_inside else (low, high)
    taken = replace(taken, field=Field(TRUNCATED, exact=exact, evidence=evidence.report()))
    if np.isfinite(at):
        said = f"cut off {at:.3g} voxels from the surface"
        case.notes.append(f"values taken as truncated (--field truncated): {said}")
    if at < TOO_NEAR:
        return _as_spline(taken)
    if at >= FILLED:
        return taken
    steps = steps_of(taken.spacing)
    return replace(taken, samples=derived.filled_planes(taken.samples, steps, taken.extremes))


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
    samples = derived.without_plateaus(taken.samples, taken.extremes, min(steps_of(taken.spacing)))
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
    has_distances = evidence.is_enough and not evidence.is_cut and evidence.wrong < TOO_BENT
    field = Field(
        SCALED,
        exact=NONE_EXACT,
        smooth=changed(taken.samples, lambda values: values * sign),
        has_kinks=has_distances and not evidence.is_contradictory and cubic,
        on_lattice=not cubic,
        evidence=evidence.report(),
    )
    low, high = (x / slope for x in taken.extremes)
    samples = derived.normalised_planes(taken.samples, min(steps), step * slope)
    return replace(taken, samples=samples, extremes=(low, high), field=field)


def find_fault(census: Census, spacing: Triple) -> str:
    """Return why values on one side of 0 are no distances to a thin solid; empty if they can be."""
    extremes, values = census.extremes, census.samples
    steps = np.array(spacing) / max(spacing)
    scale = (1 if extremes[0] >= 0 else -1) / max(spacing)
    near = float(np.linalg.norm(steps)) / 2 * MARGIN  # so far is the nearest sample of a point
    if min(map(abs, extremes)) * abs(scale) > near:
        return FAR
    nth = 1  # of a large grid every n-th sample along each axis is looked at for regions
    while np.prod([-(-count // nth) for count in values.shape], dtype=float) > MOST_FLOODED:
        nth += 1
    coarse = [np.asarray(values[i], np.float64)[::nth, ::nth] for i in range(0, len(values), nth)]
    patches, total, thin = _look_near_walls(values, scale, steps, near)
    if not len(patches):
        return BEYOND
    change = np.abs(patches - patches[:, CENTRE, None])
    most = LIPSCHITZ * np.linalg.norm(NEIGHBOURHOOD * steps, axis=1) + NO_THICKNESS
    are_distances = (change <= most).all(1).mean() >= LIPSCHITZ_SHARE
    if not (are_distances and _touch_walls(patches, steps)):
        return UNSIGNED
    if len(thin) > UNSIGNED_SHARE * total:
        beyond = max(-float(np.quantile(thin, LEAST_THICKNESS)), 0.0)
        if _is_cut_off(np.array(coarse) * (scale / nth), steps, FREE + beyond):
            return UNSIGNED
    return ""


def _look_near_walls(
    values: SampleArray, scale: float, steps: Floats, near: float
) -> tuple[Floats, int, Floats]:
    """Return what lies near 0; ``scale`` makes outside positive.

    Distances round some of the inner samples, (n, 27); how many walls pass between samples, of all
    lines along the axes; and how thick those are that hardly have a thickness, less than 0 if a
    constant was added.
    """
    count = 0
    patches, thin = list[Floats](), [np.empty(0)]
    for i in range(1, len(values) - 1):
        slab = np.asarray(values[i - 1 : i + 3], np.float64) * scale
        if slab[1:3].min() <= near:
            for lines, step in zip((slab, slab[1], slab[1].T), steps):
                for part in chunks_of(lines.shape[1], lines[:, 0].size):  # to save memory
                    thickness = find_walls(lines[:, part] / step)[1]
                    count += len(thickness)
                    thin.append(thickness[thickness < NO_THICKNESS])
        inner = slab[1, 1:-1, 1:-1]
        found = np.flatnonzero(inner <= near)
        if len(found):
            order = np.argsort(inner.ravel()[found])
            spread = np.linspace(0, len(order) - 1, CANDIDATES_IN_PLANE).astype(int)
            chosen = found[np.union1d(order[:CANDIDATES_IN_PLANE], order[spread])]
            at = np.stack(np.unravel_index(chosen, inner.shape), 1)
            patches += [slab[:3, j : j + 3, k : k + 3].reshape(27) for j, k in at]
    some = np.unique(np.linspace(0, max(len(patches) - 1, 0), CANDIDATES).astype(int))
    chosen = np.array([patches[n] for n in some] if patches else []).reshape(-1, 27)
    return chosen, count, np.concatenate(thin)


def find_walls(lines: Floats) -> tuple[BoolArray, Floats]:
    """Return where a wall lies between two samples of lines (n, ...), and how thick it is.

    Samples are along the first axis, in spacings and positive. The first result, (n - 3, ...),
    says whether there is one between samples i + 1 and i + 2. The second, (walls,), is what the
    distances on either side leave of the way between the two.
    """
    before, left, right, after = lines[:-3], lines[1:-2], lines[2:-1], lines[3:]
    falling, rising = before - left, after - right
    slope = (falling + rising) / 2
    thickness = slope - left - right
    walls = (falling > STEEP) & (rising > STEEP) & (thickness >= -STEEP * slope)
    return walls, thickness[walls]


def _touch_walls(patches: Floats, steps: Floats) -> bool:
    """Return whether most samples' spheres touch a point that lies in none of the others.

    The field falls towards it, measured on the far side of each sample: on the near side there may
    be the wall.
    """
    centre = patches[:, CENTRE, None]
    after, before = patches[:, CENTRE + STRIDES], patches[:, CENTRE - STRIDES]
    rise = np.where(after > before, after - centre, centre - before) / steps
    length = np.maximum(np.linalg.norm(rise, axis=1), np.finfo(float).tiny)[:, None]
    feet = -rise / length * centre
    depth = patches - np.linalg.norm(feet[:, None] - NEIGHBOURHOOD * steps, axis=2)
    deepest = np.delete(depth, CENTRE, axis=1).max(1)
    rises = (length[:, 0] >= LEAST_RISE) & (length[:, 0] <= MOST_RISE)
    return bool((rises & (np.abs(deepest) <= TOUCHING)).mean() >= TOUCHING_SHARE)


def _is_cut_off(coarse: Floats, steps: Floats, free: float) -> bool:
    """Return whether walls cut deep samples off from the farthest sample of the border.

    No wall passes between samples that add up to more than ``free`` times their spacing.
    """
    border = coarse.copy()
    border[1:-1, 1:-1, 1:-1] = -np.inf
    reached = np.zeros(coarse.shape, bool)
    reached.flat[border.argmax()] = True
    before = 0
    while before != (before := int(reached.sum())):
        for axis, step in enumerate(steps):  # both ways along the axis
            lines, samples = (np.moveaxis(x, axis, 0) for x in (reached, coarse))
            is_free = samples[1:] + samples[:-1] > free * step
            for i in range(len(is_free)):
                lines[i + 1] |= lines[i] & is_free[i]
            for i in reversed(range(len(is_free))):
                lines[i] |= lines[i + 1] & is_free[i]
    return bool((coarse[~reached] >= DEEP).any())


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
    """Return the error for values without both sides; ``fault`` is that of ``find_fault``."""
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


def _steps(census: Census) -> Floats | None:
    """Return the spacing of each axis with which values are distances; None if with none."""
    gradients = census.everywhere
    if not len(gradients.bend) or gradients.spacing is not None:
        return gradients.spacing if len(gradients.bend) else None
    step = gradients.typical_length
    return np.full(3, step) if gradients.agree_with(step) else None
