"""The 27 voxels of a neighbourhood, in the order of patches and neighbour tables."""

from __future__ import annotations

import numpy as np

from .arrays import IntArray

NEIGHBOURHOOD: IntArray = np.indices((3, 3, 3)).reshape(3, 27).T.astype(np.int32) - 1
"""Steps from the centre voxel, (27, 3)."""
CENTRE = 13
"""Index of the centre voxel itself."""
STRIDES = np.array([9, 3, 1])
"""Difference of the indices of two places next to each other along each axis."""
