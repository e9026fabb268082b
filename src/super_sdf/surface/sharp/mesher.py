"""The mesher ``sharp``: edges and corners found, numbered and joined, groups of planes at a time.

It holds some hundred bytes for each crossed cell near an edge. Each group of planes is meshed as a
slab of its own, so the mesh is the same for any groups.

Positions are in fine spacings, from node (0, 0, 0) of the fine lattice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import accumulate, chain, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arrays import BoolArray, IntArray
from ...grid.sdf_grid import SdfGrid
from ...threads import check_count, map_chunks, map_threads
from ..mesh import CLEARANCE, Mesh, vertex_type
from ...refine.field import FineField
from ..marching import (CAP_HEIGHT, NO_FACES, Crossings, connect, find_crossings, lattice_positions, to_world)
from .features import CHAIN_ROUNDS, MOVED_RINGS, RINGS, place_features
from .folds import REACH, without_folds
from .patches import (Index, Patches, Placed, Vectors, beside, find_patches, nth_of_row, triangles_of, voxels_near_kinks)
from .planes import ROUNDS, planes_at_crossings

# Cells to every side that a vertex depends on: gradients reach 2 cells, a patch is 1 wide, and so
# is the fan beside.
REACH_IN_CELLS = RINGS + ROUNDS + CHAIN_ROUNDS + MOVED_RINGS + REACH + 5
TEMPORARIES = 16  # numbers per crossing in the computation of its position
REACH_IN_VOXELS = 2  # further: whether a voxel is examined depends on those beside it
GROUP_BYTES = 1 << 28  # what the own planes of a group may take
GROUPS_AT_ONCE = 4

PlaneRange = tuple[int, int]


def extract_pieces(
    field: FineField, grid: SdfGrid, first_vertex: int = 0, threads: int = 1
) -> list[Mesh]:
    """Return the mesh with edges and corners, group by group of the field's own planes."""
    at_once = min(threads, groups_at_once(field.planes, field.shape))
    kinked = voxels_near_kinks(field, _rows_around(field), threads)
    groups = groups_of_planes(field, kinked, at_once)
    if len(groups) == 1:
        return extract_group(field, grid, kinked, first_vertex)

    def mesh_of(planes: PlaneRange) -> list[Mesh]:
        return extract_group(replace(field, planes=planes), grid, kinked)

    meshes = list(chain.from_iterable(map_threads(mesh_of, groups, at_once)))
    counts = [len(mesh.vertices) for mesh in meshes]
    check_count(first_vertex + sum(counts), "vertices")
    for mesh, before in zip(meshes, accumulate(counts, initial=first_vertex)):
        np.add(mesh.faces, np.int32(before), out=mesh.faces)
    return meshes


def groups_at_once(planes: PlaneRange, shape: tuple[int, ...]) -> int:
    """Return how many groups are worked on at a time: one in a slab, which is to save memory."""
    return GROUPS_AT_ONCE if planes == (0, shape[0]) else 1


def groups_of_planes(field: FineField, kinked: BoolArray, threads: int) -> list[PlaneRange]:
    """Cut a field's own planes into groups that take about the same memory.

    As many as memory asks for, and one for each thread if the groups are then at least twice as
    thick as the planes beside them, which are worked on again with every group. Threads within a
    group would only wait for each other: its arrays are small.
    """
    first, last = field.planes
    plain, edged = voxel_bytes(field.factor)
    size = plain + edged * _near_kinks(field, kinked)[field.own_rows]
    before = np.cumsum(np.bincount(field.voxel_ijk[field.own_rows, 0] - first, size, last - first))
    thick = (last - first) // (4 * planes_beside(field.factor))
    count = max(-int(-before[-1] // GROUP_BYTES), min(threads, thick), 1)
    inner = first + np.searchsorted(before, np.arange(1, count) / count * before[-1])
    return list(pairwise(np.unique([first, *inner, last]).tolist()))


def voxel_bytes(factor: int) -> tuple[int, int]:
    """Return the measured bytes that a voxel takes in a group, and how many more near a kink."""
    return 82 * factor**2, 350 * factor**2


def planes_beside(factor: int) -> int:
    """Return how many coarse planes to either side a slab's mesh depends on."""
    return -(-(REACH_IN_CELLS + 1) // factor) + REACH_IN_VOXELS


def _rows_around(field: FineField) -> slice:
    """Return the rows of the field's own planes and of those that they depend on."""
    beside = planes_beside(field.factor)
    return field.rows(field.planes[0] - beside, field.planes[1] + beside)


def _near_kinks(field: FineField, chosen: BoolArray) -> BoolArray:
    """Return the voxels, (D,), that are examined if edges may be in chosen ones."""
    return beside(field, chosen, -(-(RINGS + 1) // field.factor))


def extract_group(
    field: FineField, grid: SdfGrid, kinked: BoolArray, first_vertex: int = 0
) -> list[Mesh]:
    """Return the mesh of a field's planes with its edges and corners, as a list of one piece.

    Vertices are numbered voxel by voxel, on the edges that it owns, then of its features.
    ``kinked`` is from ``voxels_near_kinks``, for this field or one of more planes.
    """
    rows = _rows_around(field)
    before = field.plane_before(rows).start if rows.start < rows.stop else rows.start
    crossings = find_crossings(field, slice(before, rows.stop))
    if not len(crossings.own_row):
        return [Mesh(np.empty((0, 3), vertex_type(grid, field.factor)), NO_FACES)]
    examined = examine(field, crossings, rows, kinked)
    count, row = len(field.voxel_ijk) + 1, examined.patches.row[examined.placed.feature]
    edges = np.bincount(crossings.own_row, minlength=count)
    peaks = np.bincount(row, minlength=count)
    first = np.cumsum(edges + peaks) - edges - peaks
    core = field.own_rows
    own = int(first[core.stop] - first[core.start])
    check_count(first_vertex + own, "vertices")
    first += first_vertex - first[core.start]
    numbers = (
        first[crossings.own_row] + nth_of_row(crossings.own_row, edges),  # of crossings
        first[row] + edges[row] + nth_of_row(row, peaks),  # of features
    )
    mine = slice(first_vertex, first_vertex + own)
    vertices = _vertices(field, crossings, examined, numbers, mine)
    faces = _faces(field, crossings, examined, numbers)
    return [Mesh(to_world(vertices.T, field, grid), faces)]


@dataclass(frozen=True, eq=False)
class Examined:
    """What is found in the voxels that may hold an edge; the others are left to marching cubes."""

    voxels: BoolArray  # (D,), which voxels were examined
    patches: Patches  # their patches; ``crossing`` counts among ``used``
    used: Index  # (m,), the crossings of these patches
    placed: Placed  # where the vertices on these crossings and on the features belong


def examine(field: FineField, crossings: Crossings, rows: slice, kinked: BoolArray) -> Examined:
    """Look for edges and corners in kinked voxels and beside them."""
    here = _within(np.arange(len(kinked)), rows)
    voxels = _near_kinks(field, kinked & here) & here
    patches, used = find_patches(field, crossings, voxels)
    own = planes_at_crossings(field, crossings, used)
    placed = place_features(patches, own, kinked, field)
    position = _kept_in_grid(placed.position, own.point, field)
    peak = _kept_in_grid(placed.peak, patches.low[placed.feature] + 0.5, field)
    kept = replace(placed, position=position, peak=peak)
    return Examined(voxels, patches, used, without_folds(patches, kept, own.point))


def _kept_in_grid(position: Vectors, start: Vectors, field: FineField) -> Vectors:
    """Return positions (n, 3) that do not leave the grid, nor its border if they started there.

    An open surface ends on the border, and a cap is flat there. ``start``, (n, 3), is where a
    vertex was on its lattice edge, or the middle of its cell.
    """
    last = np.array(field.shape, np.float64) * field.factor
    at_border = (start <= 0) | (start >= last)
    border = np.clip(start, -CAP_HEIGHT, last + CAP_HEIGHT)
    return np.where(at_border, border, np.clip(position, CLEARANCE, last - CLEARANCE))


def _within(row: NDArray[Any], rows: slice) -> BoolArray:
    inside: BoolArray = (row >= rows.start) & (row < rows.stop)
    return inside


def _vertices(
    field: FineField,
    crossings: Crossings,
    examined: Examined,
    numbers: tuple[Index, Index],
    own: slice,
) -> Vectors:
    """Return the vertices of the field's ``own`` voxels, (n, 3), in fine spacings."""
    vertices = np.empty((own.stop - own.start, 3))
    mine = crossings.own(field.own_rows)

    def place(some: slice) -> None:
        rows = slice(mine.start + some.start, mine.start + some.stop)
        plain = lattice_positions(field, crossings.own_row[rows], crossings.own_edge[rows])
        vertices[numbers[0][rows] - own.start] = plain.T

    map_chunks(place, mine.stop - mine.start, TEMPORARIES)
    used, placed = examined.used, examined.placed
    for row, number, position in (
        (crossings.own_row[used], numbers[0][used], placed.position),
        (examined.patches.row[placed.feature], numbers[1], placed.peak),
    ):
        core = _within(row, field.own_rows)
        vertices[number[core] - own.start] = position[core]
    return vertices


def _faces(
    field: FineField, crossings: Crossings, examined: Examined, numbers: tuple[Index, Index]
) -> IntArray:
    """Return the triangles of the field's own voxels, plane by plane.

    In each plane those of voxels that were not examined come first, then the others in the order of
    their patches. A side between two fans becomes two triangles of the later patch.
    """
    plain = ~examined.voxels[crossings.cell_row]
    cells = (crossings.cell_row[plain], crossings.cell[plain], crossings.case[plain])
    smooth = replace(crossings, cell_row=cells[0], cell=cells[1], case=cells[2])
    patch, corners = triangles_of(examined.patches, examined.placed)
    faces = np.concatenate([numbers[0][examined.used], numbers[1]])[corners]
    row = examined.patches.row[patch]
    parts = [NO_FACES]
    for plane in range(*field.planes):
        rows = field.rows(plane, plane + 1)
        if rows.start < rows.stop:
            parts.append(numbers[0][connect(field, smooth, rows, 0)].astype(np.int32))
            start, stop = np.searchsorted(row, [rows.start, rows.stop])
            parts.append(faces[start:stop].astype(np.int32))
    return np.concatenate(parts)
