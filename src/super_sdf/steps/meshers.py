"""The meshers: how each makes triangles of a fine field, and which planes beside it that takes.

The mesher that keeps edges holds some hundred bytes for each crossed cell, so it works on groups of
planes, several at a time. Each is given to it as a slab of its own, so the mesh is the same for
any groups.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionError, OptionTypeError, seen
from ..grid.cubic import cubic_grid
from ..grid.sdf_grid import SdfGrid
from ..machine.index_width import check_count
from ..machine.threads import map_threads
from ..mesh import Mesh, join_meshes
from ..options import check_grid
from . import marching, sharp
from .field import FineField
from .mesher_names import DEFAULT_MESHER, MARCHING, MESHERS, SHARP

CELLS_IN_GROUP = 1 << 21  # K^2 for each voxel: about half as many are crossed
GROUPS_AT_ONCE = 4

Planes = tuple[int, int]
Extract = Callable[[FineField, SdfGrid, int, int], list[Mesh]]
"""Takes a field, the grid, the number of the first vertex, and threads; see ``extract_pieces``."""


@dataclass(frozen=True)
class Mesher:
    """A way to make triangles of a field.

    Attributes
    ----------
    name : str
        One of ``mesher_names.MESHERS``.
    extract : callable
        Returns the mesh of a field's own planes, in one or more pieces.
    planes_beside : callable
        Takes the factor; returns how many coarse planes to either side of a slab must have final
        values, since its mesh depends on them.
    """

    name: str
    extract: Extract
    planes_beside: Callable[[int], int]


def _next_plane(factor: int) -> int:
    """Return 1: the plane before decides who owns the vertices on the shared face."""
    return 1


def extract_sharp_pieces(
    field: FineField, grid: SdfGrid, first_vertex: int = 0, threads: int = 1
) -> list[Mesh]:
    """Return the mesh with edges and corners, group by group of the field's own planes."""
    threads = min(threads, groups_at_once(field.planes, field.shape))
    groups = groups_of_planes(field, threads)
    if len(groups) == 1:
        return sharp.extract_sharp_pieces(field, grid, first_vertex, threads)

    def mesh_of(planes: Planes) -> list[Mesh]:
        return sharp.extract_sharp_pieces(replace(field, planes=planes), grid, 0, 1)

    meshes = map_threads(mesh_of, groups, threads)
    return number_after(first_vertex, [mesh for group in meshes for mesh in group])


def groups_at_once(planes: Planes, shape: tuple[int, ...]) -> int:
    """Return how many groups are worked on at a time: one in a slab, which is to save memory."""
    return GROUPS_AT_ONCE if planes == (0, shape[0]) else 1


def groups_of_planes(field: FineField, threads: int) -> list[Planes]:
    """Cut a field's own planes into groups with about equally many voxels."""
    first, last = field.planes
    plane = field.voxel_ijk[field.own_rows, 0]
    count = count_groups(len(plane), last - first, field.factor, threads)
    inner = plane[np.arange(1, count) * len(plane) // count]
    bounds = np.unique([first, *np.maximum(inner, first), last]).tolist()
    return list(pairwise(bounds))


def count_groups(voxels: int, planes: int, factor: int, threads: int) -> int:
    """Return into how many groups the voxels of some planes are divided.

    As many as memory asks for, and one for each thread if the groups are then not thinner than the
    planes beside them, which are worked on again with every group.
    """
    thick = planes // (2 * sharp.planes_beside(factor))
    return max(voxels * factor**2 // CELLS_IN_GROUP, min(threads, thick), 1)


def number_after(first_vertex: int, meshes: list[Mesh]) -> list[Mesh]:
    """Return meshes that each count vertices from 0 numbered one after the other."""
    counts = [len(mesh.vertices) for mesh in meshes]
    check_count(first_vertex + sum(counts), "vertices")
    starts: NDArray[Any] = first_vertex + np.cumsum([0, *counts[:-1]])
    return [
        Mesh(mesh.vertices, mesh.faces + np.int32(start)) for mesh, start in zip(meshes, starts)
    ]


BY_NAME = {
    mesher.name: mesher
    for mesher in (
        Mesher(MARCHING, marching.extract_pieces, _next_plane),
        Mesher(SHARP, extract_sharp_pieces, sharp.planes_beside),
    )
}


def find_mesher(name: Any) -> Mesher:
    """Return the mesher with a name.

    Raises
    ------
    OptionError
        If there is none, or the name is no string (``OptionTypeError``).
    """
    if not isinstance(name, str):
        raise OptionTypeError(f"mesher is {seen(name)}: give one of {', '.join(MESHERS)}")
    if name not in BY_NAME:
        raise OptionError(f"mesher is {name!r}: give one of {', '.join(MESHERS)}")
    return BY_NAME[name]


def extract_mesh(
    field: FineField, grid: SdfGrid, first_vertex: int = 0, *, mesher: str = DEFAULT_MESHER
) -> Mesh:
    """Return the zero level of a field as triangles in world coordinates.

    A node with value 0 is inside. Marching cubes places vertices on lattice edges, by linear
    interpolation.

    Parameters
    ----------
    field : FineField
        From ``upsample``.
    grid : SdfGrid
        The coarse grid that it was made from, for spacing, origin and direction.
    first_vertex : int
        The number of the first vertex, for a field of a slab: the number of vertices in the slabs
        before. Faces may also refer to vertices of the slab before.
    mesher : str
        "marching" for marching cubes; "sharp" also puts vertices on edges and corners.

    Raises
    ------
    OptionError
        If there is no such mesher; if there are more vertices than 32-bit numbers, including those
        before.
    OptionTypeError
        If an argument is something else.
    """
    if not isinstance(field, FineField):
        raise OptionTypeError(f"field is {seen(field)}: give one from upsample(grid, network)")
    check_grid(grid)
    pieces = extract_pieces(field, cubic_grid(grid), first_vertex, 1, find_mesher(mesher))
    return join_meshes(pieces)


def extract_pieces(
    field: FineField, grid: SdfGrid, first_vertex: int, threads: int, mesher: Mesher
) -> list[Mesh]:
    """Return the mesh of ``extract_mesh`` as a list of one or more pieces, in order.

    ``grid`` has the lattice of the field: it is from ``cubic_grid``.
    """
    pieces = mesher.extract(field, grid, first_vertex, threads)
    return [turned_over(piece) for piece in pieces] if grid.is_mirrored else pieces


def turned_over(mesh: Mesh) -> Mesh:
    """Return a mesh with its triangles in reverse order: mirrored axes turn them inward."""
    return Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1]))
