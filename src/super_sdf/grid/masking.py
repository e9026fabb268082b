"""Masks out of other values: labels, two values, distance transforms, and steep densities.

``masks`` makes distances of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import GridError
from .advice import MOST_NAMED, named, way_out
from .evidence import ENOUGH, Looked
from .field import AUTO, MASK, NONE_EXACT, Field
from .masks import extremes_of_masks, has_both_sides, mask_planes
from .planes import SampleArray, changed
from .request import Interpreted, Request
from .samples import Extremes
from .sides import count_border, is_mostly_negative
from .spacing import is_cubic, steps_of

# Densities have no ramp if half of the changes across the level are this share of all there is to
# change, the lowest and the highest values left out.
STEP, STEP_TAIL = 0.85, 0.05


def labelled(samples: SampleArray, label: int) -> SampleArray:
    """Return which samples have a label; GridError if none or all have."""
    label = int(label)
    value = as_sample(label, samples.dtype)
    if value is not None:
        found = changed(samples, lambda planes: planes == value, np.bool_)
        if has_both_sides(found):
            return found
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


def above(samples: SampleArray, level: float) -> SampleArray:
    """Return which samples are above a level."""
    return changed(samples, lambda planes: planes > level, np.bool_)


def is_step(looked: Looked) -> bool:
    """Return whether densities jump over the level from sample to sample, with no ramp between.

    Then where the surface lies between two samples does not show in their values.
    """
    pairs = np.stack([looked.lines[..., 1:3], looked.lines[..., 2:4]]).reshape(-1, 2)
    across: NDArray[np.float64] = pairs[(pairs[:, 0] > 0) != (pairs[:, 1] > 0)]
    if len(across) < ENOUGH:
        return False
    low, high = np.quantile(looked.lines, [STEP_TAIL, 1 - STEP_TAIL])
    jumps = np.abs(across[:, 1] - across[:, 0])
    return bool(np.median(jumps) > STEP * (high - low))


def of_signs(
    samples: SampleArray, extremes: Extremes, request: Request, notes: list[str], zeros: int = 0
) -> Interpreted:
    """Return the distances of the mask that the signs of numbers make.

    ``extremes`` are the smallest and the largest sample. Samples that are 0 have the sign
    ``zeros``; if that is 0, that of the one side or, of both sides, that of the inside.
    """
    low, high = extremes
    if low > 0 or high < 0:
        raise GridError(
            f"every value is {'above' if low > 0 else 'below'} 0 (they go from {low:.6g} to "
            f"{high:.6g}), so their signs make no mask: {way_out(samples)}"
        )
    if high == 0 or zeros > 0 or (low < 0 and zeros == 0 and _is_positive(samples, request)):
        return of_mask(changed(samples, lambda planes: planes >= 0, np.bool_), request, notes)
    return of_mask(above(samples, 0), request, notes)


def _is_positive(samples: SampleArray, request: Request) -> bool:
    """Return whether positive numbers are inside."""
    if request.inside != AUTO:
        return request.inside == "positive"
    return is_mostly_negative(*count_border(samples))


def of_mask(mask: SampleArray, request: Request, notes: list[str]) -> Interpreted:
    """Return the distances of a mask, which says on which side of a level each sample is.

    They are distances on its lattice, whatever the spacings: a mask shows none in the world.
    """
    if not has_both_sides(mask):
        raise GridError(f"every value is {bool(mask[0].flat[0])}: a constant field has no surface")
    if not _is_true_inside(mask, request.inside, notes):
        mask = changed(mask, np.logical_not, np.bool_)
    spacing = request.with_spacing(1, "since a mask shows none (give --spacing)", notes).spacing
    assert spacing is not None
    notes.append(
        "values taken as a mask (--field mask): they show the surface to half a voxel only"
    )
    h, given = min(steps_of(spacing)), request.wanted.field == MASK
    field = Field(MASK, given, NONE_EXACT, on_lattice=not is_cubic(spacing))
    return Interpreted(mask_planes(mask, h), extremes_of_masks(h), spacing, False, field)


def _is_true_inside(mask: SampleArray, inside: str, notes: list[str]) -> bool:
    """Return whether the larger value of a mask is inside: the border is outside unless given."""
    if inside != AUTO:
        return inside == "positive"
    signs = changed(mask, lambda planes: planes.astype(np.int8) * 2 - 1, np.int8)
    below, total = count_border(signs)
    positive = is_mostly_negative(below, total)
    share = max(below, total - below) / total
    if share < 1:
        notes.append(
            f"the {'larger' if positive else 'smaller'} value is taken as inside: {share:.0%} of "
            "the grid's border has the other one (if that is wrong, use --inside)"
        )
    return positive
