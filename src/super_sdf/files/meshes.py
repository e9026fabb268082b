"""Writing mesh files. A target is checked before the work starts, and only complete files appear.

Each format has its module (``ply``, ``stl``, ``text_meshes``, ``glb``, ``threemf``) and its entry
in ``FORMATS``. All write a mesh piece by piece and hold no more than one piece in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Triple
from ..errors import FileError, OptionError
from ..mesh import Mesh, check_mesh
from ..options import check_path
from .glb import write_glb, write_glb_parts
from .output import check_free, replacing
from .ply import write_ply
from .stl import write_stl
from .text_meshes import write_obj, write_off
from .threemf import write_3mf, write_3mf_parts

WORLD_ORIGIN = (0.0, 0.0, 0.0)
CHUNK = 1 << 16  # triangles checked at a time


@dataclass(frozen=True)
class MeshFormat:
    """A mesh file format.

    Attributes
    ----------
    write : callable
        Writes pieces of a mesh to a path.
    bytes_per_triangle : int
        Size of a triangle in the file with its half of a vertex; approximate for text and archives.
    single_precision : bool
        Whether coordinates are float32.
    local_origin : bool
        Whether coordinates may be relative to a point, ``write``'s third argument.
    write_parts : callable, optional
        Writes several meshes, by their names, to one file.
    """

    write: Callable[..., None]
    bytes_per_triangle: int
    single_precision: bool = False
    local_origin: bool = False
    write_parts: Callable[..., None] | None = None


FORMATS = {
    ".ply": MeshFormat(write_ply, 19),
    ".stl": MeshFormat(write_stl, 50, single_precision=True),
    ".obj": MeshFormat(write_obj, 40),
    ".off": MeshFormat(write_off, 39),
    ".glb": MeshFormat(
        write_glb, 18, single_precision=True, local_origin=True, write_parts=write_glb_parts
    ),
    ".3mf": MeshFormat(write_3mf, 13, write_parts=write_3mf_parts),
}
MESH_SUFFIXES = tuple(FORMATS)


def format_of(path: str | Path) -> MeshFormat:
    """Return the format of a mesh file, whose suffix must be one of ``MESH_SUFFIXES``."""
    return FORMATS[Path(path).suffix.lower()]


def check_target(path: str | Path, *, force: bool = False) -> Path:
    """Return the path if a mesh file can be written there; called before the work starts.

    Raises
    ------
    OptionError
        If the suffix is not that of a mesh format.
    FileError
        If the file exists and ``force`` is not set, or the folder cannot be written to.
    """
    check_mesh_suffix(Path(path))
    return check_free(Path(path), force=force)


def check_mesh_suffix(path: Path) -> None:
    """Raise OptionError if the suffix is not that of a mesh format."""
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise OptionError(f"{path} is not a mesh file: give one of {', '.join(MESH_SUFFIXES)}")


def write_mesh(mesh: Mesh, path: str | Path, *, force: bool = False) -> None:
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

    Raises
    ------
    OptionError
        If the suffix is unknown.
    FileError
        If the file exists and ``force`` is not set, or cannot be written; or if the format cannot
        hold the mesh: a coordinate is not finite, or corners of a triangle would coincide.
    """
    check_mesh(mesh)
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
    """Write a mesh that comes in pieces; triangles may use the vertices of earlier pieces.

    Like ``write_mesh``, without checking that the format can hold the mesh: see
    ``precision.check_format_holds``.

    Parameters
    ----------
    pieces : iterable of Mesh
        The pieces, in world units.
    path : path
        The file.
    force : bool
        Replace an existing file.
    about : three floats
        The local origin of the vertices, for formats that have one.
    before_rename : callable, optional
        Called with the path of the complete file before it is renamed to ``path``.
    """
    path = check_target(path, force=force)
    mesh_format = format_of(path)
    with replacing(path, force=force, before_rename=before_rename) as part:
        if mesh_format.local_origin:
            mesh_format.write(pieces, part, about)
        else:
            mesh_format.write(pieces, part)


def write_together(
    meshes: Mapping[Path, Mapping[str, Iterable[Mesh]]],
    *,
    force: bool = False,
    about: Triple = WORLD_ORIGIN,
) -> None:
    """Write files of meshes in pieces, by path and name: all of them, or none.

    A file of several meshes must have a format with parts. Otherwise as ``write_pieces``.
    """
    with ExitStack() as files:
        for path, named in meshes.items():
            part = files.enter_context(replacing(check_target(path, force=force), force=force))
            mesh_format = format_of(path)
            origin = (about,) if mesh_format.local_origin else ()
            if mesh_format.write_parts:
                mesh_format.write_parts(named, part, *origin)
                continue
            for pieces in named.values():
                mesh_format.write(pieces, part, *origin)
        for path in meshes:
            check_target(path, force=force)  # before the first of them appears


def _local_origin(mesh: Mesh, path: Path) -> Triple:
    """Return the local origin for a mesh in a file: the middle of its bounding box if needed."""
    wide = mesh.vertices.dtype == np.float64 and len(mesh.vertices)
    if not format_of(path).local_origin or not wide:
        return WORLD_ORIGIN
    x, y, z = mesh.vertices.min(0) / 2 + mesh.vertices.max(0) / 2
    return float(x), float(y), float(z)


def _check_mesh_holds(mesh: Mesh, path: Path, about: Triple) -> None:
    """Raise FileError if coordinates are not finite, or too close together for the format."""
    if not np.isfinite(mesh.vertices).all():
        raise FileError(f"{path} cannot be written: a vertex of the mesh is not finite")
    if not format_of(path).single_precision or mesh.vertices.dtype == np.float32:
        return
    with np.errstate(over="ignore"):
        rounded = (mesh.vertices - about).astype(np.float32)
    lost = not np.isfinite(rounded).all() or any(
        _flat_triangles(rounded[rows]) > _flat_triangles(mesh.vertices[rows])
        for rows in np.array_split(mesh.faces, len(mesh.faces) // CHUNK + 1)
    )
    if lost:
        raise FileError(
            f"{path} cannot be written: {path.suffix} has single precision, in which vertices of "
            "this mesh coincide; write .ply or .obj"
        )


def _flat_triangles(corners: NDArray[Any]) -> int:
    """Count the triangles, (n, 3, 3), with two equal corners."""
    same = (corners == np.roll(corners, 1, axis=1)).all(2).any(1)
    return int(np.count_nonzero(same))
