"""From values of any kind to distances near the surface: what they are, and the best way there.

The evidence is gathered once (``evidence``); the user may overrule it. The zero level never moves.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from ..errors import GridError
from ..options import ReadOptions
from . import distances, masks
from .advice import choose_label, choose_level, is_density, refusal
from .census import Census, Looked, not_finite
from .evidence import is_normalised, is_projective, weigh
from .field import EXACT, MASK, NOISY, SCALED, Interpreted, Request
from .planes import SampleArray, changed
from .samples import check_kind
from .transforms import Transform, find_transform
from .unknown import filled, without_unseen

UNIT = (1.0, 1.0, 1.0)


def interpret(
    samples: SampleArray,
    wanted: ReadOptions,
    spacing: ArrayLike | None,
    inside: str,
    notes: list[str],
) -> Interpreted:
    """Return distances for the values of a grid; ``notes`` gets sentences on what was inferred.

    Raises
    ------
    GridError
        If the values have no surface, or contradict the spacing.
    OptionError
        If ``inside`` or what is wanted is unknown.
    """
    request = Request.checked(wanted, spacing, inside)
    check_kind(samples.dtype, samples.shape)
    if wanted.label is not None:
        mask = masks.labelled(samples, wanted.label)
        return _of_mask(mask, request.above_is_inside(), notes)
    if samples.dtype == np.bool_:
        return _of_mask(Census(samples), request, notes)
    given = samples
    samples, request = _about_zero(samples, request, notes)
    census = Census(samples)
    if wanted.scale is not None and not request.is_density:
        _check_no_densities(given, census, request, float(wanted.scale))
    samples, census, transform = _known(census, request, notes)
    low, high = census.extremes
    if request.is_density and (low > 0 or high < 0):
        raise _no_level(given, wanted, low, high)
    interpreted = _interpreted(samples, census, transform, request, notes)
    unseen = getattr(samples, "unseen", None)
    if unseen is None:
        return interpreted
    return replace(interpreted, field=replace(interpreted.field, unseen=unseen))


def _interpreted(
    samples: SampleArray,
    census: Census,
    transform: Transform | None,
    request: Request,
    notes: list[str],
) -> Interpreted:
    """Return the distances of samples that are all known."""
    wanted, (low, high) = request.wanted, census.extremes
    if low == high:
        raise GridError(f"every value is {low:.6g}: a constant field has no surface")
    if census.has_two_values:
        lower = 0.0 if request.is_density else low
        if high <= lower:
            raise GridError("every value is False: a constant field has no surface")
        share = census.numbers.border[2] / census.border_size
        return masks.of_mask(masks.above_level(samples, lower), share, request, notes)
    if wanted.field == MASK:
        return masks.of_signs(samples, census, request, notes)
    if transform is not None and request.is_auto:
        request = request.with_spacing(transform.step, "the step of the transform", notes)
        notes.append("the values are a distance transform, so only their sign says something")
        return masks.of_signs(samples, census, request, notes, transform.zeros)
    if not request.is_density and census.are_labels:
        raise GridError(f"no solid is chosen: {choose_label(census.samples)}")
    if wanted.field in (EXACT, NOISY):
        return distances.as_distances(samples, census, request, notes)
    return _by_evidence(samples, census, request, notes)


def _of_mask(census: Census, request: Request, notes: list[str]) -> Interpreted:
    """Return the distances of samples that are true or false."""
    low, high = census.extremes
    if low == high:
        raise GridError(f"every value is {bool(low)}: a constant field has no surface")
    share = census.numbers.border[2] / census.border_size
    return masks.of_mask(census.samples, share, request, notes)


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


def _check_no_densities(given: SampleArray, census: Census, request: Request, scale: float) -> None:
    """Raise GridError for values on one side of 0 that have no unit; a level is one of theirs."""
    if census.is_finite and census.is_one_sided and is_density(census, request.spacing or UNIT):
        raise refusal(Census(given), None)


def _no_level(given: SampleArray, wanted: ReadOptions, low: float, high: float) -> GridError:
    """Return the error for a level that no value is above, or none below."""
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
    """Return distances for values that are no mask at first sight, by what the samples show."""
    looked = census.looked
    if request.is_auto and request.is_density and masks.is_step(looked):
        notes.append("the densities jump from one side of the level to the other")
        share = 1 - census.numbers.border[1] / census.border_size
        return masks.of_mask(masks.above_level(samples, 0), share, request, notes)
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
    evidence = weigh(looked, request.spacing)
    return request.is_density and (not np.isfinite(evidence.slope) or evidence.is_scaled)
