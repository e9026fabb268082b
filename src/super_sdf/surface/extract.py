"""From a fine field to its mesh: closed at the border, crossings found, edges kept, joined."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import CORNERS, IntArray, Vectors
from ..grid.sdf_grid import SdfGrid, cubic_grid, with_fields
from ..refine.band import neighbour_table, rescale
from ..refine.field import FineField
from ..refine.nodes import block_ijk, share_parts
from ..threads import check_count, map_chunks
from . import marching
from .cap import close
from .mesh import Mesh, vertex_type

if TYPE_CHECKING:
    from ..options import MesherName

TEMPORARIES = 16  # numbers per vertex in the computation of its position
KEYS_PER_NODE = 16  # its three edges, and the features of the cell above it
FIRST_FEATURE = 3


def reach_in_voxels(mesher: MesherName, factor: int) -> int:
    """Return how many voxels to every side a vertex and its triangles depend on."""
    if mesher == "marching":
        return 1
    from .sharp.features import REACH_IN_CELLS, REACH_IN_VOXELS

    return -(-(REACH_IN_CELLS + 1) // factor) + REACH_IN_VOXELS


def extract(
    field: FineField,
    lattice: SdfGrid,
    *,
    mesher: MesherName,
    cap: bool,
    threads: int = 1,
    first: tuple[int, int, int] = (0, 0, 0),
    shape: tuple[int, int, int] | None = None,
) -> tuple[Mesh, NDArray[np.int64]]:
    """Return the zero level of a field as triangles in world coordinates, and the vertices' keys.

    Vertices on lattice edges come first, then those of features.

    Parameters
    ----------
    field : FineField
        Of a grid, or of a part of it.
    lattice : SdfGrid
        The field's samples: it is from ``cubic_grid``. Mirrored axes turn triangles inward, so
        these are turned over.
    mesher : str
        "marching" or "sharp".
    cap : bool
        Close a surface that leaves the whole grid.
    first, shape : three ints
        Of a part: the index in the whole grid of its first sample, and the shape of the whole.

    Returns
    -------
    Mesh, (n,) int64
        The keys are the same in every part that has the vertex: 16 times the number of a node, in C
        order on the fine lattice of the whole grid with a voxel more to every side, plus the axis
        of the lattice edge that begins there, or 3 and more for the features of its cell.
    """
    kind = vertex_type(lattice, field.factor)

    def written(points: Vectors) -> NDArray[Any]:
        """Return points (n, 3), in fine spacings from node (0, 0, 0), as vertices in the world."""
        return lattice.to_world(points / field.factor - 0.5).astype(kind)  # K i + K/2 is sample i

    def rounded(points: Vectors) -> Vectors:
        """Return points as they will be written, in fine spacings again."""
        return field.factor * (lattice.to_index(written(points)) + 0.5)

    whole = np.array(field.shape if shape is None else shape)
    border = np.array([(0, 0, 0), whole]) - np.array(first)
    field = close(field, cap=cap, border=border)
    crossings = marching.find_crossings(field, threads)
    features = None
    if mesher == "sharp" and len(field.spheres.distance):
        from .sharp.features import find_features

        features = find_features(field, crossings, border, rounded, threads)
    count = len(crossings.own_row)
    total = check_count(count + (len(features.peak) if features else 0), "vertices")
    vertices = np.empty((total, 3), kind)
    keys, nodes = np.empty(total, np.int64), block_ijk(field.factor)

    def place(some: slice) -> None:
        row, edge = crossings.own_row[some], crossings.own_edge[some]
        positions = marching.lattice_positions(field, row, edge, border)
        vertices[some] = written(positions.T)
        axis, node = np.divmod(edge, np.int16(len(field.blocks)))
        node_ijk = field.factor * (field.voxel_ijk[row] - border[0]) + nodes[node]
        keys[some] = keys_of(node_ijk, whole, field.factor) + axis

    map_chunks(place, count, TEMPORARIES, threads)
    if features is None:
        faces = marching.connect(field, crossings, threads)
    else:
        vertices[features.used] = written(features.position)
        vertices[count:] = written(features.peak)
        cell = features.cell_ijk - field.factor * border[0]
        keys[count:] = keys_of(cell, whole, field.factor) + FIRST_FEATURE + features.nth
        faces = np.concatenate([marching.connect(field, features.plain, threads), features.faces])
    if lattice.is_mirrored:
        faces = np.ascontiguousarray(faces[:, ::-1])
    return Mesh(vertices, faces), keys


def keys_of(node_ijk: IntArray, shape: NDArray[Any], factor: int) -> NDArray[np.int64]:
    """Return the keys of nodes (n, 3), counted from the first of the whole: see ``extract``."""
    _, ny, nz = (factor * (shape + 2) + 1).tolist()
    i, j, k = node_ijk.T.astype(np.int64) + factor
    return np.asarray(KEYS_PER_NODE * ((i * ny + j) * nz + k))


def coarse_surface(grid: SdfGrid, offset: float = 0.0) -> Mesh:
    """Return marching cubes of a grid's samples, made cubic: every cell is a block of factor 1."""
    values = rescale(grid := cubic_grid(grid, offset), offset)
    some = every = values <= 0
    for axis in range(3):
        low, high = (slice(None),) * axis + (slice(-1),), (slice(None),) * axis + (slice(1, None),)
        some, every = some[low] | some[high], every[low] & every[high]
    cell_ijk = np.argwhere(some & ~every).astype(np.int32)
    blocks = np.stack([values[tuple((cell_ijk + corner).T)] for corner in CORNERS])
    parts = share_parts(neighbour_table(cell_ijk, some.shape))
    field = FineField(some.shape, 1, cell_ijk, blocks, parts, grid)
    middle = tuple(grid.to_world([0.5, 0.5, 0.5]).tolist())
    return extract(field, with_fields(grid, origin=middle), mesher="marching", cap=False)[0]
