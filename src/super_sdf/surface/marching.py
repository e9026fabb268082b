"""Marching cubes on the blocks of a sparse field.

Every cell of the fine lattice lies in exactly one voxel, and a node has the same value in all
blocks that share it. Vertices lie on lattice edges and are identified by them, so nothing is welded
by distance. Cells that share a face see the same edges on it, so the mesh is a closed, oriented
2-manifold, except where the blocks end. In steps:

1. ``find_crossings`` lists the lattice edges and cells of each block that the surface crosses.
2. ``lattice_positions`` are those of the vertices, one on each crossed edge, in the voxel that owns
   the edge.
3. ``connect`` looks up the vertices on the edges of each crossed cell, and makes its triangles.

Vertices and triangles are in the order of the voxels.

The edge from node q of a block along axis a has the number ``a Q + q`` in the block, Q = (K+1)^3.
Its number in another block that shares it, or relative to a cell, therefore differs by a constant.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from ..arrays import CENTRE, CORNERS, NEIGHBOURHOOD, STRIDES, BoolArray, FloatArray, IntArray
from ..refine.field import FineField
from ..refine.nodes import block_ijk, part_of_node
from ..threads import chunks_of, map_chunks, over_threads, worthwhile_threads
from .mesh import CLEARANCE

# Nodes beyond the grid's border (of a cap, see ``cap.close``) are placed this far outside it,
# in fine spacings: enough for distinct vertices.
CAP_HEIGHT = 0.02
# A cell has 8 corners, numbered 4 x + 2 y + z, and 12 edges: edge e runs from corner EDGE_START[e]
# one step along EDGE_AXIS[e].
EDGE_START = (0, 1, 2, 3, 0, 1, 4, 5, 0, 2, 4, 6)
EDGE_AXIS = (0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2)
# The corners of each face in counter-clockwise order, seen from outside the cell: the lower and the
# upper face along x, then along y and z.
FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
LOOPS = ("loops", "sides", "edges", "places")
CASES = Path(__file__).with_name("cell_cases.npz")


class Tables(NamedTuple):
    """The cases: their loops, each of which is a patch of the surface in a cell, and triangles."""

    ambiguous: NDArray[np.uint8]  # (256,), a bit for each of ``FACES``: whether it is ambiguous
    # (256, 64), the case for the same bits, set where an ambiguous face joins its inside corners.
    # Bits of other faces must be 0. Where no face joins them it is the number of the row
    number: NDArray[np.int16]
    loops: NDArray[np.int64]  # (C,), how many loops a case has ...
    first_loop: NDArray[np.int64]  # (C,), ... and which is its first; loops come case by case
    sides: NDArray[np.int64]  # (L,), how many edges a loop has
    edges: NDArray[np.int8]  # (L, S), in order, counter-clockwise from outside; -1 after the last
    places: NDArray[np.int8]  # (L, T, 3), its ``sides - 2`` triangles as places in the loop
    times: NDArray[np.int64]  # (C,), how many triangles a case has ...
    first: NDArray[np.int64]  # (C,), ... and which is its first
    triangles: NDArray[np.int64]  # (n, 3), the edges of all triangles, case by case


@lru_cache(maxsize=1)
def tables() -> Tables:
    """Return the tables from the file."""
    with np.load(CASES) as file:
        return with_triangles(*(file[name] for name in ("ambiguous", "number", *LOOPS)))


def with_triangles(
    ambiguous: NDArray[Any], number: NDArray[Any], loops: NDArray[Any], *of_loops: NDArray[Any]
) -> Tables:
    """Return the tables, given those that the file has."""
    loops, (sides, edges, places) = loops.astype(np.int64), of_loops  # in the file: int8
    first_loop = np.cumsum(loops) - loops
    used = np.arange(places.shape[1]) < sides[:, None] - 2
    loop = np.nonzero(used)[0]
    times = np.bincount(np.repeat(np.arange(len(loops)), loops)[loop], minlength=len(loops))
    of_loops = loops, first_loop, sides.astype(np.int64), edges, places
    triangles = edges[loop[:, None], places[used]].astype(np.int64)
    return Tables(ambiguous, number, *of_loops, times, np.cumsum(times) - times, triangles)


@dataclass(frozen=True, eq=False)
class Crossings:
    """Edges and cells that the surface crosses in the blocks of some voxels, in their order."""

    own_row: IntArray  # (n,), voxels ...
    own_edge: NDArray[np.int16]  # (n,), ... and crossed edges that they own: each has a vertex
    other_row: IntArray  # (m,), voxels ...
    other_edge: NDArray[np.int16]  # (m,), ... and crossed edges of theirs that another voxel owns
    cell_row: IntArray  # (c,), voxels ...
    cell: NDArray[np.int16]  # (c,), ... crossed cells of their blocks ...
    case: NDArray[np.int16]  # (c,), ... and the cases of these cells (``cell_cases``)

    def with_cells(self, chosen: BoolArray) -> Crossings:
        """Return the crossings with some of the cells, a mask (c,)."""
        cells = self.cell_row[chosen], self.cell[chosen], self.case[chosen]
        return Crossings(self.own_row, self.own_edge, self.other_row, self.other_edge, *cells)


def find_crossings(field: FineField, threads: int = 1) -> Crossings:
    """Return the edges and cells that the surface crosses."""
    work, width = partial(_crossings_of_chunk, field), 4 * len(field.blocks)
    chunks = map_chunks(work, len(field.voxel_ijk), width, threads)
    empty = work(slice(0, 0))
    return Crossings(*(np.concatenate(arrays) for arrays in zip(empty, *chunks)))


def _crossings_of_chunk(field: FineField, chunk: slice) -> tuple[NDArray[Any], ...]:
    """Return the arrays of ``Crossings`` for some of the voxels."""
    inside, factor, edges = field.blocks[:, chunk] <= 0, field.factor, 3 * len(field.blocks)
    some = np.flatnonzero(inside.any(0) & ~inside.all(0))
    rows = (chunk.start + some).astype(np.int32)
    inside = inside.take(some, 1).reshape(*(factor + 1,) * 3, -1)
    crossed = np.zeros((3, *inside.shape), bool)  # the edges
    np.not_equal(inside[1:], inside[:-1], out=crossed[0, :-1])
    np.not_equal(inside[:, 1:], inside[:, :-1], out=crossed[1, :, :-1])
    np.not_equal(inside[:, :, 1:], inside[:, :, :-1], out=crossed[2, :, :, :-1])
    row, edge = _split(np.flatnonzero(np.moveaxis(crossed, -1, 0)), rows, edges)
    own = field.parts.owner[part_of_edge(factor)[edge], row] == CENTRE
    bits: NDArray[Any] = inside.view(np.uint8)  # for the corners of each cell
    bits = bits[:, :, :-1] | bits[:, :, 1:] << 1
    bits = bits[:, :-1] | bits[:, 1:] << 2
    bits = bits[:-1] | bits[1:] << 4
    corners = np.moveaxis(bits, -1, 0).ravel()
    active = np.flatnonzero(corners - np.uint8(1) < 254)  # 0 and 255 are not crossed
    cell_row, cell = _split(active, rows, factor**3)
    if field.octants is not None:  # only cells between known samples, and the edges of these
        seen = (field.octants[cell_row] >> octant_of_cells(factor)[cell] & 1).astype(bool)
        cell_row, cell, active = cell_row[seen], cell[seen], active[seen]
        # An edge on a face is kept in all blocks that share it, or in none: the cells on either
        # side of the face lie between the same samples.
        low = cell_row * np.int64(edges) + cells_low_nodes(factor)[cell]
        kept = np.isin(row * np.int64(edges) + edge, low[:, None] + edge_steps(factor))
        row, edge, own = row[kept], edge[kept], own[kept]
    case = choose_cases(field, corners[active], cell_row, cell)
    return row[own], edge[own], row[~own], edge[~own], cell_row, cell, case


def _split(
    places: NDArray[np.intp], rows: IntArray, width: int
) -> tuple[IntArray, NDArray[np.int16]]:
    """Return the row and the column of flat indices into a table; ``rows`` names its rows."""
    line = places // width
    return rows[line], (places - line * width).astype(np.int16)


def choose_cases(
    field: FineField, corners: NDArray[np.uint8], row: IntArray, cell: NDArray[np.int16]
) -> NDArray[np.int16]:
    """Return the cases of cells, (c,), given a bit for each corner that is inside.

    The inside corners of an ambiguous face are joined where bilinear interpolation on it is
    negative at its saddle (Nielson and Hamann 1991).
    """
    table = tables()
    case: NDArray[np.int16] = corners.astype(np.int16)
    unsure = np.flatnonzero(table.ambiguous[corners])
    low, row = cells_low_nodes(field.factor)[cell[unsure]], row[unsure]
    steps = CORNERS @ strides(field.factor)
    values = [values_at(field, low + step, row).astype(np.float64) for step in steps]
    joined = np.zeros(len(unsure), np.uint8)
    for n, (a, b, c, d) in enumerate(FACES):
        excess = values[a] * values[c] - values[b] * values[d]
        joined |= (np.where(values[a] <= 0, excess, -excess) > 0).astype(np.uint8) << n
    some = corners[unsure]
    case[unsure] = table.number[some, joined & table.ambiguous[some]]
    return case


def values_at(field: FineField, node: NDArray[Any], row: NDArray[Any]) -> FloatArray:
    """Return the values at nodes of voxels' blocks, of the shape of both.

    NumPy takes a third of the time for one index into a line of all values than for two.
    """
    size, steps = field.blocks.itemsize, np.array(field.blocks.strides) // field.blocks.itemsize
    line = as_strided(field.blocks, (int((np.array(field.blocks.shape) - 1) @ steps) + 1,), (size,))
    # with NumPy 1 the product of an int16 array and a small number is int16
    return np.asarray(line.take(np.multiply(node, steps[0], dtype=np.int64) + row * steps[1]))


@lru_cache
def part_of_edge(factor: int) -> IntArray:
    """Return the part of the block in which each edge lies, (3 Q,); the part's owner owns it."""
    side = np.tile(NEIGHBOURHOOD[part_of_node(factor)], (3, 1, 1))
    side[np.arange(3), :, np.arange(3)] = 0  # not at either end of its axis
    part: IntArray = ((side.reshape(-1, 3) + 1) @ STRIDES).astype(np.int32)
    return part


def lattice_positions(
    field: FineField, row: IntArray, edge: NDArray[np.int16], border: IntArray
) -> NDArray[np.float64]:
    """Return where the surface crosses edges of blocks, (3, n), in fine spacings from node 0.

    ``border`` is that of the grid, see ``cap``.
    """
    axis, node = np.divmod(edge, np.int16(len(field.blocks)))
    low = values_at(field, node, row).astype(np.float64)
    high = values_at(field, edge_ends(field.factor).take(edge), row).astype(np.float64)
    share = np.clip(low / (low - high), CLEARANCE, 1 - CLEARANCE)
    positions = np.empty((3, len(row)))
    voxels, nodes = field.voxel_ijk.take(row, 0), block_ijk(field.factor).take(node, 0)
    for along, (before, after) in enumerate(border.T.tolist()):
        voxel, runs = voxels[:, along], axis == along
        start = field.factor * voxel + nodes[:, along]
        positions[along] = start + np.where(runs, share, 0.0)
        if ((voxel < before) | (voxel >= after)).any():  # voxels of a cap: moved onto the border
            ends = before * field.factor - CAP_HEIGHT, after * field.factor + CAP_HEIGHT
            begin, end = (np.clip(x.astype(np.float64), *ends) for x in (start, start + runs))
            positions[along] = begin + share * (end - begin)
    return positions


@lru_cache
def edge_ends(factor: int) -> NDArray[np.intp]:
    """Return the node at the far end of each edge, (3 Q,); that of edges that leave is not used."""
    return (np.arange((factor + 1) ** 3) + strides(factor)[:, None]).ravel()


def connect(field: FineField, crossings: Crossings, threads: int = 1) -> IntArray:
    """Return the triangles (m, 3) of all crossed cells, in the order of voxels and cells.

    A vertex has the number of its edge among the own edges. To look it up, runs of planes of voxels
    have a table of all edges of their blocks, to which the plane before belongs: voxels in it may
    own edges of the run.
    """
    table = tables()
    from_low = edge_steps(field.factor)[table.triangles]
    times = table.times[crossings.case]
    end = np.cumsum(times, dtype=np.int64)
    faces = np.empty((int(end[-1]) if len(end) else 0, 3), np.int32)
    plane = field.voxel_ijk[:, 0]
    planes = np.append(np.flatnonzero(np.diff(plane, prepend=plane[:1] - 1)), len(plane))
    steps = [rows.start for rows in chunks_of(len(plane), len(field.blocks))]
    cuts = np.unique(np.append(np.searchsorted(planes, steps), len(planes) - 1))

    def fill(run: tuple[int, int]) -> None:
        first, last = planes[run[0]], planes[run[1]]
        before = planes[max(run[0] - 1, 0)]
        own = _between(crossings.own_row, before, last)
        others, numbers = _between(crossings.other_row, first, last), np.arange(own.start, own.stop)
        slot, size = (lambda row: row - before), int(last - before)
        vertex_at = edge_table(field, crossings, slot, size, own, others, numbers)
        some = _between(crossings.cell_row, first, last)
        low = (crossings.cell_row[some] - before) * (3 * len(field.blocks))
        low += cells_low_nodes(field.factor)[crossings.cell[some]]
        begin = int(end[some.start] - times[some.start]) if some.start < some.stop else 0
        each = times[some]
        nth = np.arange(begin, begin + each.sum())
        nth += np.repeat(table.first[crossings.case[some]] - (end[some] - each), each)
        corners = from_low[nth] + np.repeat(low, each)[:, None]
        vertex_at.take(corners, out=faces[begin : begin + len(corners)], mode="clip")

    runs = list(zip(cuts[:-1].tolist(), cuts[1:].tolist()))
    list(over_threads(fill, runs, worthwhile_threads(12 * len(faces), threads)))
    return faces


def _between(sorted_rows: IntArray, first: int, last: int) -> slice:
    """Return the places of some rows; bounds of another type would copy the array."""
    ends = np.array([first, last], sorted_rows.dtype)
    start, stop = np.searchsorted(sorted_rows, ends)
    return slice(int(start), int(stop))


def edge_table(
    field: FineField,
    crossings: Crossings,
    slot: Callable[[NDArray[Any]], NDArray[np.int64]],
    count: int,
    own: slice | NDArray[np.intp],
    others: slice | NDArray[np.intp],
    numbers: NDArray[Any],
) -> IntArray:
    """Return a number for each crossed edge of some blocks, (count 3 Q,); other entries are unset.

    ``numbers`` are those of the ``own`` edges; the ``others`` look them up in the blocks of their
    owners. ``slot`` returns the places of voxels in the table.
    """
    edges = 3 * len(field.blocks)
    number_at = np.empty(count * edges, np.int32)
    number_at[slot(crossings.own_row[own]) * edges + crossings.own_edge[own]] = numbers
    row, edge = crossings.other_row[others], crossings.other_edge[others].astype(np.int64)
    place, owner = owners_of(field, crossings, others)
    same_edge = slot(owner) * edges + edge - edge_shifts(field.factor)[place]
    number_at[slot(row) * edges + edge] = number_at.take(same_edge)
    return number_at


def owners_of(
    field: FineField, crossings: Crossings, others: slice | NDArray[np.intp]
) -> tuple[NDArray[np.int8], IntArray]:
    """Return the places and the rows of the voxels that own other edges."""
    row = crossings.other_row[others]
    place = field.parts.owner[part_of_edge(field.factor)[crossings.other_edge[others]], row]
    return place, field.parts.table[place, row]


@lru_cache
def edge_shifts(factor: int) -> NDArray[np.int64]:
    """Return an edge's number in a block minus its number in each neighbouring block, (27,)."""
    return np.asarray(factor * NEIGHBOURHOOD @ strides(factor), np.int64)


def strides(factor: int) -> NDArray[np.int64]:
    """Return the steps from a node of a block to the next one along each axis, (3,)."""
    return np.array([(factor + 1) ** 2, factor + 1, 1])


@lru_cache
def octant_of_cells(factor: int) -> NDArray[np.uint8]:
    """Return the octant of the voxel, 0 to 7, in which each cell of a block lies, (K^3,)."""
    low = block_ijk(factor)[cells_low_nodes(factor)]
    return np.asarray((low >= factor // 2) @ np.array([4, 2, 1]), np.uint8)


@lru_cache
def cells_low_nodes(factor: int) -> NDArray[np.intp]:
    """Return the node at the low corner of each cell of a block, (K^3,)."""
    return np.flatnonzero((block_ijk(factor) < factor).all(1))


def edge_steps(factor: int) -> NDArray[np.int64]:
    """Return the number of each edge of a cell, counted from that of its low node, (12,)."""
    start = (CORNERS @ strides(factor))[np.array(EDGE_START)]
    steps: NDArray[np.int64] = start + np.array(EDGE_AXIS) * (factor + 1) ** 3
    return steps
