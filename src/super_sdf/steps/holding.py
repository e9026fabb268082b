"""The samples of a mask keep their side, whatever the network says.

A block's value at its sample is raised to ``LEAST`` on the sample's side by adding a pyramid that
is 0 on the faces of the block, so that neighbouring blocks still agree. Then the nodes on the line
to a neighbouring sample of the same side get that side, too: two such samples stay joined.
"""

from __future__ import annotations

import numpy as np

from ..arrays import FloatArray, IntArray
from ..neighbourhood import CENTRE, STRIDES
from .nodes import BARELY_INSIDE, BARELY_OUTSIDE, block_ijk, block_offsets

LEAST = np.float32(0.04)  # half voxels


def hold_sides(blocks: FloatArray, factor: int, patches: FloatArray, voxels: IntArray) -> int:
    """Give every sample its side of the surface, and the lines between samples of one side.

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
    ijk = block_ijk(factor)
    for axis, stride in enumerate(STRIDES):
        for step in (-1, 1):
            place = CENTRE + step * int(stride)
            same = (patches[voxels, place] > 0) == outside
            for node in _nodes_towards(ijk, factor, axis, step):
                lost = np.flatnonzero(same & ((blocks[node, :-1] > 0) != outside))
                blocks[node, lost] = np.where(outside[lost], BARELY_OUTSIDE, BARELY_INSIDE)
    return len(wrong)


def _nodes_towards(ijk: IntArray, factor: int, axis: int, step: int) -> list[int]:
    """Return the nodes of a block from its middle to the middle of a face, without the first."""
    half = factor // 2
    nodes = []
    for distance in range(1, half + 1):
        at = np.full(3, half)
        at[axis] += step * distance
        nodes.append(int(np.flatnonzero((ijk == at).all(1))[0]))
    return nodes
