"""From values of any kind to distances near the surface: what they are, and the best way there.

The evidence is gathered once (``census``, ``field``); the user may overrule it. The zero level
never moves. Masks are made distances here, other fields by ``distances``.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import Triple
from ..errors import GridError
from ..options import AUTO, EXACT, MASK, NOISY, SCALED, Options
from . import distances
from .census import Census, Looked, not_finite
from .derived import extremes_of_masks, mask_planes
from .field import NONE_EXACT, Case, Field, Interpreted, is_normalised, is_projective, weigh
from .placement import check_kind, check_spacing, is_cubic, steps_of
from .planes import SampleArray, changed
from .refusals import MOST_NAMED, choose_label, choose_level, is_density, named, refusal, way_out
from .slopes import ENOUGH
from .transforms import Transform, find_transform
from .unknown import filled, without_unseen

# Densities have no ramp if half of the changes across the level are this share of all there is to
# change, the lowest and the highest values left out.
STEP, STEP_TAIL = 0.85, 0.05


def interpret(
    samples: SampleArray, wanted: Options, spacing: ArrayLike | None
) -> tuple[Interpreted, list[str]]:
    """Return distances for the values of a grid, and sentences on what was inferred."""
    steps = None if spacing is None else check_spacing(spacing)
    check_kind(samples.dtype, samples.shape)
    notes: list[str] = []
    if wanted.label is not None or samples.dtype == np.bool_:
        census = Census(samples) if wanted.label is None else labelled(samples, wanted.label)
        low, high = census.extremes
        if low == high:
            raise GridError(f"every value is {bool(low)}: a constant field has no surface")
        wanted = wanted if wanted.label is None else _above_is_inside(wanted)
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
        wanted = _above_is_inside(wanted)
    if wanted.scale is not None:
        samples = changed(samples, partial(np.multiply, float(wanted.scale)))
    case = Case(samples, Census(samples), wanted, spacing, notes)
    if wanted.scale is not None and not case.is_density:
        one_sided = case.census.is_finite and case.census.is_one_sided
        if one_sided and is_density(case.census, spacing or (1.0, 1.0, 1.0)):
            raise refusal(Census(given), None)  # densities have no unit; a level is one of theirs
    case, transform = _known(case)
    low, high = case.census.extremes
    if case.is_density and (low > 0 or high < 0):
        level = float(wanted.level or 0)
        low, high = (x / (wanted.scale or 1) + level for x in (low, high))
        raise GridError(
            f"no value is {'above' if high < level else 'below'} the level {level:g} (they go from "
            f"{low:.6g} to {high:.6g}): {choose_level(Census(given))}"
        )
    taken = _of_known(case, transform)
    unseen = getattr(case.samples, "unseen", None)
    return taken if unseen is None else taken.with_field(unseen=unseen)


def _above_is_inside(wanted: Options) -> Options:
    return replace(wanted, inside="positive") if wanted.inside == AUTO else wanted


def _known(case: Case) -> tuple[Case, Transform | None]:
    """Return samples of which unknown ones are filled in, and of which transform they are.

    All of a transform, and all labels, are known, though they may jump beside many equal ones.
    """
    census = case.census
    if not census.is_finite and case.samples.dtype.itemsize > 8:  # long doubles, inf as float64
        raise not_finite(case.samples)
    if census.is_finite:
        transform = find_transform(census.looked, case.spacing)
        if transform or case.is_density or census.are_labels:
            return case, transform
    seen = census if case.is_density else without_unseen(census, case.notes)
    if seen is census and census.is_finite:
        return case, None
    known = filled(seen, case.notes)
    census = Census(known.not_continued)
    case = replace(case, samples=known, census=census)
    return case, find_transform(census.looked, case.spacing)


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
        return distances.as_distances(case)
    return _by_evidence(case)


def _by_evidence(case: Case) -> Interpreted:
    looked = case.census.looked
    if case.is_density and case.wanted.field == AUTO and _is_step(looked):
        case.notes.append("the densities jump from one side of the level to the other")
        return _of_mask(case, _above(case.samples, 0), 1 - case.census.border_shares()[1])
    if case.is_density:
        steps = case.with_spacing(1, "since densities show none (give --spacing)")
        case = replace(case, spacing=steps)
    if _has_other_slope(case):
        return distances.of_slope(case)
    return distances.by_kind(distances.as_distances(case, is_cut=bool(looked.is_cut.any())), case)


def _has_other_slope(case: Case) -> bool:
    """Return whether the values are no distances in the unit of the spacing, as far as is given."""
    looked, spacing = case.census.looked, case.spacing
    if case.wanted.field == SCALED or spacing is None:
        return case.wanted.field == SCALED
    other = is_normalised(looked, spacing) or is_projective(looked, spacing)
    if other or not case.is_density:
        return other
    evidence = weigh(looked, spacing)
    return not np.isfinite(evidence.slope) or evidence.is_scaled


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
    return Interpreted(mask_planes(mask, h), extremes_of_masks(h), spacing, False, field)
