"""Meshes to files. A target is checked before the work starts, and its file appears whole.

A module a format (``ply``, ``stl``, ``text_meshes``, ``glb``, ``threemf``). All take a mesh in
pieces and hold no more of it in memory than one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Triple
from ..errors import FileError, OptionError, OptionTypeError, seen
from ..mesh import Mesh
from ..options import check_path
from .glb import write_glb
from .output import check_free, replacing
from .ply import write_ply
from .stl import write_stl
from .text_meshes import write_obj, write_off
from .threemf import write_3mf

MESH_SUFFIXES = (".ply", ".stl", ".obj", ".off", ".glb", ".3mf")
# Formats with 32 bits a number, and those that can say where the point is that they count from.
SINGLE_PRECISION = (".stl", ".glb")
WITH_LOCAL_ORIGIN = (".glb",)
# What a triangle takes in a file, in bytes, with its half of a vertex; of text and archives about.
BYTES_PER_TRIANGLE = {".ply": 19, ".stl": 50, ".obj": 40, ".off": 39, ".glb": 18, ".3mf": 13}
Writer = Callable[[Iterable[Mesh], Path], None]
WORLD_ORIGIN = (0.0, 0.0, 0.0)
CHUNK = 1 << 16  # triangles that are looked at at a time


def check_target(path: str | Path, *, force: bool = False) -> Path:
    """Return the path of a mesh file to be if it can be written; asked before the work starts."""
    check_mesh_suffix(Path(path))
    return check_free(Path(path), force=force)


def check_mesh_suffix(path: Path) -> None:
    """Raise if the suffix is no mesh file's."""
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise OptionError(f"{path} is no mesh file: give one of {', '.join(MESH_SUFFIXES)}")


def write_mesh(mesh: Mesh, path: str | Path, *, force: bool = False) -> None:
    """Write a mesh; the suffix tells the format.

    ``.glb`` holds single precision: a mesh in double precision is written about the middle of its
    box, which the file's node adds.

    Raises
    ------
    OptionError
        If the suffix is unknown.
    FileError
        If the file exists and ``force`` is not set, or cannot be written; or if the format cannot
        hold the mesh: a coordinate is not finite, or corners of a triangle would fall together.
    """
    if not isinstance(mesh, Mesh):
        raise OptionTypeError(f"mesh is {seen(mesh)}: give one from reconstruct(grid)")
    path = check_target(check_path(path, "path"), force=force)
    about = _local_origin(mesh, path)
    _check_mesh_holds(mesh, path, about)
    write_pieces([mesh], path, force=force, about=about)


def write_pieces(
    pieces: Iterable[Mesh],
    path: str | Path,
    *,
    force: bool = False,
    about: Triple = WORLD_ORIGIN,
    before_rename: Callable[[Path], None] | None = None,
) -> None:
    """Write a mesh that comes in pieces, whose triangles use the vertices of all pieces so far.

    ``about`` is the point that a format with a local origin counts from. Whether the format can
    hold the mesh is not asked: see ``precision.check_format_holds``. ``before_rename`` is called
    with the path of the finished file, before it takes its name. Otherwise as ``write_mesh``.
    """
    path = check_target(path, force=force)
    writers: dict[str, Writer] = {
        ".ply": write_ply,
        ".stl": write_stl,
        ".obj": write_obj,
        ".off": write_off,
        ".glb": partial(write_glb, about=about),
        ".3mf": write_3mf,
    }
    with replacing(path, force=force, before_rename=before_rename) as part:
        writers[path.suffix.lower()](pieces, part)


def _local_origin(mesh: Mesh, path: Path) -> Triple:
    """Return the point that a mesh's file is to count from."""
    wide = mesh.vertices.dtype == np.float64 and len(mesh.vertices)
    if path.suffix.lower() not in WITH_LOCAL_ORIGIN or not wide:
        return WORLD_ORIGIN
    x, y, z = mesh.vertices.min(0) / 2 + mesh.vertices.max(0) / 2
    return float(x), float(y), float(z)


def _check_mesh_holds(mesh: Mesh, path: Path, about: Triple) -> None:
    """Raise if a mesh has coordinates that are not finite, or that its format cannot hold."""
    if not np.isfinite(mesh.vertices).all():
        raise FileError(f"{path} cannot be written: a vertex of the mesh is not finite")
    if path.suffix.lower() not in SINGLE_PRECISION or mesh.vertices.dtype == np.float32:
        return
    with np.errstate(over="ignore"):
        rounded = (mesh.vertices - about).astype(np.float32)
    lost = not np.isfinite(rounded).all() or any(
        _flat_triangles(rounded[rows]) > _flat_triangles(mesh.vertices[rows])
        for rows in np.array_split(mesh.faces, len(mesh.faces) // CHUNK + 1)
    )
    if lost:
        raise FileError(
            f"{path} cannot be written: {path.suffix} holds single precision, in which vertices of "
            "this mesh fall together; write .ply or .obj"
        )


def _flat_triangles(corners: NDArray[Any]) -> int:
    """Count triangles, (n, 3, 3), two of whose corners are the same point."""
    same = (corners == np.roll(corners, 1, axis=1)).all(2).any(1)
    return int(np.count_nonzero(same))
