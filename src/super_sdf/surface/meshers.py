"""The meshers: how each makes triangles of a fine field, and which planes beside it that takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from ..errors import OptionTypeError, seen
from ..functions.function import Function, as_function
from ..grid.cubic import cubic_grid
from ..grid.sdf_grid import SdfGrid, check_grid
from .mesh import Mesh, join_meshes
from ..options import AUTO, DEFAULT_MESHER, MARCHING, SHARP, MesherName, check_cap, check_mesher
from . import marching
from .cap import check_can_close, close
from ..refine.field import FineField

Extract = Callable[[FineField, SdfGrid, int, int], list[Mesh]]
"""Takes a field, the grid, the number of the first vertex, and threads; see ``extract_pieces``."""


@dataclass(frozen=True)
class Mesher:
    """A way to make triangles of a field."""

    name: MesherName  # "marching" or "sharp"
    extract: Extract  # returns the mesh of a field's own planes, in one or more pieces
    # takes the factor; returns how many coarse planes to either side of a slab must have final
    # values, since its mesh depends on them
    planes_beside: Callable[[int], int]


def _sharp() -> ModuleType:
    """Return the sharp mesher, imported when asked for: it is a tenth of a short start."""
    from .sharp import mesher

    return mesher


BY_NAME = {
    # the plane before decides who owns the vertices on the shared face
    MARCHING: Mesher(MARCHING, marching.extract_pieces, lambda factor: 1),
    SHARP: Mesher(
        SHARP,
        lambda *arguments: _sharp().extract_pieces(*arguments),
        lambda factor: _sharp().planes_beside(factor),
    ),
}


def find_mesher(name: Any, *, exact: bool) -> Mesher:
    """Return the mesher with a name; by itself ``sharp`` if samples are exact distances.

    Without such samples it finds no edges, and its mesh is that of marching cubes.
    """
    automatic = SHARP if exact else MARCHING
    return BY_NAME[automatic if check_mesher(name) == AUTO else name]


def extract_mesh(
    field: FineField,
    grid: SdfGrid | None = None,
    first_vertex: int = 0,
    *,
    mesher: MesherName = DEFAULT_MESHER,
    cap: bool = True,
    function: Function | None = None,
) -> Mesh:
    """Return the zero level of a field as triangles in world coordinates.

    A node with value 0 is inside.

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
        As in ``reconstruct``; "auto" is "sharp" if the field has samples that were taken as exact.
    cap : bool
        Close a surface that leaves the grid, as in ``reconstruct``. A field that was made without
        its grid stays open.
    function : callable or DistanceFunction, optional
        What the grid has samples of; vertices are then put where it is 0, as in ``reconstruct``.

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
    samples = field.spheres
    chosen = find_mesher(mesher, exact=samples is not None and len(samples.distance) > 0)
    cap = check_cap(cap) and field.grid is not None
    check_can_close(grid, cap=cap)
    whole = close(field, cap=cap, beside=chosen.planes_beside(field.factor))
    mesh = join_meshes(extract_pieces(whole, cubic_grid(grid), first_vertex, 1, chosen))
    if function is None:
        return mesh
    from ..functions.zero import put_on_zero  # imported here, as few call it

    return put_on_zero(mesh, as_function(function), grid, field.factor, field.offset)


def extract_pieces(
    field: FineField, grid: SdfGrid, first_vertex: int, threads: int, mesher: Mesher
) -> list[Mesh]:
    """Return the mesh of ``extract_mesh`` as a list of one or more pieces, in order.

    ``grid`` has the lattice of the field: it is from ``cubic_grid``. Mirrored axes turn triangles
    inward, so these are turned over.
    """
    pieces = mesher.extract(field, grid, first_vertex, threads)
    if not grid.is_mirrored:
        return pieces
    return [Mesh(piece.vertices, np.ascontiguousarray(piece.faces[:, ::-1])) for piece in pieces]
