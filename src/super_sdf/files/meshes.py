"""Mesh files: the table of formats, checks of a target, and the expected size of a file.

A target is checked before the work starts, and only complete files appear. A new format is a row of
``FORMATS``, and its writer.

Neighbouring vertices may be as close as a thousandth of the fine spacing. Far from the world origin
float32 cannot resolve that and vertices would coincide: degenerate triangles, and a mesh that is no
longer closed when a program reads it. So it is checked whether the numbers of a format can hold a
mesh.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, Triple
from ..errors import FileError, OptionError, WriteError
from ..grid.placement import as_triple
from ..grid.planes import in_blocks, over_planes
from ..grid.sdf_grid import SdfGrid, negated
from ..threads import in_words
from ..surface.mesh import CLEARANCE, Mesh, check_mesh, tells_vertices_apart, vertex_type
from ..options import Space, Unit, check_path, check_space, check_unit
from .mesh_writers import (NO_COLOURS, Colour, write_3mf, write_glb, write_obj, write_off, write_ply, write_stl)
from .output import check_free, free_space, replacing
from .volume import triple

WORLD_ORIGIN = (0.0, 0.0, 0.0)
CHUNK = 1 << 16  # triangles checked at a time


class World(NamedTuple):
    """What a file says of meshes: unit and anatomical space, if known, and colours by name."""

    unit: str | None = None
    space: str | None = None
    colours: Mapping[str, Colour] = NO_COLOURS


AS_IT_IS = World()


class MeshFormat(NamedTuple):
    """A mesh file format."""

    write: Callable[..., None]  # pieces of a mesh to a path; of parts, several meshes by name
    bytes_per_triangle: int  # with its half of a vertex; approximate for text and archives
    single_precision: bool = False  # whether coordinates are float32
    local_origin: bool = False  # whether coordinates may be relative to a point
    has_scene: bool = False  # whether it has parts with names and colours, and a unit
    has_note: bool = False  # whether 3D Slicer looks in the header for the space

    def write_named(
        self, named: Mapping[str, Iterable[Mesh]], path: Path, world: World, about: Triple
    ) -> None:
        """Write meshes in pieces by their names, one if the format has no parts."""
        stated: list[Any] = [world.unit, world.colours] if self.has_scene else []
        stated += [about] if self.local_origin else []
        stated += [f"SPACE={world.space}"] if self.has_note and world.space else []
        for pieces in [named] if self.has_scene else named.values():
            self.write(pieces, path, *stated)


FORMATS = {
    ".ply": MeshFormat(write_ply, 19, has_note=True),
    ".stl": MeshFormat(write_stl, 50, single_precision=True, has_note=True),
    ".obj": MeshFormat(write_obj, 40, has_note=True),
    ".off": MeshFormat(write_off, 39),
    ".glb": MeshFormat(write_glb, 18, single_precision=True, local_origin=True, has_scene=True),
    ".3mf": MeshFormat(write_3mf, 13, has_scene=True),
}
MESH_SUFFIXES = tuple(FORMATS)


def format_of(path: str | Path) -> MeshFormat:
    """Return the format of a mesh file, whose suffix must be one of ``MESH_SUFFIXES``."""
    return FORMATS[Path(path).suffix.lower()]


def check_target(path: str | Path, *, force: bool = False, unit: str | None = None) -> Path:
    """Return the path if a mesh file can be written there; called before the work starts."""
    check_mesh_suffix(Path(path), unit)
    return check_free(Path(path), force=force)


def check_mesh_suffix(path: Path, unit: str | None = None) -> None:
    """Raise OptionError if the suffix is not that of a mesh format, or of none that has a unit."""
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise OptionError(f"{path} is not a mesh file: give one of {', '.join(MESH_SUFFIXES)}")
    if unit and not format_of(path).has_scene:
        stating = " or ".join(suffix for suffix, kind in FORMATS.items() if kind.has_scene)
        raise OptionError(f"unit is {unit}: {path} can state none, give {stating}, or no unit")


def write_mesh(
    mesh: Mesh,
    path: str | Path,
    *,
    force: bool = False,
    unit: Unit | None = None,
    space: Space | None = None,
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

    Raises
    ------
    OptionError
        If the suffix is unknown, or that of a format that states no unit.
    FileError
        If the file exists and ``force`` is not set, or cannot be written; or if the format cannot
        hold the mesh: a coordinate is not finite, or corners of a triangle would coincide.
    """
    check_mesh(mesh)
    path = check_target(check_path(path, "path"), force=force, unit=check_unit(unit))
    about = WORLD_ORIGIN
    if format_of(path).local_origin and mesh.vertices.dtype == np.float64 and len(mesh.vertices):
        about = triple(mesh.vertices.min(0) / 2 + mesh.vertices.max(0) / 2)
    _check_mesh_holds(mesh, path, about)
    write_pieces([mesh], path, force=force, world=World(unit, check_space(space)), about=about)


def write_pieces(
    pieces: Iterable[Mesh],
    path: str | Path,
    *,
    force: bool = False,
    world: World = AS_IT_IS,
    about: Triple = WORLD_ORIGIN,
    before_rename: Callable[[Path], None] | None = None,
) -> None:
    """Write a mesh that comes in pieces; triangles may use the vertices of earlier pieces.

    ``check_format_holds`` says whether the format can hold it, and ``about``, its local origin.
    ``before_rename`` is called with the path of the complete file.
    """
    path = check_target(path, force=force, unit=world.unit)
    with replacing(path, force=force, before_rename=before_rename) as part:
        format_of(path).write_named({"": pieces}, part, world, about)


def write_together(
    meshes: Mapping[Path, Mapping[str, Iterable[Mesh]]],
    *,
    force: bool = False,
    world: World = AS_IT_IS,
    about: Triple = WORLD_ORIGIN,
    before_rename: Callable[[Mapping[Path, Path]], None] | None = None,
) -> None:
    """Write files of meshes in pieces, by path and name: all of them, or none.

    ``before_rename`` is called with all complete files, by the paths that they will have.
    """
    parts: dict[Path, Path] = {}
    with ExitStack() as files:
        for path, named in meshes.items():
            target = replacing(check_target(path, force=force), force=force)
            parts[path] = files.enter_context(target)
            format_of(path).write_named(named, parts[path], world, about)
        if before_rename:
            before_rename(parts)
        for path in meshes:
            check_target(path, force=force)  # before the first of them appears


def _check_mesh_holds(mesh: Mesh, path: Path, about: Triple) -> None:
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

    It is the middle of the grid if float32 resolves neighbouring vertices only there and the format
    can store it. Raises FileError if the format does not resolve them, whatever the local origin,
    and GridError if not even float64 does.
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


# The size of a mesh before the work, from the sign changes of the coarse samples. A surface of area
# A crosses 3/2 A / h^2 edges of a lattice of spacing h, averaged over its directions. So it crosses
# K^2 times as many edges of the fine lattice as of the coarse one. Each crossed edge holds one
# vertex, and a closed mesh has two triangles per vertex.

SMALL = 10_000_000  # bytes; smaller sizes are printed in full
LARGE = 200_000_000  # bytes of a file whose size is announced before the work
# The estimate is within 8 % of the truth, or too low where parts are thin: the file certainly takes
# half of it.
CERTAIN_SHARE = 0.5


@dataclass(frozen=True)
class Expectation:
    """The estimated number of triangles of a mesh, and the size of its file in bytes.

    ``by_plane``, (nx, 3) int64, has the edges along x, y and z that the surface crosses in each
    plane of samples; those along x are those to the plane before.
    """

    triangles: int
    size: int
    by_plane: NDArray[np.int64] | None = None

    def warning(self, path: str | Path) -> str | None:
        """Return a sentence that announces a large file, None for others."""
        if self.size < LARGE:
            return None
        return f"{path} will have about {_rounded(self.triangles):,} triangles, {_size(self.size)}"


def expect(
    grid: SdfGrid, factor: int, offset: float, path: str | Path, *, cap: bool = False
) -> Expectation:
    """Estimate the size of the mesh of a grid, and of its file; ``cap`` is as in ``reconstruct``.

    Raises WriteError if half of that is more than the free disk space.
    """
    by_plane = count_by_plane(grid, offset, cap=cap)
    triangles = 2 * factor**2 * round(count_on_lattice(grid, by_plane))
    size = triangles * format_of(path).bytes_per_triangle
    free = free_space(Path(path))
    if CERTAIN_SHARE * size > free:
        raise WriteError(
            f"{path} cannot be written: about {_rounded(triangles):,} triangles take "
            f"{_size(size)}, {_size(free)} are free there; use a smaller factor, or another "
            "folder"
        )
    return Expectation(triangles, size, by_plane)


def count_on_lattice(grid: SdfGrid, by_plane: NDArray[np.int64]) -> float:
    """Estimate how many edges of the lattice that is refined the offset surface crosses.

    Edges along an axis are as many as the cells of a plane across it.
    """
    counts: list[int] = by_plane.sum(0).tolist()
    if grid.is_cubic or grid.field.on_lattice:
        return sum(counts)
    h, cell = grid.voxel_size, math.prod(grid.spacing)
    return sum(count * cell / step / h**2 for count, step in zip(counts, grid.spacing))


def count_by_plane(grid: SdfGrid, offset: float, *, cap: bool = False) -> NDArray[np.int64]:
    """Count the edges with samples on different sides of the offset surface, (nx, 3).

    With ``cap``, all is outside beyond the border of the grid. See ``Expectation.by_plane``.
    """
    count = partial(_crossings_of, grid.positive_inside, offset, cap)
    ranges = [
        (max(first - 1, 0), last, first > 0, last == len(grid.samples))
        for first, last in in_blocks(grid.samples)
    ]
    return np.concatenate(list(over_planes(grid.samples, count, ranges)))


def _crossings_of(
    positive_inside: bool,
    offset: float,
    cap: bool,
    planes: NDArray[Any],
    has_before: bool,
    is_end: bool,
) -> NDArray[np.int64]:
    """Count crossed edges plane by plane, (n, 3); ``has_before``: the first is the one before."""
    with np.errstate(over="ignore"):  # an offset beyond float32 is beyond all values
        inside = (negated(planes) if positive_inside else planes) <= offset
    counted = inside[int(has_before) :]
    x, y, z = (
        _count(np.diff(part, axis=axis)) for axis, part in enumerate((inside, counted, counted))
    )
    if not has_before:
        x = np.concatenate([_count(inside[:1]) * cap, x])
    if cap:
        y += _count(counted[:, [0, -1]])
        z += _count(counted[:, :, [0, -1]])
        x[-1] += is_end * np.count_nonzero(counted[-1])
    return np.stack([x, y, z], axis=1)


def _count(marks: BoolArray) -> NDArray[np.int64]:
    return np.asarray(np.count_nonzero(marks, axis=(1, 2)))


def _rounded(count: int) -> int:
    return int(float(f"{count:.2g}"))


def _size(count: int) -> str:
    return in_words(count) if count >= SMALL else f"{count:,} bytes"
