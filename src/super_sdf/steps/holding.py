"""The samples of a mask keep their side, whatever the network says.

A block's value at its sample is raised to ``LEAST`` on the sample's side by adding a pyramid that
is 0 on the faces of the block, so that neighbouring blocks still agree. The lines between samples
are the network's: it joins slices of a thin vessel or plate across the line between two samples
outside, and to hold that line would drill a hole into the joint.
"""

from __future__ import annotations

import numpy as np

from ..arrays import FloatArray, IntArray
from ..neighbourhood import CENTRE
from .nodes import block_offsets

LEAST = np.float32(0.04)  # half voxels


def hold_sides(blocks: FloatArray, factor: int, patches: FloatArray, voxels: IntArray) -> int:
    """Give every sample its side of the surface.

    Parameters
    ----------
    blocks : (Q, D + 1) float32
        Node values in half voxels, changed in place.
    factor : int
        K.
    patches : (V, 27) float32
        The samples round each voxel of the band.
    voxels : (D,) int32
        The rows of the band that were decoded.

    Returns
    -------
    int
        How many samples had to be raised.
    """
    sample = patches[voxels, CENTRE]
    outside = sample > 0
    sign = np.where(outside, np.float32(1), np.float32(-1))
    middle = len(blocks) // 2
    missing = np.maximum(LEAST - sign * blocks[middle, :-1], 0)
    wrong = np.flatnonzero(missing)
    pyramid = (1 - np.abs(block_offsets(factor))).prod(1).astype(np.float32)
    blocks[:, wrong] += pyramid[:, None] * (sign * missing)[wrong]
    return len(wrong)
