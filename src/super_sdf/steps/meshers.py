"""The meshers: how each makes triangles of a fine field, and which planes beside it that takes.

The mesher that keeps edges holds some hundred bytes for each crossed cell near an edge, so it works
on groups of planes, several at a time. Each is given to it as a slab of its own, so the mesh is
the same for any groups.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from typing import Any

import numpy as np

from ..arrays import BoolArray
from ..errors import OptionError, OptionTypeError, seen
from ..grid.cubic import cubic_grid
from ..grid.sdf_grid import SdfGrid
from ..machine.index_width import check_count
from ..machine.threads import map_threads
from ..mesh import Mesh, join_meshes
from ..options import check_cap, check_grid
from . import marching, sharp
from .cap import close
from .field import FineField
from .mesher_names import DEFAULT_MESHER, MARCHING, MESHERS, SHARP

GROUP_BYTES = 1 << 28  # what the own planes of a group may take
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
    field: FineField,
    grid: SdfGrid | None = None,
    first_vertex: int = 0,
    *,
    mesher: str = DEFAULT_MESHER,
    cap: bool = False,
) -> Mesh:
    """Return the zero level of a field as triangles in world coordinates.

    A node with value 0 is inside. Marching cubes places vertices on lattice edges, by linear
    interpolation.

    Parameters
    ----------
    field : FineField
        From ``upsample`` or ``read_field``.
    grid : SdfGrid, optional
        A coarse grid for spacing, origin and direction. Default: the one that the field was made
        from.
    first_vertex : int
        The number of the first vertex, for a field of a slab: the number of vertices in the slabs
        before. Faces may also refer to vertices of the slab before.
    mesher : str
        "marching" for marching cubes; "sharp" also puts vertices on edges and corners.
    cap : bool
        Close a surface that leaves the grid, as in ``reconstruct``.

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
    grid = field.placed if grid is None else grid
    check_grid(grid)
    chosen = find_mesher(mesher)
    whole = close(field, cap=check_cap(cap), beside=chosen.planes_beside(field.factor))
    return join_meshes(extract_pieces(whole, cubic_grid(grid), first_vertex, 1, chosen))


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
