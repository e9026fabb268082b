"""The fine lattice: the nodes of each voxel's block, and the averaging of nodes that blocks share.

Nodes have spacing h/K. A voxel's block is its Q = (K+1)^3 nodes, faces included (Eq. 3), in C
order. Coarse sample i has the fine index ``K*i + K/2``.

Values are stored by block in an array (Q, D): a row per node of the block, a column per voxel.
Blocks that share a node each hold a copy of its value; ``average_shared`` makes the copies equal,
bit for bit. One more column, always 0, stands for absent voxels: their index -1 reads it.

A block has 27 parts: 8 corners, 12 edges, 6 faces and the interior, in the order of
``NEIGHBOURHOOD``. Voxels share whole parts. A part belongs to the first of the voxels that share
it (its owner), which decides where its nodes are counted and numbered.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import CENTRE, NEIGHBOURHOOD, STRIDES, BoolArray, FloatArray, IntArray
from ..threads import check_count, over_threads, worthwhile_threads

# Half voxels: the value of a node of which only the sign is known, the least of a mask's sample.
BARELY_INSIDE, BARELY_OUTSIDE = np.float32(-1e-3), np.float32(1e-3)
LEAST_OF_MASK = np.float32(0.04)

# The neighbours that share each part, the voxel itself included.
SHARING = [
    np.flatnonzero(((NEIGHBOURHOOD == 0) | (part == NEIGHBOURHOOD)).all(1))
    for part in NEIGHBOURHOOD
]


def block_ijk(factor: int) -> IntArray:
    """Return the indices of the block's nodes from the voxel's low corner, (Q, 3) in 0..K."""
    return np.indices((factor + 1,) * 3).reshape(3, -1).T.astype(np.int32)


def block_offsets(factor: int) -> FloatArray:
    """Return the block's query offsets ``2 (q - p) / h``, (Q, 3) in [-1, 1] (Eqs. 3 and 5)."""
    return (block_ijk(factor) * (2.0 / factor) - 1.0).astype(np.float32)


@lru_cache
def part_of_node(factor: int) -> IntArray:
    """Return the part of each node of a block, (Q,) in 0..26."""
    block = block_ijk(factor)
    side = np.where(block == 0, 0, np.where(block == factor, 2, 1))
    return np.asarray(side @ STRIDES, np.int32)


@lru_cache
def nodes_of_part(factor: int) -> list[NDArray[np.intp]]:
    """Return the nodes of each of the 27 parts, as indices into the block."""
    return [np.flatnonzero(part_of_node(factor) == part) for part in range(27)]


def seen_from(part: int, neighbour: int | np.integer[Any]) -> int:
    """Return the number that a shared part has in a neighbour: it is on the other side there."""
    return int((NEIGHBOURHOOD[part] - 2 * NEIGHBOURHOOD[neighbour] + 1) @ STRIDES)


def within(voxel_ijk: NDArray[np.integer], shape: tuple[int, int, int]) -> BoolArray:
    """Return which voxels (..., 3) are in a grid of a shape, (...,)."""
    return np.asarray(((voxel_ijk >= 0) & (voxel_ijk < shape)).all(-1))


class VoxelIndex:
    """The rows of voxels (n, 3), in C order, by their place in a grid of a shape."""

    def __init__(self, voxel_ijk: IntArray, shape: tuple[int, int, int]) -> None:
        self.shape, self.strides = shape, np.array([shape[1] * shape[2], shape[2], 1], np.int64)
        self.keys = voxel_ijk @ self.strides  # numbers in C order of the whole grid

    def find(self, voxel_ijk: NDArray[np.integer]) -> NDArray[np.int64]:
        """Return the row of each voxel (..., 3), -1 if it is not in the list, (...,)."""
        wanted = voxel_ijk @ self.strides
        at = np.searchsorted(self.keys, wanted)
        found = (self.keys.take(at, mode="clip") == wanted) if len(self.keys) else False
        return np.where(found & within(voxel_ijk, self.shape), at, -1)


@dataclass(frozen=True, eq=False)
class SharedParts:
    """Which voxels share the parts of their blocks."""

    table: IntArray  # (27, D), neighbour table of the D voxels, -1 where there is no neighbour
    owner: NDArray[np.int8]  # (27, D), of each part, as a place: ``CENTRE`` is the voxel itself


def share_parts(table: IntArray) -> SharedParts:
    """Return the owners of all parts, given the voxels' neighbour table, (D, 27) int32."""
    by_place = np.ascontiguousarray(table.T)
    owner = np.full(by_place.shape, CENTRE, np.int8)
    for part, sharing in enumerate(SHARING):
        for place in sharing[sharing < CENTRE][::-1]:  # the first is written last
            np.copyto(owner[part], place, where=by_place[place] >= 0)
    return SharedParts(by_place, owner)


def number_parts(parts: SharedParts, factor: int) -> tuple[IntArray, int]:
    """Return the number of the first node of each part, (27, D) int32, and the number of nodes.

    They come in the order of the voxels that own them. OptionError if 32-bit numbers are too few.
    """
    owned = parts.owner == CENTRE
    size = np.array([[len(nodes)] for nodes in nodes_of_part(factor)], np.int32)
    count = check_count(int(size[:, 0] @ np.count_nonzero(owned, axis=1)), "nodes")
    ends = np.cumsum(owned * size, axis=0, dtype=np.int32)
    starts = ends - size + (np.cumsum(ends[-1], dtype=np.int32) - ends[-1])  # after earlier voxels
    for part, sharing in enumerate(SHARING):
        for place in sharing[sharing < CENTRE]:
            rows = np.flatnonzero(parts.owner[part] == place)
            starts[part, rows] = starts[seen_from(part, place), parts.table[place, rows]]
    return starts, count


def average_shared(blocks: FloatArray, parts: SharedParts, factor: int, threads: int = 1) -> None:
    """Set each copy of a shared node to the mean of the copies (Eq. 7), in ``blocks`` (Q, D + 1).

    Sums are taken in the order of the voxels and in double precision (of two numbers in single), so
    that all copies are equal.
    """
    nodes = nodes_of_part(factor)

    def average(part: int) -> None:
        """Average the nodes of one part in the blocks of the voxels that own it."""
        own = np.flatnonzero(parts.owner[part] == CENTRE)
        later = SHARING[part][SHARING[part] > CENTRE]  # those that also have it
        voxels = parts.table[later].take(own, 1)
        kind = np.float32 if len(SHARING[part]) == 2 else np.float64
        times = 1 + np.sum(voxels >= 0, 0, kind)
        there = [np.flatnonzero(voxel >= 0) for voxel in voxels]
        for copies in zip(nodes[part], *(nodes[seen_from(part, place)] for place in later)):
            total = blocks[copies[0]].take(own).astype(kind, copy=False)
            for node, voxel in zip(copies[1:], voxels):
                total += blocks[node].take(voxel)  # 0 where there is none
            mean = (total / times).astype(np.float32)
            blocks[copies[0], own] = mean
            for node, voxel, some in zip(copies[1:], voxels, there):
                blocks[node, voxel[some]] = mean[some]

    shared = [part for part in range(27) if part != CENTRE and SHARING[part][-1] > CENTRE]
    list(over_threads(average, shared, worthwhile_threads(blocks.size, threads)))


def hold_sides(blocks: FloatArray, factor: int, samples: FloatArray) -> None:
    """Give every sample of a mask its side, whatever the network says, in ``blocks`` (Q, D).

    To a block whose sample, of ``samples`` (D,), has the wrong sign, a pyramid is added that is 0
    on the faces, so that neighbouring blocks still agree. Lines between samples are the network's:
    it joins slices of a thin vessel or plate across the line between two samples outside.
    """
    sign = np.where(samples > 0, np.float32(1), np.float32(-1))
    missing = np.maximum(LEAST_OF_MASK - sign * blocks[len(blocks) // 2], 0)
    wrong = np.flatnonzero(missing)
    pyramid = (1 - np.abs(block_offsets(factor))).prod(1).astype(np.float32)
    blocks[:, wrong] += pyramid[:, None] * (sign * missing)[wrong]


def pin_to_skipped(
    blocks: FloatArray,
    parts: SharedParts,
    factor: int,
    voxel_ijk: IntArray,
    patches: FloatArray,
    shape: tuple[int, int, int],
) -> None:
    """Give the nodes shared with a skipped voxel that voxel's sign, in ``blocks`` (Q, D).

    A skipped voxel was not decoded, so it holds no surface, and all its nodes have the sign of its
    sample. Once they do, no sign change reaches the boundary of the decoded voxels (D, 3), and the
    isosurface has no hole there. ``patches`` (D, 27) are the samples round these.
    """
    skipped = np.zeros((27, len(voxel_ijk)), np.int8)  # the sign of neighbours, 0 of decoded ones
    for signs, row, samples, step in zip(skipped, parts.table, patches.T, NEIGHBOURHOOD):
        at = np.flatnonzero(row < 0)
        at = at[within(voxel_ijk[at] + step, shape)]
        signs[at] = np.where(samples[at] > 0, 1, -1)
    for sharing, nodes in zip(SHARING, nodes_of_part(factor)):
        sign = np.zeros(len(voxel_ijk), np.int8)
        for signs in skipped[sharing]:
            np.copyto(sign, signs, where=signs != 0)
        known = np.flatnonzero(sign)
        outside = sign[known] > 0
        barely = np.where(outside, BARELY_OUTSIDE, BARELY_INSIDE)
        for node in nodes:
            values = blocks[node].take(known)
            blocks[node, known] = np.where((values > 0) == outside, values, barely)


def take_lone_points_out(blocks: FloatArray, factor: int) -> None:
    """Put samples of 0 outside whose six nodes beside are outside, in ``blocks`` (Q, D).

    0 counts as inside, so a single sample of 0, as on an edge, would get a mesh without volume.
    """
    middle = len(blocks) // 2
    around = np.flatnonzero(np.abs(block_ijk(factor) - factor // 2).sum(1) == 1)
    points = np.flatnonzero(blocks[middle] == 0)
    lone = (blocks[around[:, None], points] > 0).all(0)
    blocks[middle, points[lone]] = BARELY_OUTSIDE
