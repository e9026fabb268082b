"""Values between the nodes of blocks: read at any place, spread from places to the nodes.

A place is given as a block, a row of ``SharedNodes``, and where in it, from 0 to 1 along each axis.
All sums are written out, so that they do not depend on how many places there are.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray, IntArray
from ..machine.compiling import compiled_twin
from ..machine.threads import in_chunks
from .nodes import SharedNodes, nodes_of_part, part_of_node

CELL = np.indices((2, 2, 2)).reshape(3, 8).T


def read(
    values: FloatArray, nodes: SharedNodes, rows: IntArray, place: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return what the nodes say at places, by trilinear interpolation.

    Parameters
    ----------
    values : (count,) float32
        The nodes' values.
    nodes : SharedNodes
        K cells along a block.
    rows : (n,) int32
        Blocks; -1 reads the last.
    place : (3, n) float32
        Where in the block.

    Returns
    -------
    (n,) and (3, n) float32
        The value, and its gradient in units of cells.
    """
    numbers, (x, y, z) = cells_at(nodes, rows, place)
    corner = values[numbers]  # (8, n)
    along_z = corner[1::2] - corner[::2]
    at_z = corner[::2] + along_z * z
    along_y = at_z[1::2] - at_z[::2]
    at_yz = at_z[::2] + along_y * y
    along_x = at_yz[1] - at_yz[0]
    slope_z = along_z[::2] + (along_z[1::2] - along_z[::2]) * y
    gradient_y = along_y[0] + (along_y[1] - along_y[0]) * x
    gradient_z = slope_z[0] + (slope_z[1] - slope_z[0]) * x
    return at_yz[0] + along_x * x, np.stack([along_x, gradient_y, gradient_z])


def cells_at(nodes: SharedNodes, rows: IntArray, place: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the nodes, (8, n), of the cells that places lie in, and where in the cells, (3, n)."""
    low, within = _cell(place, nodes.factor)
    side = nodes.factor + 1
    first = (low[0] * side + low[1]) * side + low[2]
    corners = first + (CELL @ np.array([side * side, side, 1]))[:, None]
    part, place_in_part = part_of_node(nodes.factor)
    return nodes.starts[rows, part[corners]] + place_in_part[corners], within


def _cell(place: FloatArray, cells: int) -> tuple[IntArray, FloatArray]:
    """Return the cell that places (3, n) lie in, and where in it, from 0 to 1."""
    scaled = place * np.float32(cells)
    low = np.minimum(scaled.astype(np.int32), cells - 1)
    return low, scaled - low.astype(np.float32)


@dataclass(frozen=True, eq=False)
class Said:
    """What is said at places in blocks.

    Attributes
    ----------
    rows : (n,) int32
        The block each lies in.
    place : (3, n) float32
        Where in the block, from 0 to 1.
    values : (n,) float32
        What is said there.
    weights : (n,) float32
        How far to trust that.
    """

    rows: IntArray
    place: FloatArray
    values: FloatArray
    weights: FloatArray


def sums_at_nodes(said: Said, nodes: SharedNodes) -> NDArray[np.float64]:
    """Return for each node, (3, count), the weight of what is said in the cells round it.

    Then the weighted sum of the values, and that of their squares.
    """
    sums = np.zeros((3, nodes.count))
    add = compiled_twin(_add_chunk)
    for start in range(0, len(said.rows), 1 << 16):  # one after the other: all add to one array
        add(said, nodes, slice(start, start + (1 << 16)), sums)
    return sums


def _add_chunk(said: Said, nodes: SharedNodes, chunk: slice, sums: NDArray[np.float64]) -> None:
    """Add what is said at some places to the sums of the nodes round them."""
    numbers, (x, y, z) = cells_at(nodes, said.rows[chunk], said.place[:, chunk])
    sides = [np.stack([1 - t, t]) for t in (x, y, z)]
    shares = sides[0][CELL[:, 0]] * sides[1][CELL[:, 1]] * sides[2][CELL[:, 2]]
    spoken = (shares * said.weights[chunk]).astype(np.float64)
    value = said.values[chunk].astype(np.float64)
    for total in sums:
        np.add.at(total, numbers.T.ravel(), spoken.T.ravel())
        spoken = spoken * value


def carry(
    values: FloatArray, nodes: SharedNodes, finer: SharedNodes, onto: FloatArray | None = None
) -> FloatArray:
    """Return the values at the nodes of a finer lattice of the same blocks, (count,).

    They are added to those of ``onto``, in place, if that is given.
    """
    onto = np.zeros(finer.count, np.float32) if onto is None else onto
    carry_some = compiled_twin(_carry_chunk)
    width = (finer.factor + 1) ** 3
    in_chunks(len(nodes.table), width, lambda rows: carry_some(values, nodes, finer, rows, onto))
    return onto


def _carry_chunk(
    values: FloatArray, nodes: SharedNodes, finer: SharedNodes, rows: slice, onto: FloatArray
) -> None:
    """Add to the values of the finer nodes that some voxels own."""
    low, share = finer_places(nodes.factor, finer.factor)
    block: FloatArray = values[nodes.numbers(rows)].reshape(-1, *(nodes.factor + 1,) * 3)
    for axis in (1, 2, 3):
        below, above = block.take(low, axis), block.take(low + 1, axis)
        block = below + (above - below) * share.reshape(-1, *(1,) * (3 - axis))
    block = block.reshape(len(block), -1)
    for part, columns in enumerate(nodes_of_part(finer.factor)):
        own = np.flatnonzero(finer.owned[rows, part])
        number = finer.starts[rows][own, part, None] + np.arange(len(columns))
        onto[number] += block[own[:, None], columns]


@lru_cache
def finer_places(cells: int, finer: int) -> tuple[IntArray, FloatArray]:
    """Return along an axis the cell that each of the finer nodes lies in, and where in it."""
    return _cell((np.arange(finer + 1) / finer).astype(np.float32), cells)
