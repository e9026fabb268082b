"""Marching cubes on the blocks of a sparse field.

Every cell of the fine lattice lies in exactly one voxel, and a shared node has one value, so the
cells need no search and no welding by distance: a vertex is named by the lattice edge it lies on.
Two cells see the same edges on their common face, hence the mesh is a closed, oriented
2-manifold wherever the field's blocks do not end.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .cell_cases import CORNERS, EDGE_AXIS, EDGE_START, triangle_table
from .field import FineField
from .grid import BoolArray, FloatArray, IntArray, SdfGrid
from .mesh import Mesh
from .nodes import block_ijk

# A vertex keeps this share of its lattice edge from either end: where a node's value is 0 several
# vertices would otherwise fall together, and programs that merge such points would tear the mesh.
CLEARANCE = 1e-3
# Nodes beyond the grid's border (a closed surface, see field.close_at_border) lie this far out, in
# fine spacings: enough for distinct vertices.
CAP_HEIGHT = 0.02


def extract_mesh(field: FineField, grid: SdfGrid) -> Mesh:
    """Return the zero level of a field as triangles in world coordinates.

    A node with value 0 is inside. Vertices lie on lattice edges, by linear interpolation.
    References: Lorensen and Cline, "Marching Cubes", 1987.
    """
    inside = field.inside_blocks(np.ones(len(field.numbers), bool))
    crossed = inside.any((1, 2, 3)) & ~inside.all((1, 2, 3))
    inside, numbers, voxel_ijk = inside[crossed], field.numbers[crossed], field.voxel_ijk[crossed]
    vertex_at, position = _edge_vertices(field, numbers, voxel_ijk, inside)
    faces = _triangles(inside, numbers, vertex_at)
    return Mesh(_to_world(position, field, grid), faces)


def _edge_vertices(
    field: FineField, numbers: IntArray, voxel_ijk: IntArray, inside: BoolArray
) -> tuple[IntArray, NDArray[np.float64]]:
    """Put a vertex on every lattice edge whose ends are on different sides.

    Returns
    -------
    (3 n,) int32 and (m, 3) float64
        The vertex on the edge that runs from node v along axis a, at ``3 v + a``; and the
        positions, in fine spacings from the fine lattice's first node.
    """
    along = [_vertices_along(axis, field, numbers, voxel_ijk, inside) for axis in range(3)]
    keys, position = (np.concatenate(parts) for parts in zip(*along))
    vertex_at = np.full(3 * len(field.values), -1, np.int32)
    vertex_at[keys] = np.arange(len(keys), dtype=np.int32)
    return vertex_at, position


def _vertices_along(
    axis: int, field: FineField, numbers: IntArray, voxel_ijk: IntArray, inside: BoolArray
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the names ``3 v + axis`` of crossed edges along an axis, and their vertices."""
    voxel, start, end = _crossed_edges(inside, axis)
    node = numbers[voxel, start]
    one = _one_of_each(node, len(field.values))  # up to four blocks share an edge
    voxel, start, end, node = voxel[one], start[one], end[one], node[one]
    share = _crossing(field.values[node], field.values[numbers[voxel, end]])

    low = (field.factor * voxel_ijk[voxel] + block_ijk(field.factor)[start]).astype(np.float64)
    high = low + np.eye(3)[axis]
    lattice = np.array(field.shape) * field.factor
    low, high = _onto_border(low, lattice), _onto_border(high, lattice)
    return 3 * node.astype(np.int64) + axis, low + share[:, None] * (high - low)


def _one_of_each(node: IntArray, count: int) -> BoolArray:
    """Mark one place of each different number below ``count``, without sorting."""
    places = np.arange(len(node), dtype=np.int32)
    last = np.empty(count, np.int32)
    last[node] = places
    one: BoolArray = last[node] == places
    return one


def _crossed_edges(
    inside: BoolArray, axis: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return voxel, first and last block node of each edge along an axis that is crossed."""
    side = inside.shape[1]
    moved = np.moveaxis(inside, axis + 1, 1)
    crossed = np.zeros_like(moved)
    crossed[:, :-1] = moved[:, :-1] != moved[:, 1:]
    flat = np.flatnonzero(np.moveaxis(crossed, 1, axis + 1))
    voxel, start = np.divmod(flat, side**3)
    return voxel, start, start + side ** (2 - axis)


def _crossing(low: FloatArray, high: FloatArray) -> NDArray[np.float64]:
    """Return where linear interpolation is 0, as a share of the edge from its low end."""
    low64, high64 = low.astype(np.float64), high.astype(np.float64)
    return np.clip(low64 / (low64 - high64), CLEARANCE, 1 - CLEARANCE)


def _onto_border(position: NDArray[np.float64], lattice: NDArray[np.int64]) -> NDArray[np.float64]:
    """Bring nodes from beyond the border of the fine lattice back to it."""
    return np.clip(position, -CAP_HEIGHT, lattice + CAP_HEIGHT)


def _triangles(inside: BoolArray, numbers: IntArray, vertex_at: IntArray) -> IntArray:
    """Return the triangles of all cells, in the order of voxels and cells."""
    factor = inside.shape[1] - 1
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
    node = numbers[voxel[of_triangle, None], low_node[of_triangle, None] + start[edges]]
    faces: IntArray = vertex_at[3 * node.astype(np.int64) + np.array(EDGE_AXIS)[edges]]
    return faces


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
    reach = np.abs(grid.origin) + np.array(grid.spacing) * field.shape
    fine_spacing = grid.voxel_size / field.factor
    single = np.finfo(np.float32).eps * reach.max() < CLEARANCE / 2 * fine_spacing
    return world.astype(np.float32) if single else world
