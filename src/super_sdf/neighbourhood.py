"""The 27 voxels of a neighbourhood, in the order of patches and neighbour tables."""

from __future__ import annotations

import numpy as np

from .arrays import IntArray

NEIGHBOURHOOD: IntArray = np.indices((3, 3, 3)).reshape(3, 27).T.astype(np.int32) - 1
"""Steps from the voxel in the middle, (27, 3)."""
CENTRE = 13
"""The place of the voxel itself."""
STRIDES = np.array([9, 3, 1])
"""From a place to the next along each axis."""
