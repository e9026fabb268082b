"""Meshes to files. A target is checked before the work starts, and its file appears whole.

``.ply`` by our own ``ply``; ``.stl .obj .off .glb .3mf`` by trimesh, which wants two more packages
for the last (extra ``3mf``).
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path

from ..errors import FileError, OptionError, OptionTypeError, seen
from ..mesh import Mesh, join_meshes
from ..options import check_path
from .output import check_free, replacing
from .ply import write_ply

MESH_SUFFIXES = (".ply", ".stl", ".obj", ".off", ".glb", ".3mf")
NEEDED_FOR_3MF = ("lxml", "networkx")


def check_target(path: str | Path, *, force: bool = False) -> Path:
    """Return the path of a mesh file to be if it can be written; asked before the work starts."""
    check_mesh_suffix(Path(path))
    return check_free(Path(path), force=force)


def check_mesh_suffix(path: Path) -> None:
    """Raise if the suffix is no mesh file's, or if what writes such files is not installed."""
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise OptionError(f"{path} is no mesh file: give one of {', '.join(MESH_SUFFIXES)}")
    if path.suffix.lower() == ".3mf" and not all(map(find_spec, NEEDED_FOR_3MF)):
        needed = " and ".join(NEEDED_FOR_3MF)
        raise FileError(f"writing .3mf needs {needed}: pip install 'super-sdf[3mf]'")


def write_mesh(mesh: Mesh, path: str | Path, *, force: bool = False) -> None:
    """Write a mesh; the suffix tells the format.

    Raises
    ------
    OptionError
        If the suffix is unknown.
    FileError
        If the file exists and ``force`` is not set, or cannot be written.
    """
    if not isinstance(mesh, Mesh):
        raise OptionTypeError(f"mesh is {seen(mesh)}: give one from reconstruct(grid)")
    check_path(path, "path")
    write_pieces([mesh], path, force=force)


def write_pieces(pieces: Iterable[Mesh], path: str | Path, *, force: bool = False) -> None:
    """Write a mesh that comes in pieces, whose triangles use the vertices of all pieces so far.

    To a ``.ply`` file each piece is written as it comes; for other formats all are kept until the
    last. Otherwise as ``write_mesh``.
    """
    path = check_target(path, force=force)
    with replacing(path) as part:
        if path.suffix.lower() == ".ply":
            write_ply(pieces, part)
        else:
            _write_by_trimesh(join_meshes(list(pieces)), part, path.suffix.lower()[1:])


def _write_by_trimesh(mesh: Mesh, path: Path, file_type: str) -> None:
    """Write one of trimesh's formats."""
    import trimesh

    copy = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    copy.export(path, file_type=file_type)
