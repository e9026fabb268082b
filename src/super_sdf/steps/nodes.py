"""The fine lattice: the nodes of each voxel's block, and one value for each shared node.

Nodes are points of spacing h/K. A voxel's block is its (K+1)^3 nodes, faces included (Eq. 3), in
C order. The fine index of coarse sample i is ``K*i + K/2``.

A block has 27 parts: 8 corners, 12 edges, 6 faces and the inside, in the order of
``NEIGHBOURHOOD``. A part is shared as a whole; it belongs to the first of the voxels that share it,
and its nodes have consecutive numbers. So numbering 27 parts a voxel numbers all nodes, and nothing
is sorted or searched.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray, Signs
from ..errors import OptionError, OptionTypeError, seen
from ..machine.compiling import compiled_twin
from ..machine.index_width import check_count
from ..machine.threads import in_chunks
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


def seen_from(part: int, neighbour: int | np.integer[Any]) -> int:
    """Return which part of a neighbour that shares it a part is: it is on the other side there."""
    return int((NEIGHBOURHOOD[part] - 2 * NEIGHBOURHOOD[neighbour] + 1) @ STRIDES)


@dataclass(frozen=True, eq=False)
class SharedNodes:
    """Numbers for the nodes of some blocks: a node that blocks share has one number.

    Attributes
    ----------
    factor : int
        K.
    table : (D, 27) int32
        Neighbours among the D voxels themselves, -1 where there is none.
    starts : (D, 27) int32
        The number of the first node of each part.
    owned : (D, 27) bool
        Which parts belong to the voxel itself.
    count : int
        How many different nodes there are.
    """

    factor: int
    table: IntArray
    starts: IntArray
    owned: BoolArray
    count: int

    def numbers(self, rows: slice | NDArray[np.integer[Any]] = slice(None)) -> IntArray:
        """Return the nodes of some blocks, (n, Q)."""
        part, place = part_of_node(self.factor)
        return self.starts[rows][:, part] + place

    def owned_before(self, row: int) -> int:
        """Return how many nodes belong to the voxels before a row: theirs come first."""
        if row == len(self.starts):
            return self.count
        return int(self.starts[row][self.owned[row]].min())


def number_shared_nodes(table: IntArray, factor: int) -> SharedNodes:
    """Number the nodes of all blocks of voxels whose neighbours among themselves are given.

    Raises
    ------
    OptionError
        If there are more than can be numbered.
    """
    sizes = np.array([len(nodes) for nodes in nodes_of_part(factor)], np.int32)
    starts, owned, count = compiled_twin(_number_parts)(table, sizes)
    check_count(count, "nodes in a slab", factor)
    return SharedNodes(factor, table, starts, owned, count)


def _number_parts(table: IntArray, sizes: IntArray) -> tuple[IntArray, BoolArray, int]:
    """Return ``starts``, ``owned`` and ``count`` for parts of ``sizes`` nodes each.

    ``starts`` is meaningless if ``count`` exceeds 32 bits: the caller checks ``count`` first.
    """
    owned = np.stack([(table[:, sharing[sharing < CENTRE]] < 0).all(1) for sharing in SHARING], 1)
    own_sizes = owned * sizes
    own_starts = np.cumsum(own_sizes.ravel(), dtype=np.int32).reshape(table.shape)
    own_starts -= own_sizes
    del own_sizes
    starts = np.empty_like(own_starts)
    for part, sharing in enumerate(SHARING):
        first = sharing[(table[:, sharing] >= 0).argmax(1)]
        as_part = np.array([seen_from(part, neighbour) for neighbour in range(27)])[first]
        owner = np.take_along_axis(table, first[:, None], 1)[:, 0]
        starts[:, part] = own_starts[owner, as_part]
    return starts, owned, int(owned.sum(0, dtype=np.int64) @ sizes)


def average_shared(blocks: FloatArray, nodes: SharedNodes) -> FloatArray:
    """Return one value a node: the mean over the blocks that predict it (Eq. 7).

    ``blocks`` is (D, Q); the result is (count,). The sum runs in the order of the voxels, in double
    precision, so it does not depend on how the work was divided.
    """
    values = np.empty(nodes.count, np.float32)
    average = compiled_twin(_average_chunk)
    count, width = blocks.shape
    in_chunks(count, width, lambda rows: average(blocks, nodes, rows, values))
    return values


def _average_chunk(blocks: FloatArray, nodes: SharedNodes, rows: slice, values: FloatArray) -> None:
    """Set the values of the nodes that some voxels own."""
    columns = nodes_of_part(nodes.factor)
    for part, sharing in enumerate(SHARING):
        own = rows.start + np.flatnonzero(nodes.owned[rows, part])
        total = np.zeros((len(own), len(columns[part])))
        times = np.zeros((len(own), 1))
        for neighbour in sharing:
            other = nodes.table[own, neighbour]
            there = other >= 0
            seen = columns[seen_from(part, neighbour)]
            total[there] += blocks[other[there, None], seen]
            times += there[:, None]
        values[nodes.starts[own, part, None] + np.arange(total.shape[1])] = total / times


def signs_of_skipped(
    table: IntArray,
    voxel_ijk: IntArray,
    patches: FloatArray,
    voxels: IntArray,
    shape: tuple[int, int, int],
) -> Signs:
    """Return the signs of the voxels beside the decoded ones that were not decoded.

    Parameters
    ----------
    table : (D, 27) int32
        Neighbours among the decoded voxels, -1 where there is none.
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
    (D, 27) int8
        1 outside, -1 inside; 0 where nothing was skipped.
    """
    signs = np.empty(table.shape, np.int8)

    def fill(rows: slice) -> None:
        beside = voxel_ijk[rows, None] + NEIGHBOURHOOD
        skipped = (table[rows] < 0) & ((beside >= 0) & (beside < shape)).all(2)
        signs[rows] = np.where(patches[voxels[rows]] > 0, skipped, -skipped.astype(np.int8))

    in_chunks(len(table), 3 * 27, fill)
    return signs


def pin_to_skipped(values: FloatArray, nodes: SharedNodes, skipped: Signs) -> BoolArray:
    """Give nodes shared with a voxel that was not decoded that voxel's sign.

    Such a voxel holds no surface, so all its nodes have its sign; with this no sign change can
    reach the edge of what was decoded, and the isosurface has no hole there.

    Parameters
    ----------
    values : (count,) float32
        Node values, changed in place.
    nodes : SharedNodes
        The nodes of the decoded voxels.
    skipped : (D, 27) int8
        From ``signs_of_skipped``.

    Returns
    -------
    (count,) bool
        Which nodes had the other sign.
    """
    changed = np.zeros(len(values), bool)
    compiled_twin(_pin)(values, nodes, skipped, changed)
    return changed


def _pin(values: FloatArray, nodes: SharedNodes, skipped: Signs, changed: BoolArray) -> None:
    """Change the values, and say which. No two skipped voxels round a node differ in sign."""
    parts = nodes_of_part(nodes.factor)
    for place in range(27):
        rows = np.flatnonzero(skipped[:, place])
        outside = skipped[rows, place] > 0
        for part in np.flatnonzero([place in sharing for sharing in SHARING]):
            number = nodes.starts[rows, part, None] + np.arange(len(parts[part]))
            wrong = (values[number] > 0) != outside[:, None]
            changed[number[wrong]] = True
            signed = np.where(outside, BARELY_OUTSIDE, BARELY_INSIDE)[:, None]
            values[number[wrong]] = np.broadcast_to(signed, wrong.shape)[wrong]
