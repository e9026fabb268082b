"""From values of any kind to distances near the surface: what they are, and the best way there.

The evidence is gathered once (``census``, ``field``); the user may overrule it. The zero level
never moves. Masks are made distances here, other fields by ``distances``.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import GridError
from ..options import ReadOptions
from . import distances
from .census import Census, Looked, not_finite
from .derived import extremes_of_masks, mask_planes
from .field import (
    AUTO,
    EXACT,
    MASK,
    NOISY,
    NONE_EXACT,
    SCALED,
    Field,
    Interpreted,
    Request,
    is_normalised,
    is_projective,
    weigh,
)
from .placement import check_kind, check_spacing, is_cubic, steps_of
from .planes import SampleArray, changed
from .slopes import ENOUGH, median
from .spacing import MOST_NAMED, choose_label, choose_level, is_density, named, refusal, way_out
from .transforms import Transform, find_transform
from .unknown import filled, without_unseen

# Densities have no ramp if half of the changes across the level are this share of all there is to
# change, the lowest and the highest values left out.
STEP, STEP_TAIL = 0.85, 0.05


def interpret(
    samples: SampleArray, wanted: ReadOptions, spacing: ArrayLike | None, notes: list[str]
) -> Interpreted:
    """Return distances for the values of a grid; ``notes`` gets sentences on what was inferred."""
    request = Request(wanted, None if spacing is None else check_spacing(spacing), wanted.inside)
    check_kind(samples.dtype, samples.shape)
    if wanted.label is not None:
        return _of_bools(labelled(samples, wanted.label), request.above_is_inside(), notes)
    if samples.dtype == np.bool_:
        return _of_bools(Census(samples), request, notes)
    given = samples
    samples, request = _about_zero(samples, request, notes)
    census = Census(samples)
    if wanted.scale is not None and not request.is_density:
        one_sided = census.is_finite and census.is_one_sided
        if one_sided and is_density(census, request.spacing or (1.0, 1.0, 1.0)):
            raise refusal(Census(given), None)  # densities have no unit; a level is one of theirs
    samples, census, transform = _known(census, request, notes)
    low, high = census.extremes
    if request.is_density and (low > 0 or high < 0):
        raise _no_level(given, wanted, low, high)
    interpreted = _interpreted(samples, census, transform, request, notes)
    unseen = getattr(samples, "unseen", None)
    return interpreted if unseen is None else interpreted.with_field(unseen=unseen)


def _interpreted(
    samples: SampleArray,
    census: Census,
    transform: Transform | None,
    request: Request,
    notes: list[str],
) -> Interpreted:
    wanted, (low, high) = request.wanted, census.extremes
    if low == high:
        raise GridError(f"every value is {low:.6g}: a constant field has no surface")
    if census.has_two_values:
        lower = 0.0 if request.is_density else low
        if high <= lower:
            raise GridError("every value is False: a constant field has no surface")
        return _of_mask(_above(samples, lower), census.border_shares()[2], request, notes)
    if wanted.field == MASK:
        return _of_signs(samples, census, request, notes)
    if transform is not None and request.is_auto:
        request = request.with_spacing(transform.step, "the step of the transform", notes)
        notes.append("the values are a distance transform, so only their sign says something")
        return _of_signs(samples, census, request, notes, transform.zeros)
    if not request.is_density and census.are_labels:
        raise GridError(f"no solid is chosen: {choose_label(census.samples)}")
    if wanted.field in (EXACT, NOISY):
        return distances.as_distances(samples, census, request, notes)
    return _by_evidence(samples, census, request, notes)


def _of_bools(census: Census, request: Request, notes: list[str]) -> Interpreted:
    low, high = census.extremes
    if low == high:
        raise GridError(f"every value is {bool(low)}: a constant field has no surface")
    return _of_mask(census.samples, census.border_shares()[2], request, notes)


def _about_zero(
    samples: SampleArray, request: Request, notes: list[str]
) -> tuple[SampleArray, Request]:
    """Return the values less the level, and in world units, as far as the user gives these."""
    level, scale = request.wanted.level, request.wanted.scale
    if level is not None:
        samples = changed(samples, partial(np.add, -float(level)))
        which = "below" if request.inside == "negative" else "above"
        notes.append(f"values {which} {level:g} are taken as inside (see --inside)")
        request = request.above_is_inside()
    if scale is not None:
        samples = changed(samples, partial(np.multiply, float(scale)))
    return samples, request


def _no_level(given: SampleArray, wanted: ReadOptions, low: float, high: float) -> GridError:
    level = float(wanted.level or 0)
    low, high = (x / (wanted.scale or 1) + level for x in (low, high))
    return GridError(
        f"no value is {'above' if high < level else 'below'} the level {level:g} (they go from "
        f"{low:.6g} to {high:.6g}): {choose_level(Census(given))}"
    )


def _known(
    census: Census, request: Request, notes: list[str]
) -> tuple[SampleArray, Census, Transform | None]:
    """Return samples, those that are unknown filled in, what they show, and of which transform.

    All of a transform, and all labels, are known, though they may jump beside many equal ones.
    """
    samples = census.samples
    if not census.is_finite and samples.dtype.itemsize > 8:  # long doubles, infinite as float64
        raise not_finite(samples)
    if census.is_finite:
        transform = find_transform(census.looked, request.spacing)
        if transform or request.is_density or census.are_labels:
            return samples, census, transform
    seen = census if request.is_density else without_unseen(census, notes)
    if seen is census and census.is_finite:
        return samples, census, None
    known = filled(seen, notes)
    census = Census(known.not_continued)
    return known, census, find_transform(census.looked, request.spacing)


def _by_evidence(
    samples: SampleArray, census: Census, request: Request, notes: list[str]
) -> Interpreted:
    looked = census.looked
    if request.is_auto and request.is_density and _is_step(looked):
        notes.append("the densities jump from one side of the level to the other")
        return _of_mask(_above(samples, 0), 1 - census.border_shares()[1], request, notes)
    if request.is_density:
        request = request.with_spacing(1, "since densities show none (give --spacing)", notes)
    if _has_other_slope(looked, request):
        return distances.of_slope(samples, census, request, notes)
    is_cut = bool(looked.is_cut.any())
    taken = distances.as_distances(samples, census, request, notes, is_cut=is_cut)
    return distances.by_kind(taken, census, request, notes)


def _has_other_slope(looked: Looked, request: Request) -> bool:
    """Return whether the values are no distances in the unit of the spacing, as far as is given."""
    if request.wanted.field == SCALED:
        return True
    if request.spacing is None:
        return False
    if is_normalised(looked, request.spacing) or is_projective(looked, request.spacing):
        return True
    if not request.is_density:
        return False
    evidence = weigh(looked, request.spacing)
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
    return bool(median(np.abs(across[:, 1] - across[:, 0])) > STEP * (high - low))


def _of_signs(
    samples: SampleArray, census: Census, request: Request, notes: list[str], zeros: int = 0
) -> Interpreted:
    """Return the distances of the mask that the signs make; 0 is on the side ``zeros``.

    If that is 0, it is on the one side or, of both sides, on the inside.
    """
    low, high = census.extremes
    if low > 0 or high < 0:
        raise GridError(
            f"every value is {'above' if low > 0 else 'below'} 0 (they go from {low:.6g} to "
            f"{high:.6g}), so their signs make no mask: {way_out(census)}"
        )
    below, above, _ = census.border_shares()
    is_positive = below > 0.5 if request.inside == AUTO else request.inside == "positive"
    if high == 0 or zeros > 0 or (low < 0 and zeros == 0 and is_positive):
        return _of_mask(
            changed(samples, partial(np.less_equal, 0), np.bool_), below, request, notes
        )
    return _of_mask(_above(samples, 0), 1 - above, request, notes)


def _above(samples: SampleArray, level: float) -> SampleArray:
    return changed(samples, partial(np.less, level), np.bool_)


def _of_mask(mask: SampleArray, lower: float, request: Request, notes: list[str]) -> Interpreted:
    """Return the distances, on its lattice, of which samples are on the upper side of a level.

    ``lower`` is the share of the grid's border that is on the lower side.
    """
    positive = request.inside == "positive"
    if request.inside == AUTO:  # the border is outside
        positive, share = lower > 0.5, max(lower, 1 - lower)
        if share < 1:
            notes.append(
                f"the {'larger' if positive else 'smaller'} value is taken as inside: {share:.0%} "
                "of the grid's border has the other one (if that is wrong, use --inside)"
            )
    if not positive:
        mask = changed(mask, np.logical_not, np.bool_)
    spacing = request.with_spacing(1, "since a mask shows none (give --spacing)", notes).spacing
    assert spacing is not None
    notes.append(
        "values taken as a mask (--field mask): they show the surface to half a voxel only"
    )
    h, given = min(steps_of(spacing)), request.wanted.field == MASK
    field = Field(MASK, given, NONE_EXACT, on_lattice=not is_cubic(spacing))
    return Interpreted(mask_planes(mask, h), extremes_of_masks(h), spacing, False, field)
