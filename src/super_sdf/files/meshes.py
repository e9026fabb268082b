"""Mesh files: a target is checked before the work starts, and only complete files appear.

Far from the world origin float32 cannot tell neighbouring vertices apart: degenerate triangles, and
a mesh that is no longer closed when a program reads it. So it is checked whether the numbers of a
format can hold a mesh. Text has enough digits to read back the same numbers: trimesh, which makes
the .glb, writes .obj and .off with fixed decimals, and .3mf in millimetres alone, without colours.

A new format is a name in ``options.MESH_FORMATS`` and a function ``write_NAME`` in ``WRITERS``.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, TypeAlias
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray, length, unit as of_length_1
from ..errors import FileError, OptionError
from ..options import LENGTHS, MESH_FORMATS, OPTIONS, PATH, Unit
from ..surface.mesh import Mesh, check_mesh
from .formats import plugin
from .output import check_free, replacing

MESH_SUFFIXES = tuple(f".{name}" for name in MESH_FORMATS)
SCENES = (".glb", ".3mf")  # have parts with names and colours, and a unit
MOST_ROUNDED = 0.01  # sides of the triangles by which rounding may move a vertex
STL_CHUNK = 1 << 18  # triangles at a time
STL_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
PLY_TYPES = {"<f4": "float", "<f8": "double"}
PLY_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
TEXT_CHUNK = 1 << 14  # rows of text at a time: Python numbers take ten times the memory

Colour: TypeAlias = tuple[int, int, int]
"""Red, green and blue, from 0 to 255."""
Parts: TypeAlias = Mapping[str, Mesh]
"""Meshes by their names; a mesh alone has the name ""."""


@dataclass(frozen=True)
class World:
    """What a file says of its meshes."""

    unit: str | None = None
    space: str | None = None  # anatomical: RAS or LPS
    colours: Mapping[str, Colour] = field(default_factory=dict)  # of some parts, by name

    @property
    def note(self) -> str:
        """Where 3D Slicer looks for the space of a mesh: a word in a header."""
        return f"SPACE={self.space}" if self.space else ""


def has_parts(path: str | Path) -> bool:
    """Return whether the format of a mesh file has parts with names and colours, and a unit."""
    return Path(path).suffix.lower() in SCENES


def check_mesh_suffix(path: Path) -> Path:
    """Return the path of a mesh file; OptionError for another suffix."""
    if path.suffix.lower() not in MESH_SUFFIXES and not plugin("writers", path.suffix):
        raise OptionError(f"{path} is not a mesh file: give one of {', '.join(MESH_SUFFIXES)}")
    return path


def write_mesh(
    mesh: Mesh,
    path: str | Path,
    *,
    force: bool = False,
    unit: Unit | None = None,
    space: str | None = None,
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
        Unit of the world: um, mm, cm, m, in or ft. Only .3mf (default mm) and .glb (default m)
        state a unit.
    space : str, optional
        The anatomical space of the coordinates, "RAS" or "LPS", such as ``grid.space``, written
        into the header of a .ply, .stl or .obj, which 3D Slicer reads.

    Raises
    ------
    OptionError, MeshError, FileError
        If the suffix is unknown; if the arrays are invalid, or a coordinate is not finite; if the
        file cannot be written, or its single precision would move vertices too far.
    """
    world = World(OPTIONS["unit"].check(unit), OPTIONS["space"].check(space))
    path = check_free(check_mesh_suffix(PATH.check(path, "path")), force=force)
    write_meshes({path: {"": mesh}}, force=force, world=world)


def write_meshes(
    files: Mapping[Path, Parts], *, force: bool = False, world: World | None = None
) -> None:
    """Write files of meshes, by path and name: all of them, or none."""
    with ExitStack() as stack:
        for path, parts in files.items():
            for mesh in parts.values():
                check_mesh(mesh)
            with stack.enter_context(replacing(path, force=force)).open("wb") as file:
                if (ending := path.suffix.lower()) in WRITERS:
                    WRITERS[ending](file, parts, world or World())
                else:
                    plugin("writers", ending).load()(file, *parts.values())
        for path in files:
            check_free(path, force=force)  # before the first of them appears


def _as_single(mesh: Mesh, origin: Any = 0.0) -> FloatArray:
    """Return vertices, relative to an origin, as float32; FileError if it cannot hold the mesh."""
    if mesh.vertices.dtype == np.float32 and not np.any(origin):
        return np.asarray(mesh.vertices)
    exact = mesh.vertices.astype(np.float64) - origin
    with np.errstate(over="ignore"):
        rounded = exact.astype(np.float32)
    off = float(np.abs(rounded - exact).max(initial=0))
    corners = (points[mesh.faces] for points in (rounded, exact))
    now, then = (length(at - np.roll(at, 1, axis=1)) for at in corners)
    if off > MOST_ROUNDED * then.mean() or ((now == 0) & (then > 0)).any():
        said = f"the format has single precision, which moves vertices by up to {off:.3g}"
        raise FileError(f"{said}: write .ply or .obj")
    return np.asarray(rounded)


def write_ply(file: IO[bytes], parts: Parts, world: World) -> None:
    """Write binary little-endian PLY."""
    (mesh,) = parts.values()
    kind, faces = mesh.vertices.dtype.newbyteorder("<"), mesh.faces
    rows = np.ascontiguousarray(mesh.vertices.astype(kind, copy=False))
    triangles = np.empty(len(faces), PLY_FACE)
    triangles["count"], triangles["corners"] = 3, faces
    header = ["ply", "format binary_little_endian 1.0", "comment made by super-sdf"]
    header += [f"comment {world.note}"] * bool(world.note) + [f"element vertex {len(rows)}"]
    header += [f"property {PLY_TYPES[kind.str]} {axis}" for axis in "xyz"]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    file.write("\n".join([*header, ""]).encode("ascii"))
    file.write(rows.data)
    file.write(triangles.data)


def write_stl(file: IO[bytes], parts: Parts, world: World) -> None:
    """Write binary STL: each triangle stores its normal and the positions of its corners."""
    (mesh,) = parts.values()
    vertices = _as_single(mesh)
    file.write(f"made by super-sdf {world.note}".ljust(80).encode("ascii"))
    file.write(struct.pack("<I", len(mesh.faces)))
    for first in range(0, len(mesh.faces), STL_CHUNK):
        corners = vertices[mesh.faces[first : first + STL_CHUNK]]
        sides = corners[:, 1:].astype(np.float64) - corners[:, :1]
        rows = np.zeros(len(corners), STL_ROW)
        rows["normal"], rows["corners"] = of_length_1(np.cross(sides[:, 0], sides[:, 1])), corners
        file.write(rows.data)


def write_obj(file: IO[bytes], parts: Parts, world: World) -> None:
    """Write Wavefront OBJ, whose vertex indices start at 1."""
    (mesh,) = parts.values()
    file.write(f"# made by super-sdf {world.note}".rstrip().encode("ascii") + b"\n")
    file.writelines(_lines("v %s %s %s\n", mesh.vertices))
    file.writelines(_lines("f %d %d %d\n", mesh.faces, first=1))


def write_off(file: IO[bytes], parts: Parts, world: World) -> None:
    """Write OFF."""
    (mesh,) = parts.values()
    file.write(f"OFF\n{len(mesh.vertices)} {len(mesh.faces)} 0\n".encode("ascii"))
    file.writelines(_lines("%s %s %s\n", mesh.vertices))
    file.writelines(_lines("3 %d %d %d\n", mesh.faces))


def _lines(line: str, rows: NDArray[Any], first: int = 0) -> Iterator[bytes]:
    """Yield rows as text, which reads back as the same numbers; indices count from ``first``."""
    line = line.replace("%s", "%r" if rows.dtype == np.float64 else "%.9g")
    for start in range(0, len(rows), TEXT_CHUNK):
        some = rows[start : start + TEXT_CHUNK]
        if first:  # the last index may exceed 32 bits
            some = some.astype(np.int64) + first
        yield ((line * len(some)) % tuple(some.ravel().tolist())).encode("ascii")


def write_glb(file: IO[bytes], parts: Parts, world: World) -> None:
    """Write binary glTF, whose unit is the metre: a node for each part, which moves it there."""
    import trimesh

    library: Any = trimesh  # parts of it have no types
    meshes, metres, middle = list(parts.values()), LENGTHS[world.unit or "m"], np.zeros(3)
    if not all(len(mesh.faces) for mesh in meshes):
        raise FileError("a mesh without triangles cannot be .glb: give .ply")
    if meshes[0].vertices.dtype != np.float32:
        ends = np.array([(mesh.vertices.min(0), mesh.vertices.max(0)) for mesh in meshes])
        middle = ends[:, 0].min(0) / 2 + ends[:, 1].max(0) / 2
    place = np.diag([metres, metres, metres, 1.0])
    place[:3, 3] = metres * middle
    scene = library.Scene()
    for name, mesh in parts.items():
        shown = None
        if colour := world.colours.get(name):
            rgb = np.array(colour) / 255  # of sRGB; a factor of glTF is linear
            rgb = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
            factor = np.rint(255 * np.array([*rgb, 1])).astype(np.uint8)
            look = {"baseColorFactor": factor, "metallicFactor": 0}
            material = library.visual.material.PBRMaterial(name, **look)
            shown = library.visual.TextureVisuals(material=material)
        vertices = _as_single(mesh, middle)
        part = library.Trimesh(vertices, mesh.faces, process=False, visual=shown)
        scene.add_geometry(part, name or "mesh", name or "mesh", transform=place)
    file.write(scene.export(file_type="glb", include_normals=False))


HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'
SCHEMAS = "http://schemas.openxmlformats.org/package/2006"
MICROSOFT = "http://schemas.microsoft.com/3dmanufacturing"
KIND = '<Default Extension="{}" ContentType="application/vnd.{}+xml"/>'.format
MEMBERS = {
    "[Content_Types].xml": f'<Types xmlns="{SCHEMAS}/content-types">'
    + KIND("rels", "openxmlformats-package.relationships")
    + KIND("model", "ms-package.3dmanufacturing-3dmodel")
    + "</Types>\n",
    "_rels/.rels": f'<Relationships xmlns="{SCHEMAS}/relationships"><Relationship '
    f'Target="/3D/3dmodel.model" Id="rel0" Type="{MICROSOFT}/2013/01/3dmodel"/></Relationships>\n',
}
MODEL = f'<model unit="{{}}" xml:lang="en-US" xmlns="{MICROSOFT}/core/2015/02">\n<resources>'
UNITS = {"um": "micron", "mm": "millimeter", "cm": "centimeter", "m": "meter", "in": "inch",
         "ft": "foot"}  # fmt: skip
COMPRESSION = 1  # the fastest level: higher ones save a tenth and take three times as long


def write_3mf(target: IO[bytes], parts: Parts, world: World) -> None:
    """Write 3MF, an object for each part; members have no date: a mesh gives the same bytes."""
    import html  # imported here, as few meshes need it

    with ZipFile(target, "w", ZIP_DEFLATED, compresslevel=COMPRESSION) as archive:
        for member, text in MEMBERS.items():
            with archive.open(member, "w") as file:
                file.write((HEAD + text).encode("ascii"))
        with archive.open("3D/3dmodel.model", "w", force_zip64=True) as file:
            file.write((HEAD + MODEL.format(UNITS[world.unit or "mm"])).encode("ascii"))
            for number, (name, mesh) in enumerate(parts.items(), 1):
                quoted, shown = f'"{html.escape(name)}"', ""
                named = f" name={quoted}" if name else ""
                if name in world.colours:
                    colour = "#{:02X}{:02X}{:02X}".format(*world.colours[name])
                    material = len(parts) + number
                    shown = f'<basematerials id="{material}"><base name={quoted} '
                    shown += f'displaycolor="{colour}"/></basematerials>'
                    named += f' pid="{material}" pindex="0"'
                shown += f'<object id="{number}"{named} type="model"><mesh><vertices>\n'
                file.write(shown.encode("utf-8"))
                file.writelines(_lines('<vertex x="%s" y="%s" z="%s"/>\n', mesh.vertices))
                file.write(b"</vertices><triangles>\n")
                file.writelines(_lines('<triangle v1="%d" v2="%d" v3="%d"/>\n', mesh.faces))
                file.write(b"</triangles></mesh></object>")
            items = "".join(f'<item objectid="{n}"/>' for n in range(1, len(parts) + 1))
            file.write(f"</resources><build>{items}</build></model>\n".encode("ascii"))


WRITERS: dict[str, Callable[[IO[bytes], Parts, World], None]] = {
    **{".ply": write_ply, ".stl": write_stl, ".obj": write_obj},
    **{".off": write_off, ".glb": write_glb, ".3mf": write_3mf},
}
"""What writes meshes by their names (those without parts: the only one) to a file, by suffix."""
