"""The fine lattice: the nodes of each voxel's block, and the mean of those that blocks share.

Nodes are points of spacing h/K. A voxel's block is its (K+1)^3 nodes, faces included (Eq. 3), in
C order. The fine index of coarse sample i is ``K*i + K/2``.

Values are kept block by block, (Q, D): a row for each of the block's Q nodes, a column for each
voxel. What is done to a node is so done to all voxels in one pass over contiguous memory. Blocks
that share a node have a copy of it each, and from ``average_shared`` on the copies are equal, bit
for bit. One column more, always 0, stands for voxels that are not there: index -1 reads it.

A block has 27 parts: 8 corners, 12 edges, 6 faces and the inside, in the order of
``NEIGHBOURHOOD``. A part is shared as a whole, and belongs to the first of the voxels that share
it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray, Signs
from ..errors import OptionError, OptionTypeError, seen
from ..machine.index_width import check_count
from ..machine.threads import map_threads, worthwhile
from ..neighbourhood import CENTRE, NEIGHBOURHOOD, STRIDES

MAX_FACTOR = 16
# What a node is set to when only its sign is known.
BARELY_INSIDE, BARELY_OUTSIDE = np.float32(-1e-3), np.float32(1e-3)

# The neighbours that share each part, the voxel itself among them: those that lie on its side.
SHARING = [
    np.flatnonzero(((NEIGHBOURHOOD == 0) | (sides == NEIGHBOURHOOD)).all(1))
    for sides in NEIGHBOURHOOD
]


def check_factor(factor: Any) -> int:
    """Return the factor if it is even and 2 to 16: an odd one has no node on the sample."""
    if not isinstance(factor, Integral) or isinstance(factor, bool):
        raise OptionTypeError(f"factor is {seen(factor)}: give a whole number")
    whole = int(factor)
    if not 2 <= whole <= MAX_FACTOR or whole % 2:
        raise OptionError(
            f"factor is {seen(whole)}: give an even number from 2 to {MAX_FACTOR} "
            "(an odd one has no node on the samples)"
        )
    return whole


def block_ijk(factor: int) -> IntArray:
    """Return the block's nodes counted from the voxel's low corner, (Q, 3) in 0..K."""
    side = factor + 1
    return np.indices((side,) * 3).reshape(3, -1).T.astype(np.int32)


def block_offsets(factor: int) -> FloatArray:
    """Return the block's query offsets ``2 (q - p) / h``, (Q, 3) in [-1, 1] (Eqs. 3 and 5)."""
    return (block_ijk(factor) * (2.0 / factor) - 1.0).astype(np.float32)


@lru_cache
def part_of_node(factor: int) -> tuple[IntArray, IntArray]:
    """Return for each block node its part, 0 to 26, and its place in it."""
    block = block_ijk(factor)
    part = (np.where(block == 0, 0, np.where(block == factor, 2, 1)) @ STRIDES).astype(np.int32)
    place = np.empty_like(part)
    for number in range(27):
        place[part == number] = np.arange((part == number).sum())
    return part, place


@lru_cache
def nodes_of_part(factor: int) -> list[NDArray[np.intp]]:
    """Return the block nodes of each part."""
    part, _ = part_of_node(factor)
    return [np.flatnonzero(part == number) for number in range(27)]


@lru_cache
def part_sizes(factor: int) -> NDArray[np.int64]:
    """Return how many nodes each part has, (27,)."""
    return np.array([len(nodes) for nodes in nodes_of_part(factor)])


def seen_from(part: int, neighbour: int | np.integer[Any]) -> int:
    """Return which part of a neighbour that shares it a part is: it is on the other side there."""
    return int((NEIGHBOURHOOD[part] - 2 * NEIGHBOURHOOD[neighbour] + 1) @ STRIDES)


@dataclass(frozen=True, eq=False)
class SharedParts:
    """Which voxels share the parts of their blocks.

    Attributes
    ----------
    table : (27, D) int32
        Neighbours among the D voxels themselves, -1 where there is none.
    owner : (27, D) int8
        Where the voxel that owns a part stands, as a place in the neighbourhood: ``CENTRE`` for
        the voxel itself.
    """

    table: IntArray
    owner: Signs

    def owned(self, rows: slice = slice(None)) -> BoolArray:
        """Say which parts some voxels own, (27, n)."""
        own: BoolArray = self.owner[:, rows] == CENTRE
        return own

    def count_nodes(self, factor: int, rows: slice = slice(None)) -> int:
        """Return how many nodes belong to some voxels."""
        parts = np.count_nonzero(self.owned(rows), axis=1)
        return int(parts @ part_sizes(factor))


def share_parts(table: IntArray) -> SharedParts:
    """Find the owner of each part, given the voxels' neighbours among themselves, (D, 27)."""
    by_place = np.ascontiguousarray(table.T)
    there = by_place >= 0
    owner = np.full(by_place.shape, CENTRE, np.int8)
    for part, sharing in enumerate(SHARING):
        for place in sharing[sharing < CENTRE][::-1]:  # the first comes last, and stays
            np.copyto(owner[part], place, where=there[place])
    return SharedParts(by_place, owner)


def number_parts(parts: SharedParts, sizes: NDArray[np.int64]) -> tuple[IntArray, int]:
    """Number the nodes of all parts, in the order of the voxels that own them.

    Parameters
    ----------
    parts : SharedParts
        Of D voxels.
    sizes : (27,) int64
        How many nodes a part has.

    Returns
    -------
    (27, D) int32 and int
        The number of the first node of each part, and how many nodes there are.

    Raises
    ------
    OptionError
        If there are more than 32-bit numbers.
    """
    owned = parts.owned()
    count = check_count(int(np.count_nonzero(owned, axis=1) @ sizes), "nodes")
    starts = np.cumsum(owned * sizes[:, None].astype(np.int32), axis=0, dtype=np.int32)
    before = np.cumsum(starts[-1], dtype=np.int32) - starts[-1]  # of earlier voxels
    starts += before - sizes[:, None].astype(np.int32)
    for part, sharing in enumerate(SHARING):
        for place in sharing[sharing < CENTRE]:
            rows = np.flatnonzero(parts.owner[part] == place)
            neighbour = parts.table[place].take(rows)
            starts[part][rows] = starts[seen_from(part, place)].take(neighbour)
    return starts, count


def average_shared(blocks: FloatArray, parts: SharedParts, factor: int, threads: int = 1) -> None:
    """Set each copy of a shared node to the mean of the copies (Eq. 7).

    Parameters
    ----------
    blocks : (Q, D + 1) float32
        A prediction for each node of each block, changed in place; the last column is 0.
    parts : SharedParts
        Of the D voxels.
    factor : int
        K.
    threads : int
        How many work at a time.

    Notes
    -----
    Sums run in the order of the voxels, in double precision (two numbers need none), so that all
    copies get the same bits and the result does not depend on how the work was divided.
    """
    groups = [axes for axes in product((False, True), repeat=3) if any(axes)]
    threads = worthwhile(blocks.size, threads)
    map_threads(lambda axes: _average_group(blocks, parts.table, factor, axes), groups, threads)


def _average_group(
    blocks: FloatArray, table: IntArray, factor: int, axes: tuple[bool, ...]
) -> None:
    """Average the nodes that are shared across some axes and inside along the others."""
    sides, columns = columns_of_group(factor, axes)
    kind = np.float32 if len(sides) == 2 else np.float64
    means = []
    for own in sides:
        total: NDArray[Any] = np.zeros((len(columns[0]), table.shape[1]), kind)
        times: NDArray[Any] = np.zeros(table.shape[1], kind)
        for other, nodes in zip(sides, columns):
            if other is own:
                total += blocks[nodes, :-1]
                times += 1
                continue
            voxel = table[CENTRE + int((own - other) @ STRIDES)].astype(np.intp)
            times += voxel >= 0
            for row, node in enumerate(nodes):
                total[row] += blocks[node].take(voxel)
        means.append((total / times).astype(np.float32))
    for nodes, mean in zip(columns, means):
        blocks[nodes, :-1] = mean


@lru_cache
def columns_of_group(
    factor: int, axes: tuple[bool, ...]
) -> tuple[list[IntArray], list[NDArray[np.intp]]]:
    """Return the sides at which voxels can meet, in their order, and the nodes seen from each.

    Sides are (3,), 1 for a node at the voxel's high end of an axis, 0 at its low end and along the
    other axes.
    """
    block = block_ijk(factor)
    ends = [(1, 0) if shared else (0,) for shared in axes]
    sides = [np.array(side, np.int32) for side in product(*ends)]
    inner = (block > 0) & (block < factor)
    columns = [
        np.flatnonzero(np.where(axes, block == factor * side, inner).all(1)) for side in sides
    ]
    return sides, columns


def signs_of_skipped(
    parts: SharedParts,
    voxel_ijk: IntArray,
    patches: FloatArray,
    voxels: IntArray,
    shape: tuple[int, int, int],
) -> Signs:
    """Return the signs of the voxels beside the decoded ones that were not decoded.

    Parameters
    ----------
    parts : SharedParts
        Of the decoded voxels.
    voxel_ijk : (D, 3) int32
        The decoded voxels.
    patches : (V, 27) float32
        The band's samples, which have the signs of the neighbours.
    voxels : (D,) int32
        Which rows of the band were decoded.
    shape : three ints
        Samples of the grid: beyond it nothing was skipped.

    Returns
    -------
    (27, D) int8
        1 outside, -1 inside; 0 where nothing was skipped.
    """
    signs = np.zeros(parts.table.shape, np.int8)
    inner = [(ijk != 0, ijk != n - 1) for ijk, n in zip(np.ascontiguousarray(voxel_ijk.T), shape)]
    for place, step in enumerate(NEIGHBOURHOOD):
        skipped = parts.table[place] < 0
        for axis in np.flatnonzero(step):  # beyond the grid nothing was skipped
            skipped &= inner[axis][int(step[axis] > 0)]
        rows = np.flatnonzero(skipped)
        signs[place][rows] = np.where(patches[voxels.take(rows), place] > 0, 1, -1)
    return signs


def pin_to_skipped(
    blocks: FloatArray, parts: SharedParts, factor: int, skipped: Signs
) -> NDArray[np.int64]:
    """Give nodes shared with a voxel that was not decoded that voxel's sign.

    Such a voxel holds no surface, so all its nodes have its sign; with this no sign change can
    reach the edge of what was decoded, and the isosurface has no hole there.

    Parameters
    ----------
    blocks : (Q, D) float32
        Node values, changed in place.
    parts : SharedParts
        Of the decoded voxels.
    factor : int
        K.
    skipped : (27, D) int8
        From ``signs_of_skipped``. No two skipped voxels round a node differ in sign.

    Returns
    -------
    (D,) int64
        How many nodes of each voxel's own had the other sign.
    """
    changed = np.zeros(skipped.shape[1], np.int64)
    for part, nodes in enumerate(nodes_of_part(factor)):
        sign = np.zeros(skipped.shape[1], np.int8)
        for place in SHARING[part]:
            np.copyto(sign, skipped[place], where=skipped[place] != 0)
        known, outside = sign != 0, sign > 0
        for node in nodes:
            wrong = known & ((blocks[node] > 0) != outside)
            if wrong.any():
                blocks[node, wrong] = np.where(outside[wrong], BARELY_OUTSIDE, BARELY_INSIDE)
                changed += wrong & (parts.owner[part] == CENTRE)
    return changed
