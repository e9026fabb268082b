"""Mesh files: the table of formats, checks of a target, and what a format can hold.

A target is checked before the work starts, and only complete files appear. Far from the world
origin float32 cannot tell neighbouring vertices apart: degenerate triangles, and a mesh that is no
longer closed when a program reads it. So it is checked whether the numbers of a format can hold a
mesh.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..arrays import BoolArray, IntArray, Triple
from ..errors import FileError, OptionError
from ..options import OPTIONS, Unit, check_path
from ..surface.mesh import Mesh, check_mesh
from . import mesh_writers as writers
from .mesh_writers import Parts, World
from .output import check_free, replacing

WORLD_ORIGIN = (0.0, 0.0, 0.0)
AS_IT_IS = World()


class MeshFormat(NamedTuple):
    """A mesh file format."""

    write: Callable[[Parts, Path, World], None]
    is_single: bool = False  # whether coordinates are float32
    has_origin: bool = False  # whether coordinates may be relative to a point
    has_scene: bool = False  # whether it has parts with names and colours, and a unit


MESH_TABLE = {
    ".ply": MeshFormat(writers.write_ply),
    ".stl": MeshFormat(writers.write_stl, is_single=True),
    ".obj": MeshFormat(writers.write_obj),
    ".off": MeshFormat(writers.write_off),
    ".glb": MeshFormat(writers.write_glb, is_single=True, has_origin=True, has_scene=True),
    ".3mf": MeshFormat(writers.write_3mf, has_scene=True),
}
MESH_SUFFIXES = tuple(MESH_TABLE)


def format_of(path: str | Path) -> MeshFormat:
    """Return the format of a mesh file, whose suffix must be one of ``MESH_SUFFIXES``."""
    return MESH_TABLE[Path(path).suffix.lower()]


def check_target(path: str | Path, *, force: bool = False, unit: str | None = None) -> Path:
    """Return the path if a mesh file can be written there; called before the work starts."""
    check_mesh_suffix(Path(path), unit)
    return check_free(Path(path), force=force)


def check_mesh_suffix(path: Path, unit: str | None = None) -> None:
    """Raise OptionError if the suffix is not that of a mesh format, or of none that has a unit."""
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise OptionError(f"{path} is not a mesh file: give one of {', '.join(MESH_SUFFIXES)}")
    if unit and not format_of(path).has_scene:
        stating = " or ".join(suffix for suffix, kind in MESH_TABLE.items() if kind.has_scene)
        raise OptionError(f"unit is {unit}: {path} can state none, give {stating}, or no unit")


def write_mesh(
    mesh: Mesh,
    path: str | Path,
    *,
    force: bool = False,
    unit: Unit | None = None,
    space: str | None = None,
    before_rename: Callable[[Path], None] | None = None,
) -> None:
    """Write a mesh to a file, in the format of its suffix.

    ``.glb`` has float32 coordinates: a float64 mesh is written relative to the middle of its
    bounding box, which is stored as the translation of the node.

    Parameters
    ----------
    mesh : Mesh
        The mesh, in world units.
    path : path
        The file: .ply, .stl, .obj, .off, .glb or .3mf.
    force : bool
        Replace an existing file.
    unit : str, optional
        Unit of the world, which .3mf and .glb state: um, mm, cm, m, in or ft. Default: a .3mf says
        mm, a .glb m.
    space : str, optional
        The anatomical space of the coordinates, "RAS" or "LPS", such as that of the grid. A .ply,
        .stl or .obj names it in its header, where 3D Slicer looks for it.
    before_rename : callable, optional
        Called with the temporary path of the complete file, just before it gets its name. If it
        raises an error, no file is written.

    Raises
    ------
    OptionError
        If the suffix is unknown, or that of a format that states no unit.
    FileError
        If the file exists and ``force`` is not set, or cannot be written; or if the format cannot
        hold the mesh: a coordinate is not finite, or corners of a triangle would coincide.
    """
    check_mesh(mesh)
    path = check_path(path, "path")
    world = World(OPTIONS["unit"].check(unit), OPTIONS["space"].check(space))
    check_target(path, force=force, unit=world.unit)

    def tell(complete: Mapping[Path, Path]) -> None:
        if before_rename:
            before_rename(complete[path])

    write_meshes({path: {"": mesh}}, force=force, world=world, before_rename=tell)


def write_meshes(
    files: Mapping[Path, Parts],
    *,
    force: bool = False,
    world: World = AS_IT_IS,
    before_rename: Callable[[Mapping[Path, Path]], None] | None = None,
) -> None:
    """Write files of meshes, by path and name: all of them, or none.

    ``before_rename`` is called with all complete files, by the paths that they will have. A format
    of one mesh takes the only one of its file.
    """
    complete: dict[Path, Path] = {}
    with ExitStack() as stack:
        for path, parts in files.items():
            placed = World(world.unit, world.space, world.colours, _origin(path, parts.values()))
            for mesh in parts.values():
                _check_holds(path, mesh, placed.origin)
            complete[path] = stack.enter_context(replacing(path, force=force))
            format_of(path).write(parts, complete[path], placed)
        if before_rename:
            before_rename(complete)
        for path in files:
            check_free(path, force=force)  # before the first of them appears


def _check_holds(path: Path, mesh: Mesh, origin: Triple) -> None:
    """Raise FileError if a format cannot hold the vertices of a mesh."""
    vertices, faces = mesh.vertices, mesh.faces
    if not np.isfinite(vertices).all():
        raise FileError(f"{path} cannot be written: a vertex of the mesh is not finite")
    if not format_of(path).is_single or vertices.dtype == np.float32:
        return
    with np.errstate(over="ignore"):
        rounded = (vertices - origin).astype(np.float32)
    if not np.isfinite(rounded).all() or (_flat(rounded, faces) & ~_flat(vertices, faces)).any():
        said = f"{path} cannot be written: {path.suffix} has single precision, in which vertices"
        raise FileError(f"{said} of this mesh coincide; write .ply or .obj")


def _flat(vertices: np.ndarray[Any, Any], faces: IntArray) -> BoolArray:
    """Return which triangles have two corners at the same position."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    flat: BoolArray = (a == b).all(1) | (b == c).all(1) | (c == a).all(1)
    return flat


def _origin(path: Path, meshes: Iterable[Mesh]) -> Triple:
    """Return the local origin of a file: the middle of float64 meshes, if the format has one."""
    boxes = [(m.vertices.min(0), m.vertices.max(0)) for m in meshes if len(m.vertices)]
    if not boxes or not format_of(path).has_origin or boxes[0][0].dtype == np.float32:
        return WORLD_ORIGIN
    x, y, z = (np.min(boxes, axis=(0, 1)) / 2 + np.max(boxes, axis=(0, 1)) / 2).tolist()
    return x, y, z
