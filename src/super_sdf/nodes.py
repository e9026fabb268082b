"""The fine lattice: the nodes of each voxel's block, and one value for each shared node.

Nodes are points of spacing h/K. A voxel's block is its (K+1)^3 nodes, faces included (Eq. 3), in
C order. The fine index of coarse sample i is ``K*i + K/2``.
"""

from __future__ import annotations

import numpy as np

from .band import CENTRE, NEIGHBOURHOOD
from .errors import OptionError
from .grid import BoolArray, FloatArray, IntArray

MAX_FACTOR = 16
# What a node is set to when only its sign is known.
BARELY_INSIDE, BARELY_OUTSIDE = np.float32(-1e-3), np.float32(1e-3)


def check_factor(factor: int) -> int:
    """Return the factor if it is even and 2 to 16: an odd one has no node on the sample."""
    if not 2 <= factor <= MAX_FACTOR or factor % 2:
        raise OptionError(
            f"factor is {factor}: give an even number from 2 to {MAX_FACTOR} "
            "(an odd one has no node on the samples)"
        )
    return factor


def block_ijk(factor: int) -> IntArray:
    """Return the block's nodes counted from the voxel's low corner, (Q, 3) in 0..K."""
    side = factor + 1
    return np.indices((side,) * 3).reshape(3, -1).T.astype(np.int32)


def block_offsets(factor: int) -> FloatArray:
    """Return the block's query offsets ``2 (q - p) / h``, (Q, 3) in [-1, 1] (Eqs. 3 and 5)."""
    return (block_ijk(factor) * (2.0 / factor) - 1.0).astype(np.float32)


def number_shared_nodes(table: IntArray, factor: int) -> tuple[IntArray, int]:
    """Number the nodes of all blocks so that a shared node has one number.

    A block has 27 parts: 8 corners, 12 edges, 6 faces and the inside. A part is shared as a whole;
    it belongs to the first of the voxels that share it, and its nodes have consecutive numbers. So
    numbering 27 parts a voxel numbers all nodes, and nothing is sorted.

    Parameters
    ----------
    table : (D, 27) int32
        Neighbours among the D voxels themselves, -1 where there is none.
    factor : int
        K.

    Returns
    -------
    (D, Q) int32 and int
        The number of each block's nodes, and how many different nodes there are.
    """
    part_of, place_in_part = _parts(factor)
    owner, owner_part = _owners(table)
    own = owner == np.arange(len(table), dtype=np.int32)[:, None]
    sizes = own * np.bincount(part_of, minlength=27).astype(np.int32)
    ends = np.cumsum(sizes.ravel(), dtype=np.int32).reshape(sizes.shape)
    starts = (ends - sizes)[owner, owner_part]
    count = int(ends.flat[-1]) if ends.size else 0
    return starts[:, part_of] + place_in_part, count


def _parts(factor: int) -> tuple[IntArray, IntArray]:
    """Return for each block node its part, 0 to 26 as ``NEIGHBOURHOOD``, and its place in it."""
    block = block_ijk(factor)
    side = np.where(block == 0, 0, np.where(block == factor, 2, 1))
    part = (side @ np.array([9, 3, 1])).astype(np.int32)
    place = np.empty_like(part)
    for number in range(27):
        columns = np.flatnonzero(part == number)
        place[columns] = np.arange(len(columns))
    return part, place


def _owners(table: IntArray) -> tuple[IntArray, IntArray]:
    """Return for each part of each voxel, (D, 27), the voxel it belongs to, and as which part."""
    owner, owner_part = np.empty_like(table), np.empty_like(table)
    for part, sides in enumerate(NEIGHBOURHOOD):
        sharing = np.flatnonzero(((NEIGHBOURHOOD == 0) | (sides == NEIGHBOURHOOD)).all(1))
        first = sharing[(table[:, sharing] >= 0).argmax(1)]
        owner[:, part] = np.take_along_axis(table, first[:, None], 1)[:, 0]
        # Seen from the owner, one step away on some axes, the part is on the other side there.
        mirrored = sides - 2 * NEIGHBOURHOOD[first]
        owner_part[:, part] = (mirrored + 1) @ np.array([9, 3, 1])
    return owner, owner_part


def average_shared(blocks: FloatArray, numbers: IntArray, count: int) -> FloatArray:
    """Return one value a node: the mean over the blocks that predict it (Eq. 7).

    ``blocks`` and ``numbers`` are (D, Q); the result is (count,). The sum runs in the order of
    the voxels, in double precision, so it does not depend on how the work was divided.
    """
    flat = numbers.ravel()
    total = np.bincount(flat, weights=blocks.ravel(), minlength=count)
    return (total / np.bincount(flat, minlength=count)).astype(np.float32)


def pin_to_skipped(values: FloatArray, numbers: IntArray, skipped: IntArray, factor: int) -> int:
    """Give nodes shared with a voxel that was not decoded that voxel's sign.

    Such a voxel holds no surface, so all its nodes have its sign; with this no sign change can
    reach the edge of what was decoded, and the isosurface has no hole there.

    Parameters
    ----------
    values : (n,) float32
        Node values, changed in place.
    numbers : (D, Q) int32
        The nodes of each decoded voxel.
    skipped : (D, 27) int8
        The sign of each neighbour that was not decoded (-1 inside, 1 outside), else 0.

    Returns
    -------
    int
        How many nodes had the other sign.
    """
    block = block_ijk(factor)
    pinned = 0
    for place, step in enumerate(NEIGHBOURHOOD):
        rows = np.flatnonzero(skipped[:, place])
        if place == CENTRE or not len(rows):
            continue
        columns = np.flatnonzero(_on_side(block, step, factor))
        nodes = numbers[rows[:, None], columns]
        outside = np.broadcast_to(skipped[rows, place, None] > 0, nodes.shape)
        wrong = (values[nodes] > 0) != outside
        pinned += len(np.unique(nodes[wrong]))
        values[nodes[wrong]] = np.where(outside[wrong], BARELY_OUTSIDE, BARELY_INSIDE)
    return pinned


def _on_side(block: IntArray, step: IntArray, factor: int) -> BoolArray:
    """Say which block nodes are shared with the neighbour at ``step``."""
    edge = np.where(step > 0, factor, 0)
    on_side: BoolArray = ((step == 0) | (block == edge)).all(1)
    return on_side
