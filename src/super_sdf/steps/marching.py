"""Marching cubes on the blocks of a sparse field.

Every cell of the fine lattice lies in exactly one voxel, and a shared node has one value, so the
cells need no search and no welding by distance: a vertex is named by the lattice edge it lies on.
Two cells see the same edges on their common face, hence the mesh is a closed, oriented
2-manifold wherever the field's blocks do not end.

Vertices and triangles come in the order of the voxels, so a surface made slab by slab is the same
as one made at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from ..errors import OptionTypeError, seen
from ..grid.sdf_grid import SdfGrid
from ..machine.compiling import compiled_twin
from ..machine.index_width import check_count
from ..machine.threads import in_chunks, rows_in_chunk, side_by_side, threads_at_work
from ..mesh import CLEARANCE, Mesh, join_meshes, vertex_type
from ..neighbourhood import NEIGHBOURHOOD, STRIDES
from ..options import check_grid
from .cell_cases import CORNERS, EDGE_AXIS, EDGE_START, triangle_table
from .field import FineField
from .nodes import block_ijk, part_of_node

# Of each node, where the vertices on the edges that begin there are looked up: three numbers.
LOOKUP_BYTES = 12
# Nodes beyond the grid's border (a closed surface, see border.close_at_border) lie this far out, in
# fine spacings: enough for distinct vertices.
CAP_HEIGHT = 0.02


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


def extract_pieces(field: FineField, grid: SdfGrid, first_vertex: int = 0) -> list[Mesh]:
    """Return the mesh of ``extract_mesh`` as a list of one or more pieces, in order.

    Raises
    ------
    OptionError
        If there are more vertices than can be numbered, those before among them.
    """
    times = count_vertices(field)
    core = field.rows(*field.planes)
    ends = np.cumsum(times, dtype=np.int64)
    before = int(ends[core.start - 1]) if core.start else 0
    firsts = np.append(0, ends) + (first_vertex - before)
    check_count(int(firsts[core.stop]), "vertices", field.factor)
    groups = _groups(field)
    at_once = lookups_at_once(field.nodes.count, max(map(field.nodes_seen_from, groups), default=0))
    parts = side_by_side(groups, lambda rows: _extract_group(field, grid, firsts, rows), at_once)
    return parts or [Mesh(_to_world(np.empty((0, 3)), field, grid), np.empty((0, 3), np.int32))]


def lookups_at_once(nodes: int, widest: int) -> int:
    """Return how many threads may hold a vertex lookup table at the same time.

    A plane may hold the whole surface. Tables of ``widest`` nodes, one a thread, take at most twice
    what the values of all nodes take, or one thread does all.
    """
    return max(min(8 * nodes // max(LOOKUP_BYTES * widest, 1), threads_at_work()), 1)


def count_vertices(field: FineField) -> IntArray:
    """Return how many vertices belong to each voxel, (D,): those on crossed edges that it owns."""
    count = compiled_twin(_count_chunk)
    width = len(edges_of_block(field.factor).axis)
    return np.concatenate(in_chunks(len(field.voxel_ijk), width, lambda rows: count(field, rows)))


def _count_chunk(field: FineField, rows: slice) -> IntArray:
    """Count the vertices of some voxels."""
    times: IntArray = _own_edges(field, rows).sum(1, dtype=np.int32)
    return times


def _groups(field: FineField) -> list[slice]:
    """Cut a field's planes into runs of whole planes: one, or with about a chunk of voxels."""
    core = field.rows(*field.planes)
    plane = field.voxel_ijk[core, 0]
    starts = core.start + np.flatnonzero(np.diff(plane, prepend=plane[:1] - 1))
    step = rows_in_chunk((field.factor + 1) ** 3)
    chosen = np.unique(np.searchsorted(starts, np.arange(core.start, core.stop, step)))
    bounds = [*starts[chosen[chosen < len(starts)]].tolist(), core.stop]
    return [slice(a, b) for a, b in pairwise(bounds)]


@dataclass(frozen=True, eq=False)
class BlockEdges:
    """The lattice edges in a block, axis by axis in the order of their first nodes: 3 K (K+1)^2.

    Attributes
    ----------
    axis : (E,) int32
        Along which axis each runs.
    start, end : (E,) int32
        Its block nodes.
    part : (E,) int32
        The part of the block that it lies in: an edge belongs to the voxel that owns its part.
    """

    axis: IntArray
    start: IntArray
    end: IntArray
    part: IntArray


@lru_cache
def edges_of_block(factor: int) -> BlockEdges:
    """Return the edges of a block."""
    block = block_ijk(factor)
    starts = [np.flatnonzero(block[:, axis] < factor) for axis in range(3)]
    axis = np.repeat(np.arange(3), [len(start) for start in starts])
    start = np.concatenate(starts)
    end = start + np.array([(factor + 1) ** 2, factor + 1, 1])[axis]
    side = NEIGHBOURHOOD[part_of_node(factor)[0][start]].copy()
    side[np.arange(len(side)), axis] = 0  # not at either end of its axis
    arrays = axis, start, end, (side + 1) @ STRIDES
    return BlockEdges(*(array.astype(np.int32) for array in arrays))


def _own_edges(field: FineField, rows: slice | IntArray) -> BoolArray:
    """Say which edges of some voxels' blocks are crossed and belong to the voxel, (n, E)."""
    edges = edges_of_block(field.factor)
    inside = field.inside_blocks(rows).reshape(-1, (field.factor + 1) ** 3)
    crossed = inside[:, edges.start] != inside[:, edges.end]
    own: BoolArray = crossed & field.nodes.owned[rows][:, edges.part]
    return own


def _extract_group(field: FineField, grid: SdfGrid, firsts: NDArray[np.int64], rows: slice) -> Mesh:
    """Return the vertices and triangles of some whole planes of voxels."""
    extract = compiled_twin(_extract_rows)
    position, faces = extract(field, firsts, field.plane_before(rows), rows)
    return Mesh(_to_world(position, field, grid), faces)


def _extract_rows(
    field: FineField, firsts: NDArray[np.int64], before: slice, rows: slice
) -> tuple[NDArray[np.float64], IntArray]:
    """Return positions, in fine spacings, and triangles of some planes, given the plane before.

    ``firsts`` is the number of each voxel's first vertex, (D + 1,).
    An edge belongs to a voxel of its own plane or the one before. The vertex on the edge that runs
    from node v along axis a is looked up at ``3 v + a``.
    """
    first_node = field.nodes.owned_before(before.start)
    nodes = field.nodes.owned_before(rows.stop) - first_node
    vertex_at = np.empty(3 * nodes, np.int32)  # what is not set is not read
    positions = []
    for some in (*_chunks(field, before), *_chunks(field, rows)):
        voxel, edge = np.nonzero(_own_edges(field, some))
        voxel += some.start
        own = np.arange(len(voxel)) - np.searchsorted(voxel, voxel)  # the voxel's first is 0
        start, end = _ends(field, voxel, edge)
        axis = edges_of_block(field.factor).axis[edge]
        near = start >= first_node  # not on the far side of the plane before
        at = _lattice_edges(start, first_node) + axis
        vertex_at[at[near]] = (firsts[voxel] + own)[near]
        if some.start >= rows.start:
            values = field.values[start], field.values[end]
            positions.append(_positions(field, voxel, edge, *values))
    faces = [_triangles(field, some, vertex_at, first_node) for some in _chunks(field, rows)]
    return np.concatenate(positions), np.concatenate(faces)


def _chunks(field: FineField, rows: slice) -> list[slice]:
    """Cut rows so that what is made of each chunk stays small, where a plane has many voxels."""
    step = rows_in_chunk(4 * (field.factor + 1) ** 3)
    return [slice(n, min(n + step, rows.stop)) for n in range(rows.start, rows.stop, step)]


def _ends(
    field: FineField, voxel: NDArray[np.intp], edge: NDArray[np.intp]
) -> tuple[IntArray, IntArray]:
    """Return the nodes at both ends of edges of blocks."""
    edges = edges_of_block(field.factor)
    part, place = part_of_node(field.factor)
    low, high = (
        field.nodes.starts[voxel, part[node]] + place[node]
        for node in (edges.start[edge], edges.end[edge])
    )
    return low, high


def _positions(
    field: FineField,
    voxel: NDArray[np.intp],
    edge: NDArray[np.intp],
    low: FloatArray,
    high: FloatArray,
) -> NDArray[np.float64]:
    """Return the vertices on edges with values at both ends, from the fine lattice's first node."""
    edges = edges_of_block(field.factor)
    start = field.factor * field.voxel_ijk[voxel] + block_ijk(field.factor)[edges.start[edge]]
    lattice = np.array(field.shape) * field.factor
    share = _crossing(low, high)
    first = _onto_border(start.astype(np.float64), lattice)
    last = _onto_border(start + np.eye(3)[edges.axis[edge]], lattice)
    return first + share[:, None] * (last - first)


def _crossing(low: FloatArray, high: FloatArray) -> NDArray[np.float64]:
    """Return where linear interpolation is 0, as a share of the edge from its low end."""
    low64, high64 = low.astype(np.float64), high.astype(np.float64)
    return np.clip(low64 / (low64 - high64), CLEARANCE, 1 - CLEARANCE)


def _onto_border(position: NDArray[np.float64], lattice: NDArray[np.int64]) -> NDArray[np.float64]:
    """Bring nodes from beyond the border of the fine lattice back to it."""
    return np.clip(position, -CAP_HEIGHT, lattice + CAP_HEIGHT)


def _triangles(field: FineField, rows: slice, vertex_at: IntArray, first_node: int) -> IntArray:
    """Return the triangles of some voxels' cells, in the order of voxels and cells."""
    factor = field.factor
    inside = field.inside_blocks(rows)
    case = np.zeros((len(inside),) + (factor,) * 3, np.uint8)
    for bit, (x, y, z) in enumerate(CORNERS):
        corner = inside[:, x : x + factor, y : y + factor, z : z + factor]
        case |= corner.astype(np.uint8) << np.uint8(bit)
    counts, table = triangle_table()
    cell = np.flatnonzero((case != 0) & (case != 255))
    case_of_cell = case.ravel()[cell]
    times = counts[case_of_cell]
    of_triangle = np.repeat(np.arange(len(cell)), times)
    nth = np.arange(len(of_triangle)) - np.repeat(np.cumsum(times) - times, times)
    edges = table[case_of_cell[of_triangle], nth]
    voxel, low_node = _low_nodes(cell, factor)
    step = np.array([(factor + 1) ** 2, factor + 1, 1])
    start = (CORNERS @ step)[np.array(EDGE_START)]
    block_node = low_node[of_triangle, None] + start[edges]
    part, place = part_of_node(factor)
    starts = field.nodes.starts[rows]
    node = starts[voxel[of_triangle, None], part[block_node]] + place[block_node]
    faces: IntArray = vertex_at[_lattice_edges(node, first_node) + np.array(EDGE_AXIS)[edges]]
    return faces


def _lattice_edges(node: IntArray, first_node: int) -> NDArray[np.int64]:
    """Return where the edges that begin at nodes are looked up: 32 bits are too few for that."""
    at: NDArray[np.int64] = 3 * (node.astype(np.int64) - first_node)
    return at


def _low_nodes(cell: NDArray[np.int64], factor: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the voxel of each cell, and the block node at the cell's low corner."""
    voxel, within = np.divmod(cell, factor**3)
    x, rest = np.divmod(within, factor**2)
    y, z = np.divmod(rest, factor)
    return voxel, (x * (factor + 1) + y) * (factor + 1) + z


def _to_world(
    position: NDArray[np.float64], field: FineField, grid: SdfGrid
) -> NDArray[np.float64] | FloatArray:
    """Turn fine lattice positions into world ones: fine index K i + K/2 is sample i."""
    sample = position / field.factor - 0.5
    world: NDArray[np.float64] = sample * np.array(grid.spacing) + np.array(grid.origin)
    return world if vertex_type(grid, field.factor) is np.float64 else world.astype(np.float32)
