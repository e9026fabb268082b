"""Writing mesh files. A target is checked before the work starts, and only complete files appear.

``FORMATS`` is the table of formats: a new one is a row there, and its writer. All write a mesh
piece by piece and hold no more than one piece in memory.

Neighbouring vertices may be as close as a thousandth of the fine spacing. Far from the world origin
float32 cannot resolve that and vertices would coincide: degenerate triangles, and a mesh that is no
longer closed when a program reads it. So it is checked whether the numbers of a format can hold a
mesh.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import Triple
from ..errors import FileError, OptionError
from ..grid.placement import as_triple
from ..grid.sdf_grid import SdfGrid
from ..mesh import CLEARANCE, Mesh, check_mesh, tells_vertices_apart, vertex_type
from ..options import check_path
from .output import check_free, replacing
from .plain_meshes import write_obj, write_off, write_ply, write_stl
from .scenes import write_3mf, write_glb

WORLD_ORIGIN = (0.0, 0.0, 0.0)
CHUNK = 1 << 16  # triangles checked at a time


class MeshFormat(NamedTuple):
    """A mesh file format.

    ``write`` writes pieces of a mesh to a path; of a format that ``has_parts``, several meshes by
    their names.
    """

    write: Callable[..., None]
    bytes_per_triangle: int  # with its half of a vertex; approximate for text and archives
    single_precision: bool = False  # whether coordinates are float32
    local_origin: bool = False  # whether coordinates may be relative to a point
    has_parts: bool = False

    def write_named(
        self, named: Mapping[str, Iterable[Mesh]], path: Path, about: Triple = WORLD_ORIGIN
    ) -> None:
        """Write meshes in pieces by their names, one if the format has no parts."""
        origin = (about,) if self.local_origin else ()
        for pieces in [named] if self.has_parts else named.values():
            self.write(pieces, path, *origin)


FORMATS = {
    ".ply": MeshFormat(write_ply, 19),
    ".stl": MeshFormat(write_stl, 50, single_precision=True),
    ".obj": MeshFormat(write_obj, 40),
    ".off": MeshFormat(write_off, 39),
    ".glb": MeshFormat(write_glb, 18, single_precision=True, local_origin=True, has_parts=True),
    ".3mf": MeshFormat(write_3mf, 13, has_parts=True),
}
MESH_SUFFIXES = tuple(FORMATS)


def format_of(path: str | Path) -> MeshFormat:
    """Return the format of a mesh file, whose suffix must be one of ``MESH_SUFFIXES``."""
    return FORMATS[Path(path).suffix.lower()]


def check_target(path: str | Path, *, force: bool = False) -> Path:
    """Return the path if a mesh file can be written there; called before the work starts."""
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
    ``check_format_holds``. ``about`` is the local origin of the vertices, for formats that have
    one. ``before_rename`` is called with the path of the complete file before it is renamed.
    """
    path = check_target(path, force=force)
    with replacing(path, force=force, before_rename=before_rename) as part:
        format_of(path).write_named({"": pieces}, part, about)


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
            format_of(path).write_named(named, part, about)
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
    same = (corners == np.roll(corners, 1, axis=1)).all(2).any(1)
    return int(np.count_nonzero(same))


def check_format_holds(path: str | Path, grid: SdfGrid, factor: int) -> Triple:
    """Return the local origin for the vertices of a mesh file.

    It is the world origin, or the middle of the grid if float32 resolves neighbouring vertices only
    there and the format can store a local origin. Formats with double precision or text hold all
    that ``mesh.vertex_type`` accepts. Raises FileError if the format does not resolve neighbouring
    vertices, whatever the local origin, and GridError if not even float64 does.
    """
    mesh_format = format_of(path)
    if vertex_type(grid, factor) is np.float32 or not mesh_format.single_precision:
        return WORLD_ORIGIN
    reach = grid.reach
    if mesh_format.local_origin:
        sides = np.array(grid.spacing) * grid.shape / 2  # from its middle on
        reach = float((np.abs(grid.direction) @ sides).max())
        if tells_vertices_apart(np.float32, reach, grid, factor):
            return as_triple(grid.to_world((np.array(grid.shape) - 1) / 2), "middle")
    apart, suffix = CLEARANCE * grid.voxel_size / factor, Path(path).suffix.lower()
    limits = np.finfo(np.float32)
    step = max(math.ulp(reach) * 2**29, float(limits.smallest_subnormal))  # 29 bits fewer
    limit = f"in steps of {step:.2g} at {reach:.6g}"
    if reach > float(limits.max):
        limit = f"numbers up to {limits.max:.2g}, the mesh reaches {reach:.2g}"
    raise FileError(
        f"{path} cannot hold the mesh: {suffix} has single precision, {limit}, and vertices are "
        f"down to {apart:.2g} apart; write .ply or .obj"
    )


def local_origin_note(path: str | Path, about: Triple) -> tuple[str, ...]:
    """Return a note that names the local origin of a file, none if it is the world origin."""
    if about == WORLD_ORIGIN:
        return ()
    point = ", ".join(f"{coordinate:.12g}" for coordinate in about)
    return (
        f"{path} has single precision: its vertices are relative to {point}, "
        "the translation of its node",
    )
