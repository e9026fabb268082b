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

from ..arrays import BoolArray, FloatArray
from .planes import DerivedPlanes, SampleArray, in_blocks, over_planes
from .samples import Extremes

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
