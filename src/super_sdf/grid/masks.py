"""Masks: grids that only say which samples are inside, and the distances that are made of them.

The surface passes half-way between a sample inside and one outside, for want of better knowledge.
So the distance of a sample is that to the nearest sample of the other side, less half a voxel: the
Euclidean distance transform of both sides, exact up to ``REACH`` voxels and constant beyond, since
farther samples do not matter to the surface.

Reference: Felzenszwalb and Huttenlocher, "Distance Transforms of Sampled Functions", 2012, for
taking the axes one after the other.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray
from ..errors import GridError
from .advice import MOST_NAMED, named, way_out
from .census import Census, Extremes, Looked
from .field import AUTO, MASK, NONE_EXACT, Field, Interpreted, Request
from .placement import is_cubic, steps_of
from .planes import DerivedPlanes, SampleArray, changed
from .slopes import ENOUGH

# Densities have no ramp if half of the changes across the level are this share of all there is to
# change, the lowest and the highest values left out.
STEP, STEP_TAIL = 0.85, 0.05
MASK_BYTES = 10  # per sample, measured
REACH = 4  # voxels; patches are clipped to 3 (``steps.band.PATCH_LIMIT``), and half of one goes off


def mask_distances(inside: BoolArray) -> FloatArray:
    """Return signed distances to the boundary of a mask, in voxels, negative inside.

    Parameters
    ----------
    inside : (nx, ny, nz) bool
        Which samples are inside.

    Returns
    -------
    (nx, ny, nz) float32
        Half a voxel and more; ``REACH - 0.5`` at most.
    """
    roots = np.sqrt(np.arange(REACH * REACH + 1, dtype=np.float32)) - np.float32(0.5)
    squared = squared_distances(inside)
    np.copyto(squared, squared_distances(~inside), where=inside)
    distances = np.empty(inside.shape, np.float32)
    for plane, numbers in zip(distances, squared):  # one by one, to save memory
        plane[...] = roots[numbers]
    return np.negative(distances, out=distances, where=inside)


def squared_distances(marked: BoolArray) -> NDArray[np.uint8]:
    """Return the squared distance of each sample to the nearest marked one, at most ``REACH``^2."""
    squared = np.full(marked.shape, REACH * REACH, np.uint8)
    squared[marked] = 0
    for axis in range(3):
        before = np.moveaxis(squared, axis, 0)
        after = before.copy()
        for step in range(1, min(REACH, len(before))):
            np.minimum(after[step:], before[:-step] + np.uint8(step * step), out=after[step:])
            np.minimum(after[:-step], before[step:] + np.uint8(step * step), out=after[:-step])
        squared = np.moveaxis(after, 0, axis)
    return squared


def mask_planes(inside: SampleArray, h: float) -> DerivedPlanes:
    """Return the distances of a mask, made plane by plane, in world units; ``h`` is the spacing."""
    return DerivedPlanes(inside, mask_distances, REACH, unit=h, each=MASK_BYTES)


def extremes_of_masks(h: float) -> Extremes:
    """Return bounds of the distances of a mask."""
    return (0.5 - REACH) * h, (REACH - 0.5) * h


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
    samples: SampleArray, census: Census, request: Request, notes: list[str], zeros: int = 0
) -> Interpreted:
    """Return the distances of the mask that the signs of numbers make.

    Samples that are 0 have the sign ``zeros``; if that is 0, that of the one side or, of both
    sides, that of the inside.
    """
    low, high = census.extremes
    if low > 0 or high < 0:
        raise GridError(
            f"every value is {'above' if low > 0 else 'below'} 0 (they go from {low:.6g} to "
            f"{high:.6g}), so their signs make no mask: {way_out(census)}"
        )
    below, above, _ = census.numbers.border.tolist()
    is_positive = request.inside == "positive"
    if request.inside == AUTO:
        is_positive = 2 * below > census.border_size
    if high == 0 or zeros > 0 or (low < 0 and zeros == 0 and is_positive):
        mask = changed(samples, partial(np.less_equal, 0), np.bool_)
        return of_mask(mask, below / census.border_size, request, notes)
    return of_mask(above_level(samples, 0), 1 - above / census.border_size, request, notes)


def above_level(samples: SampleArray, level: float) -> SampleArray:
    """Return which samples are above a level."""
    return changed(samples, partial(np.less, level), np.bool_)


def of_mask(mask: SampleArray, lower: float, request: Request, notes: list[str]) -> Interpreted:
    """Return the distances of a mask, which says on which side of a level each sample is.

    They are distances on its lattice, whatever the spacings: a mask shows none in the world.
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
