"""Masks: grids that only say which samples are inside, and the distances that are made of them.

The surface passes half-way between a sample inside and one outside, for want of better knowledge.
So the distance of a sample is that to the nearest sample of the other side, less half a voxel: the
Euclidean distance transform of both sides, exact up to ``REACH`` voxels and constant beyond, since
farther samples do not matter to the surface.

Reference: Felzenszwalb and Huttenlocher, "Distance Transforms of Sampled Functions", 2012, for
taking the axes one after the other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, Triple
from .planes import DerivedPlanes, SampleArray, in_blocks, over_planes
from .samples import Extremes
from .spacing import is_cubic

LEAST_LINES = 20  # samples beside the surface from which a distance transform is recognised
MOST_SQUARE = 50  # up to this, squares of rounded distances are still near whole numbers
# How far apart samples are whose distances are looked at, and the error of these, in spacings.
NEAR_SAMPLES, LATTICE_ERROR = 4, 1e-3
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


def has_both_sides(inside: SampleArray) -> bool:
    """Return whether some samples are inside, and some outside."""
    seen, ranges = [False, False], in_blocks(inside)
    middle = len(ranges) // 2  # which mostly shows both
    for part in (ranges[middle : middle + 1], ranges[:middle] + ranges[middle + 1 :]):
        for outer, inner in over_planes(inside, _sides_of, part):
            seen = [seen[0] or outer, seen[1] or inner]
            if all(seen):
                return True
    return False


def _sides_of(planes: BoolArray) -> tuple[bool, bool]:
    """Return whether some samples are outside, and some inside."""
    return not planes.all(), bool(planes.any())


def is_distance_transform(lines: NDArray[np.float64], spacing: Triple | None = None) -> float:
    """Return the spacing of a distance transform of a mask, 0 if values cannot be one.

    Beside the surface all samples of a side have the same value: 1 spacing to the nearest sample of
    the other side, or half a one to the boundary; on one side it may be 0. All other values lie on
    the lattice of the square roots of whole numbers.

    Parameters
    ----------
    lines : (n, 3, 5) float64
        Five samples in a row along each axis, round samples beside the surface.
    spacing : three floats, optional
        The spacing of each axis, if it is known. If they differ, distances between samples are
        recognised, too; the finest spacing is returned.
    """
    if len(lines) < LEAST_LINES:
        return 0.0
    if spacing is not None and not is_cubic(spacing) and _are_between_samples(lines, spacing):
        return min(spacing)
    centre = lines[:, 0, 2]
    above, below = centre[centre > 0], centre[centre <= 0]
    if not len(above) or not len(below) or not (_are_equal(above) and _are_equal(below)):
        return 0.0
    high, low = float(above.mean()), -float(below.mean())
    apart = high + low
    # d_out - d_in: 1 and 1; half a voxel less: 1/2 and 1/2; one side only: 1 and 0
    for h, less in ((apart / 2, 0.0), (apart, 0.5), (apart, 0.0)):
        starts = (1 - less, 1 - less) if low > 1e-3 * apart else (1.0, 0.0)
        if np.allclose([high / h, low / h], starts, atol=1e-3) and _on_lattice(lines / h, less):
            return h
    return 0.0


def _are_between_samples(lines: NDArray[np.float64], spacing: Triple) -> bool:
    """Return whether values are distances between samples with unequal spacings, or 0 on one side.

    No sample is nearer to one of the other side than the finest spacing.
    """
    steps = np.array(spacing) / min(spacing)
    size = np.abs(lines) / min(spacing)
    signed = bool((lines < 0).any() and (lines > 0).any())
    if not size.any() or (signed and not size.all()) or size[size > 0].min() < 1 - LATTICE_ERROR:
        return False
    whole = np.indices((NEAR_SAMPLES + 1,) * 3).reshape(3, -1).T
    between = np.sort(np.sqrt(((whole * steps) ** 2).sum(1)))
    near = size[size <= NEAR_SAMPLES]
    after = np.searchsorted(between, near).clip(1)
    apart = np.minimum(np.abs(between[after] - near), np.abs(near - between[after - 1]))
    return bool((apart <= LATTICE_ERROR).all())


def _are_equal(values: NDArray[np.float64]) -> bool:
    """Return whether all values are the same, but for rounding."""
    return bool(np.ptp(values) <= 1e-4 * np.abs(values).max())


def _on_lattice(spacings: NDArray[np.float64], less: float) -> bool:
    """Return whether distances, plus ``less``, are roots of whole numbers, and not all whole."""
    squares = (np.abs(spacings) + less * (spacings != 0)) ** 2
    same_side = np.sign(spacings[..., 1:]) * np.sign(spacings[..., :-1]) > 0
    if np.abs(np.diff(spacings))[same_side].max(initial=0) > 1 + 1e-3:
        return False  # exact distances to planes half-way between samples, in half spacings
    near = squares[squares < MOST_SQUARE]
    whole = bool((np.abs(near - np.rint(near)) < 2e-3 * np.maximum(near, 1)).all())
    roots = np.sqrt(np.unique(np.rint(near)))
    return whole and bool((np.abs(roots - np.rint(roots)) > 1e-6).any())
