"""The mesher ``sharp`` on groups of planes, several at a time, to bound its memory.

It holds some hundred bytes for each crossed cell near an edge. Each group is given to it as a slab
of its own, so the mesh is the same for any groups.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import accumulate, pairwise

import numpy as np

from ..arrays import BoolArray
from ..grid.sdf_grid import SdfGrid
from ..machine.index_width import check_count
from ..machine.threads import map_threads
from ..mesh import Mesh
from . import sharp
from .field import FineField

GROUP_BYTES = 1 << 28  # what the own planes of a group may take
GROUPS_AT_ONCE = 4

Planes = tuple[int, int]


def extract_sharp_pieces(
    field: FineField, grid: SdfGrid, first_vertex: int = 0, threads: int = 1
) -> list[Mesh]:
    """Return the mesh with edges and corners, group by group of the field's own planes."""
    at_once = min(threads, groups_at_once(field.planes, field.shape))
    kinked = sharp.find_kinks(field, threads)
    groups = groups_of_planes(field, kinked, at_once)
    if len(groups) == 1:
        return sharp.extract_sharp_pieces(field, grid, kinked, first_vertex, at_once)

    def mesh_of(planes: Planes) -> list[Mesh]:
        return sharp.extract_sharp_pieces(replace(field, planes=planes), grid, kinked, 0, 1)

    meshes = map_threads(mesh_of, groups, at_once)
    return number_after(first_vertex, [mesh for group in meshes for mesh in group])


def groups_at_once(planes: Planes, shape: tuple[int, ...]) -> int:
    """Return how many groups are worked on at a time: one in a slab, which is to save memory."""
    return GROUPS_AT_ONCE if planes == (0, shape[0]) else 1


def groups_of_planes(field: FineField, kinked: BoolArray, threads: int) -> list[Planes]:
    """Cut a field's own planes into groups that take about the same memory.

    As many as memory asks for, and one for each thread if the groups are then not thinner than the
    planes beside them, which are worked on again with every group.
    """
    first, last = field.planes
    plain, edged = voxel_bytes(field.factor)
    size = plain + edged * sharp.near_kinks(field, kinked)[field.own_rows]
    before = np.cumsum(np.bincount(field.voxel_ijk[field.own_rows, 0] - first, size, last - first))
    thick = (last - first) // (2 * sharp.planes_beside(field.factor))
    count = max(-int(-before[-1] // GROUP_BYTES), min(threads, thick), 1)
    inner = first + np.searchsorted(before, np.arange(1, count) / count * before[-1])
    return list(pairwise(np.unique([first, *inner, last]).tolist()))


def voxel_bytes(factor: int) -> tuple[int, int]:
    """Return the bytes that a voxel takes in a group, and how many more if it is near a kink.

    Measured on a ball and on a field of turned cubes, three voxels wide.
    """
    return 82 * factor**2, 350 * factor**2


def number_after(first_vertex: int, meshes: list[Mesh]) -> list[Mesh]:
    """Return meshes that each count vertices from 0 numbered one after the other, in place."""
    counts = [len(mesh.vertices) for mesh in meshes]
    check_count(first_vertex + sum(counts), "vertices")
    for mesh, before in zip(meshes, accumulate(counts, initial=first_vertex)):
        np.add(mesh.faces, np.int32(before), out=mesh.faces)
    return meshes
