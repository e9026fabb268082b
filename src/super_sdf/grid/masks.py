"""Masks: grids that only say which samples are inside, and the distances that are made of them.

The surface passes half-way between a sample inside and one outside, for want of better knowledge.
So the distance of a sample is that to the nearest sample of the other side, less half a voxel: the
Euclidean distance transform of both sides (``scipy.ndimage.distance_transform_edt``), which is exact
here up to ``REACH`` voxels and constant beyond: farther samples do not matter to the surface.

Reference: Felzenszwalb and Huttenlocher, "Distance Transforms of Sampled Functions", 2012, for
taking the axes one after the other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray

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
    distances = np.sqrt(np.arange(REACH * REACH + 1, dtype=np.float32)) - np.float32(0.5)
    outside = distances[squared_distances(inside)]
    return np.where(inside, -distances[squared_distances(~inside)], outside)


def squared_distances(marked: BoolArray) -> NDArray[np.uint8]:
    """Return the squared distance of each sample to the nearest marked one, at most ``REACH``^2."""
    squared: NDArray[np.uint8] = np.where(marked, 0, REACH * REACH).astype(np.uint8)
    for axis in range(3):
        before = np.moveaxis(squared, axis, 0)
        after = before.copy()
        for step in range(1, min(REACH, len(before))):
            np.minimum(after[step:], before[:-step] + np.uint8(step * step), out=after[step:])
            np.minimum(after[:-step], before[step:] + np.uint8(step * step), out=after[:-step])
        squared = np.moveaxis(after, 0, axis)
    return squared
