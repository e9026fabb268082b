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
from . import distances, masking
from .advice import are_labels, choose_label, choose_level, is_density, refusal
from .evidence import Looked, is_normalised, is_projective, look, weigh
from .field import EXACT, MASK, NOISY, SCALED
from .one_sided import is_one_sided
from .planes import SampleArray, changed
from .request import Interpreted, Request
from .samples import (
    Extremes,
    check_kind,
    check_not_constant,
    find_extremes,
    has_two_values,
    not_finite,
)
from .transforms import Transform, find_transform
from .unknown import KnownPlanes, filled, finite_extremes
from .unseen import without_unseen


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
    found, known = _interpreted(samples, request, notes)
    unseen = known.unseen if isinstance(known, KnownPlanes) else None
    return replace(found, field=replace(found.field, unseen=unseen)) if unseen else found


def _interpreted(
    samples: SampleArray, request: Request, notes: list[str]
) -> tuple[Interpreted, SampleArray]:
    """Return distances, and the samples of which they were made, the unknown ones filled in."""
    wanted = request.wanted
    if wanted.label is not None:
        chosen = masking.labelled(samples, wanted.label)
        return masking.of_mask(chosen, request.above_is_inside(), notes), samples
    if samples.dtype == np.bool_:
        return masking.of_mask(samples, request, notes), samples
    given = samples
    samples, request = _about_zero(samples, request, notes)
    samples, looked, transform = _known(samples, request, notes)
    extremes = looked.extremes
    if request.is_density and (extremes[0] > 0 or extremes[1] < 0):
        raise _no_level(given, extremes, wanted)
    check_not_constant(extremes)
    if has_two_values(samples, extremes):
        lower = 0.0 if request.is_density else extremes[0]
        return masking.of_mask(masking.above(samples, lower), request, notes), samples
    if wanted.field == MASK:
        return masking.of_signs(samples, extremes, request, notes), samples
    if transform is not None and request.is_auto:
        return _of_transform(samples, extremes, transform, request, notes), samples
    if not request.is_density and are_labels(samples):
        raise GridError(f"no solid is chosen: {choose_label(samples)}")
    if wanted.field in (EXACT, NOISY):
        return distances.as_distances(samples, extremes, request, notes), samples
    return _by_evidence(samples, looked, request, notes), samples


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
        if level is None:
            _check_no_densities(samples, request, float(scale))
        samples = changed(samples, partial(np.multiply, float(scale)))
    return samples, request


def _check_no_densities(samples: SampleArray, request: Request, scale: float) -> None:
    """Raise GridError for values on one side of 0 that have no unit; a level is one of theirs."""
    extremes = find_extremes(samples)
    x, y, z = (step / abs(scale) for step in request.spacing or (1.0, 1.0, 1.0))
    if extremes and is_one_sided(extremes) and is_density(samples, extremes, (x, y, z)):
        raise refusal(samples, extremes, None)


def _no_level(given: SampleArray, extremes: Extremes, wanted: ReadOptions) -> GridError:
    """Return the error for a level that no value is above, or none below."""
    level = float(wanted.level or 0)
    low, high = (x / (wanted.scale or 1) + level for x in extremes)
    return GridError(
        f"no value is {'above' if high < level else 'below'} the level {level:g} (they go from "
        f"{low:.6g} to {high:.6g}): {choose_level(given, (low, high))}"
    )


def _known(
    samples: SampleArray, request: Request, notes: list[str]
) -> tuple[SampleArray, Looked, Transform | None]:
    """Return samples, those that are unknown filled in, what they show, and of which transform.

    All of a transform, and all labels, are known, though they may jump beside many equal ones.
    """
    extremes = find_extremes(samples)
    if extremes is None and samples.dtype.itemsize > 8:  # long doubles, infinite as float64 only
        raise not_finite(samples)
    if extremes:
        looked = look(samples, extremes)
        transform = find_transform(looked, request.spacing)
        if transform or request.is_density or are_labels(samples):
            return samples, looked, transform
    seen = samples
    if not request.is_density:
        ends = extremes or finite_extremes(samples)
        seen = without_unseen(samples, ends, notes, all_known=extremes is not None)
    if extremes and seen is samples:
        return samples, looked, None
    known, extremes = filled(seen, notes)
    looked = look(known.not_continued if isinstance(known, KnownPlanes) else known, extremes)
    return known, looked, find_transform(looked, request.spacing)


def _of_transform(
    samples: SampleArray,
    extremes: Extremes,
    transform: Transform,
    request: Request,
    notes: list[str],
) -> Interpreted:
    """Return the distances of the mask of which values are a distance transform."""
    request = request.with_spacing(transform.step, "the step of the transform", notes)
    notes.append("the values are a distance transform, so only their sign says something")
    return masking.of_signs(samples, extremes, request, notes, transform.zeros)


def _by_evidence(
    samples: SampleArray, looked: Looked, request: Request, notes: list[str]
) -> Interpreted:
    """Return distances for values that are no mask at first sight, by what the samples show."""
    if request.is_auto and request.is_density and masking.is_step(looked):
        notes.append("the densities jump from one side of the level to the other")
        return masking.of_mask(masking.above(samples, 0), request, notes)
    if request.is_density:
        request = request.with_spacing(1, "since densities show none (give --spacing)", notes)
    if _has_other_slope(looked, request):
        return distances.of_slope(samples, looked, request, notes)
    is_cut = bool(looked.is_cut.any())
    found = distances.as_distances(samples, looked.extremes, request, notes, is_cut=is_cut)
    return distances.by_kind(found, looked, request, notes)


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
