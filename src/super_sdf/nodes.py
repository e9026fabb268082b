"""The fine lattice: the nodes of each voxel's block, and one value for each shared node.

Nodes are points of spacing h/K. A voxel's block is its (K+1)^3 nodes, faces included (Eq. 3), in
C order. The fine index of coarse sample i is ``K*i + K/2``.
"""

from __future__ import annotations

from itertools import product

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

    A node belongs to the first of the 1, 2, 4 or 8 voxels that share it, so no sorting is needed.

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
    owner, owner_local = _owners(table, factor)
    own = owner == np.arange(len(table), dtype=np.int32)[:, None]
    numbers = np.cumsum(own.ravel(), dtype=np.int32).reshape(own.shape) - np.int32(1)
    count = int(numbers.flat[-1]) + 1 if numbers.size else 0
    return numbers[owner, owner_local], count


def _owners(table: IntArray, factor: int) -> tuple[IntArray, IntArray]:
    """Return for each block node the voxel it belongs to and its place in that voxel's block."""
    block = block_ijk(factor)
    side = np.where(block == 0, -1, np.where(block == factor, 1, 0))
    strides = np.array([(factor + 1) ** 2, factor + 1, 1])
    voxels, nodes = len(table), len(block)
    owner = np.empty((voxels, nodes), np.int32)
    local = np.empty((voxels, nodes), np.int32)
    for sides in product((-1, 0, 1), repeat=3):
        columns = np.flatnonzero((side == sides).all(1))
        sharing = _sharing_voxels(sides)
        present = table[:, sharing] >= 0
        first = present.argmax(1)
        shift = (factor * NEIGHBOURHOOD[sharing] @ strides).astype(np.int32)
        owner[:, columns] = table[np.arange(voxels), np.asarray(sharing)[first]][:, None]
        local[:, columns] = columns[None, :] - shift[first][:, None]
    return owner, local


def _sharing_voxels(sides: tuple[int, ...]) -> list[int]:
    """Return the places of the neighbourhood whose voxels share a node on these sides."""
    return [
        place
        for place, step in enumerate(NEIGHBOURHOOD)
        if all(move in (0, side) for move, side in zip(step, sides))
    ]


def average_shared(blocks: FloatArray, numbers: IntArray, count: int) -> FloatArray:
    """Return one value a node: the mean over the blocks that predict it (Eq. 7).

    ``blocks`` and ``numbers`` are (D, Q); the result is (count,). The sum runs in the order of
    the voxels, in double precision, so it does not depend on how the work was divided.
    """
    flat = numbers.ravel()
    total = np.bincount(flat, weights=blocks.ravel(), minlength=count)
    return (total / np.bincount(flat, minlength=count)).astype(np.float32)


def keep_samples(values: FloatArray, numbers: IntArray, samples: FloatArray) -> None:
    """Put the coarse samples, (D,), back at their nodes: the middles of the blocks (Sec. 4.1)."""
    values[numbers[:, numbers.shape[1] // 2]] = samples


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
