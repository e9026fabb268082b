"""Marching cubes on the blocks of a sparse field.

Every cell of the fine lattice lies in exactly one voxel, and a shared node has one value, so the
cells need no search and no welding by distance: a vertex is named by the lattice edge it lies on.
Two cells see the same edges on their common face, hence the mesh is a closed, oriented
2-manifold wherever the field's blocks do not end.

Vertices and triangles come in the order of the voxels, so a surface made slab by slab is the same
as one made at once.

The edge that runs from node q of a block along axis a has the number ``a Q + q`` in that block. So
seen from another block of the neighbourhood, or from a cell, its number differs by a constant.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from ..errors import OptionTypeError, seen
from ..grid.sdf_grid import SdfGrid
from ..machine.index_width import check_count
from ..machine.threads import map_chunks, map_threads, rows_in_chunk
from ..mesh import CLEARANCE, Mesh, join_meshes, vertex_type
from ..neighbourhood import CENTRE, NEIGHBOURHOOD, STRIDES
from ..options import check_grid
from .cell_cases import CORNERS, EDGE_AXIS, EDGE_START, triangle_table
from .field import FineField
from .nodes import block_ijk, part_of_node

# Bytes for each node of a block, in the table in which the vertices on its edges are looked up.
LOOKUP_BYTES = 12
# Nodes beyond the grid's border (a closed surface, see cap.close_at_border) lie this far out, in
# fine spacings: enough for distinct vertices.
CAP_HEIGHT = 0.02
NO_FACES = np.empty((0, 3), np.int32)


def extract_mesh(field: FineField, grid: SdfGrid, first_vertex: int = 0) -> Mesh:
    """Return the zero level of a field's planes as triangles in world coordinates.

    A node with value 0 is inside. Vertices lie on lattice edges, by linear interpolation. Those of
    planes before the field's own are numbered up to ``first_vertex``, the own ones from there on;
    faces may use both.
    References: Lorensen and Cline, "Marching Cubes", 1987.
    """
    if not isinstance(field, FineField):
        raise OptionTypeError(f"field is {seen(field)}: give one from upsample(grid, network)")
    check_grid(grid)
    return join_meshes(extract_pieces(field, grid, first_vertex))


def extract_pieces(
    field: FineField, grid: SdfGrid, first_vertex: int = 0, threads: int = 1
) -> list[Mesh]:
    """Return the mesh of ``extract_mesh`` as a list of one or more pieces, in order.

    Raises
    ------
    OptionError
        If there are more vertices than can be numbered, those before among them.
    """
    core = field.own_rows
    before = field.plane_before(core).start if core.start < core.stop else core.start
    rows = slice(before, core.stop)
    crossings = find_crossings(field, rows, threads)
    first = first_vertex - crossings.own(core).start
    check_count(first + len(crossings.own_row), "vertices")
    groups = groups_of_planes(field)
    widest = max((rows.stop - field.plane_before(rows).start for rows in groups), default=0)
    at_once = lookups_at_once(len(field.voxel_ijk), widest, threads)

    def mesh_of(group: slice) -> Mesh:
        vertices = place_vertices(field, grid, crossings, group)
        return Mesh(vertices, connect(field, crossings, group, first))

    meshes = map_threads(mesh_of, groups, at_once)
    return meshes or [Mesh(np.empty((0, 3), vertex_type(grid, field.factor)), NO_FACES)]


@dataclass(frozen=True, eq=False)
class Crossings:
    """Where the surface crosses the blocks of some voxels, in the order of the voxels.

    Attributes
    ----------
    own_row, own_edge : (n,) int32, int16
        Voxels, and crossed edges of their blocks that belong to the voxel: each has a vertex.
    other_row, other_edge : (m,) int32, int16
        Crossed edges that belong to another of the voxels that share them.
    cell_row, cell, case : (c,) int32, int16, uint8
        Voxels, crossed cells of their blocks, and the cells' cases.
    """

    own_row: IntArray
    own_edge: NDArray[np.int16]
    other_row: IntArray
    other_edge: NDArray[np.int16]
    cell_row: IntArray
    cell: NDArray[np.int16]
    case: NDArray[np.uint8]

    def own(self, rows: slice) -> slice:
        """Return which of the own edges belong to some voxels."""
        return _between(self.own_row, rows)

    def others(self, rows: slice) -> slice:
        """Return which of the other edges some voxels have."""
        return _between(self.other_row, rows)

    def cells(self, rows: slice) -> slice:
        """Return which of the cells some voxels have."""
        return _between(self.cell_row, rows)


def _between(sorted_rows: IntArray, rows: slice) -> slice:
    """Return the places of some rows; bounds of another type would copy the array."""
    ends = np.array([rows.start, rows.stop], sorted_rows.dtype)
    start, stop = np.searchsorted(sorted_rows, ends)
    return slice(int(start), int(stop))


def find_crossings(field: FineField, rows: slice, threads: int = 1) -> Crossings:
    """Return where the surface crosses the blocks of some voxels."""
    chunks = map_chunks(
        lambda some: _crossings_of_chunk(field, rows.start + some.start, rows.start + some.stop),
        rows.stop - rows.start,
        4 * len(field.blocks),
        threads,
    )
    empty = _crossings_of_chunk(field, rows.start, rows.start)
    return Crossings(*(np.concatenate(arrays) for arrays in zip(empty, *chunks)))


def _crossings_of_chunk(field: FineField, start: int, stop: int) -> tuple[NDArray[Any], ...]:
    """Return the arrays of ``Crossings`` for some voxels."""
    inside = field.blocks[:, start:stop] <= 0
    crossed = np.flatnonzero(inside.any(0) & ~inside.all(0))
    rows = (start + crossed).astype(np.int32)
    inside = inside.take(crossed, 1).reshape(*(field.factor + 1,) * 3, -1)
    slot, edge = _split(_crossed_edges(inside), rows, 3 * len(field.blocks))
    owner = field.parts.owner[part_of_edge(field.factor)[edge], slot]
    own = owner == CENTRE
    case = _cases(inside)
    active = np.flatnonzero(case - np.uint8(1) < 254)  # 0 and 255 are not crossed
    cell_row, cell = _split(active, rows, field.factor**3)
    return slot[own], edge[own], slot[~own], edge[~own], cell_row, cell, case[active]


def _split(
    places: NDArray[np.intp], rows: IntArray, width: int
) -> tuple[IntArray, NDArray[np.int16]]:
    """Return the voxel and the place in its block of places in a table of ``width`` columns."""
    line = places // width
    return rows[line], (places - line * width).astype(np.int16)


def _crossed_edges(inside: BoolArray) -> NDArray[np.intp]:
    """Return the crossed edges of blocks (K+1, K+1, K+1, n), in a table of 3 Q columns."""
    crossed = np.zeros((3, *inside.shape), bool)
    np.not_equal(inside[1:], inside[:-1], out=crossed[0, :-1])
    np.not_equal(inside[:, 1:], inside[:, :-1], out=crossed[1, :, :-1])
    np.not_equal(inside[:, :, 1:], inside[:, :, :-1], out=crossed[2, :, :, :-1])
    return np.flatnonzero(np.moveaxis(crossed, -1, 0))


def _cases(inside: BoolArray) -> NDArray[np.uint8]:
    """Return the cases of the cells of blocks (K+1, K+1, K+1, n), flat, voxel by voxel."""
    bits: NDArray[Any] = inside.view(np.uint8)
    bits = bits[:, :, :-1] | bits[:, :, 1:] << 1
    bits = bits[:, :-1] | bits[:, 1:] << 2
    bits = bits[:-1] | bits[1:] << 4
    return np.moveaxis(bits, -1, 0).ravel()


@lru_cache
def part_of_edge(factor: int) -> IntArray:
    """Return the part of the block in which each edge lies, (3 Q,): its part's owner owns it."""
    side = np.tile(NEIGHBOURHOOD[part_of_node(factor)[0]], (3, 1, 1))
    side[np.arange(3), :, np.arange(3)] = 0  # not at either end of its axis
    part: IntArray = ((side.reshape(-1, 3) + 1) @ STRIDES).astype(np.int32)
    return part


def groups_of_planes(field: FineField) -> list[slice]:
    """Cut a field's planes into runs of whole planes: one, or with about a chunk of voxels."""
    core = field.own_rows
    plane = field.voxel_ijk[core, 0]
    starts = core.start + np.flatnonzero(np.diff(plane, prepend=plane[:1] - 1))
    step = rows_in_chunk(len(field.blocks))
    chosen = np.unique(np.searchsorted(starts, np.arange(core.start, core.stop, step)))
    bounds = [*starts[chosen[chosen < len(starts)]].tolist(), core.stop]
    return [slice(a, b) for a, b in pairwise(bounds)]


def lookups_at_once(voxels: int, widest: int, threads: int) -> int:
    """Return how many threads may hold a vertex lookup table at the same time.

    A plane may hold the whole surface. Tables of ``widest`` voxels, one a thread, take at most
    twice what the values of all voxels take, or one thread does all.
    """
    return max(min(8 * voxels // max(LOOKUP_BYTES * widest, 1), threads), 1)


def place_vertices(
    field: FineField, grid: SdfGrid, crossings: Crossings, rows: slice
) -> NDArray[Any]:
    """Return the vertices on the edges that some voxels own, (n, 3), in world coordinates."""
    own = crossings.own(rows)
    row, edge = crossings.own_row[own], crossings.own_edge[own]
    axis, node = np.divmod(edge, np.int16(len(field.blocks)))
    share = _crossing(field.blocks[node, row], field.blocks[_ends(field.factor)[edge], row])
    vertices: NDArray[Any] = np.empty((len(row), 3), vertex_type(grid, field.factor))
    for along in range(3):
        voxel = field.voxel_ijk[row, along]
        start = field.factor * voxel + block_ijk(field.factor)[node, along]
        runs, last = axis == along, field.shape[along] * field.factor
        lattice: NDArray[np.float64] = start + np.where(runs, share, 0.0)
        if ((voxel < 0) | (voxel >= field.shape[along])).any():  # a cap
            lattice = _onto_border(start, runs, share, last)
        # The fine index K i + K/2 is sample i.
        sample = lattice / field.factor - 0.5
        vertices[:, along] = sample * grid.spacing[along] + grid.origin[along]
    return vertices


@lru_cache
def _ends(factor: int) -> NDArray[np.intp]:
    """Return the node at the far end of each edge of a block, (3 Q,); past it if there is none."""
    return (np.arange((factor + 1) ** 3) + _strides(factor)[:, None]).ravel()


def _crossing(low: FloatArray, high: FloatArray) -> NDArray[np.float64]:
    """Return where linear interpolation is 0, as a share of the edge from its low end."""
    low64, high64 = low.astype(np.float64), high.astype(np.float64)
    return np.clip(low64 / (low64 - high64), CLEARANCE, 1 - CLEARANCE)


def _onto_border(
    start: IntArray, runs: BoolArray, share: NDArray[np.float64], last: int
) -> NDArray[np.float64]:
    """Return coordinates on edges whose nodes beyond the border are brought back to it.

    ``runs`` says which edges run along the axis of the coordinates.
    """
    low = np.clip(start.astype(np.float64), -CAP_HEIGHT, last + CAP_HEIGHT)
    high = np.clip(start + runs.astype(np.float64), -CAP_HEIGHT, last + CAP_HEIGHT)
    return low + share * (high - low)


def connect(field: FineField, crossings: Crossings, rows: slice, first: int) -> IntArray:
    """Return the triangles in some whole planes of voxels, in the order of voxels and cells.

    ``first`` is the number of the first vertex of ``crossings``.
    """
    before = field.plane_before(rows).start
    edges = 3 * len(field.blocks)
    vertex_at = _number_vertices(field, crossings, before, rows, first)
    some = crossings.cells(rows)
    case = crossings.case[some]
    counts, starts, table = _flat_triangles(field.factor)
    low = (crossings.cell_row[some] - before) * np.int64(edges)
    low += _low_nodes(field.factor)[crossings.cell[some]]
    times = counts[case]
    nth = np.arange(times.sum()) + np.repeat(starts[case] - (np.cumsum(times) - times), times)
    faces: IntArray = vertex_at.take(table[nth] + np.repeat(low, times)[:, None])
    return faces


def _number_vertices(
    field: FineField, crossings: Crossings, before: int, rows: slice, first: int
) -> IntArray:
    """Return for the edges of the blocks of some voxels, flat, the vertex if there is one.

    The table begins at voxel ``before``, the first of the plane before: of that plane it has only
    the edges that each voxel owns.
    """
    edges = 3 * len(field.blocks)
    vertex_at = np.empty((rows.stop - before) * edges, np.int32)  # what is not set is not read
    own = crossings.own(slice(before, rows.stop))
    at = (crossings.own_row[own] - np.int64(before)) * edges + crossings.own_edge[own]
    vertex_at[at] = np.arange(first + own.start, first + own.stop)
    others = crossings.others(rows)
    row, edge = crossings.other_row[others], crossings.other_edge[others].astype(np.int64)
    place = field.parts.owner[part_of_edge(field.factor)[edge], row]
    owner = field.parts.table[place, row] - np.int64(before)
    same_edge = owner * edges + edge - _shifts(field.factor)[place]
    vertex_at[(row - np.int64(before)) * edges + edge] = vertex_at.take(same_edge)
    return vertex_at


@lru_cache
def _shifts(factor: int) -> NDArray[np.int64]:
    """Return how far an edge's number is from that which the voxel at each place gives it."""
    shifts: NDArray[np.int64] = factor * NEIGHBOURHOOD.astype(np.int64) @ _strides(factor)
    return shifts


def _strides(factor: int) -> NDArray[np.int64]:
    """Return from a node of a block to the next along each axis."""
    return np.array([(factor + 1) ** 2, factor + 1, 1])


@lru_cache
def _low_nodes(factor: int) -> NDArray[np.intp]:
    """Return the node at the low corner of each cell of a block, (K^3,)."""
    return np.flatnonzero((block_ijk(factor) < factor).all(1))


@lru_cache
def _flat_triangles(factor: int) -> tuple[IntArray, IntArray, NDArray[np.int64]]:
    """Return the triangles of all cases in a row.

    Returns
    -------
    (256,) int32, (256,) int32, (n, 3) int64
        How many each case has, which is its first, and the edges that carry their vertices, from
        the number of the cell's low node.
    """
    counts, table = triangle_table()
    start = (CORNERS @ _strides(factor))[np.array(EDGE_START)]
    edge = start + np.array(EDGE_AXIS) * (factor + 1) ** 3
    used = np.arange(table.shape[1]) < counts[:, None]
    return counts, (np.cumsum(counts) - counts).astype(np.int32), edge[table[used]]
