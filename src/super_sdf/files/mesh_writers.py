"""The writers of mesh files: PLY, STL, OBJ, OFF, binary glTF and 3MF.

Each writes meshes by their names (formats without parts: the only one) to a path, with what the
file says of them, a ``World``. Text has enough digits to read back the same numbers.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, TypeAlias
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray, Triple
from ..errors import FileError
from ..options import LENGTHS
from ..surface.mesh import Mesh
from .output import replacing

TEXT_CHUNK = 1 << 14  # rows of text at a time: Python numbers take ten times the memory
STL_CHUNK = 1 << 18  # triangles at a time
STL_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
PLY_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
PLY_HEADER_BYTES = 320  # padded, so that arrays of numbers can be mapped

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
    origin: Triple = (0.0, 0.0, 0.0)  # of the coordinates in the file

    @property
    def note(self) -> str:
        """Where 3D Slicer looks for the space of a mesh: a word in a header."""
        return f"SPACE={self.space}" if self.space else ""


def write_ply(parts: Parts, path: Path, world: World) -> None:
    """Write binary little-endian PLY."""
    (mesh,) = parts.values()
    kind = "double" if mesh.vertices.dtype == np.float64 else "float"
    with path.open("wb") as file:
        properties = [f"{kind} {axis}" for axis in "xyz"]
        _write_ply(file, mesh.vertices, mesh.faces, properties, world.note, PLY_HEADER_BYTES)


def write_coloured_ply(
    mesh: Mesh,
    residuals: FloatArray,
    colours: NDArray[np.uint8],
    path: Path,
    *,
    force: bool = False,
) -> None:
    """Write binary PLY whose vertices also have ``residuals`` (n,) and ``colours`` (n, 3).

    Positions are written as double. The file is complete or not at all; ``force`` replaces one
    that exists.
    """
    kind = [("position", "<f8", 3), ("residual", "<f4"), ("colour", "u1", 3)]
    rows = np.empty(len(residuals), kind)
    rows["position"], rows["residual"], rows["colour"] = mesh.vertices, residuals, colours
    properties = [*(f"double {axis}" for axis in "xyz"), "float residual"]
    properties += [f"uchar {colour}" for colour in ("red", "green", "blue")]
    note = "residual: distance of samples to the mesh minus their value, in voxels"
    with replacing(path, force=force) as part, part.open("wb") as file:
        _write_ply(file, rows, mesh.faces, properties, note)


def _write_ply(
    file: IO[bytes],
    vertices: NDArray[Any],
    faces: NDArray[Any],
    properties: list[str],
    note: str,
    header_bytes: int = 0,
) -> None:
    """Write rows of vertices, triangles, and before them a header whose comment is padded."""
    first = "ply\nformat binary_little_endian 1.0\ncomment made by super-sdf"
    first += f"\ncomment {note}" * bool(note)
    of_vertices = "".join(f"property {each}\n" for each in properties)
    rest = f"\nelement vertex {len(vertices)}\n{of_vertices}element face {len(faces)}\n"
    rest += "property list uchar int vertex_indices\nend_header\n"
    file.write((first.ljust(header_bytes - len(rest)) + rest).encode("ascii"))
    little = vertices.astype(vertices.dtype.newbyteorder("<"), copy=False)
    file.write(np.ascontiguousarray(little).data)
    rows = np.empty(len(faces), PLY_FACE)
    rows["count"], rows["corners"] = 3, faces
    file.write(rows.data)


def write_stl(parts: Parts, path: Path, world: World) -> None:
    """Write binary STL: each triangle stores its normal and the positions of its corners."""
    (mesh,) = parts.values()
    vertices = mesh.vertices.astype(np.float32, copy=False)
    with path.open("wb") as file:
        file.write(f"made by super-sdf {world.note}".ljust(80).encode("ascii"))
        file.write(struct.pack("<I", len(mesh.faces)))
        for first in range(0, len(mesh.faces), STL_CHUNK):
            corners = vertices[mesh.faces[first : first + STL_CHUNK]]
            rows = np.zeros(len(corners), STL_ROW)
            rows["normal"], rows["corners"] = _normals(corners), corners
            file.write(rows.data)


def _normals(corners: FloatArray) -> NDArray[np.float64]:
    """Return the unit normals of triangles (m, 3, 3), at any scale; 0 if they have no area."""
    least = np.finfo(np.float64).tiny
    sides = corners[:, 1:].astype(np.float64) - corners[:, :1]
    sides /= np.maximum(np.abs(sides).max((1, 2), keepdims=True), least)
    normals = np.cross(sides[:, 0], sides[:, 1])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), least)
    return normals


def write_obj(parts: Parts, path: Path, world: World) -> None:
    """Write Wavefront OBJ, whose vertex indices start at 1."""
    (mesh,) = parts.values()
    with path.open("wb") as file:
        file.write(f"# made by super-sdf {world.note}".rstrip().encode("ascii") + b"\n")
        file.writelines(_lines("v %s %s %s\n", mesh.vertices))
        file.writelines(_lines("f %d %d %d\n", mesh.faces, first=1))


def write_off(parts: Parts, path: Path, world: World) -> None:
    """Write OFF."""
    (mesh,) = parts.values()
    with path.open("wb") as file:
        file.write(f"OFF\n{len(mesh.vertices)} {len(mesh.faces)} 0\n".encode("ascii"))
        file.writelines(_lines("%s %s %s\n", mesh.vertices))
        file.writelines(_lines("3 %d %d %d\n", mesh.faces))


def _lines(line: str, rows: NDArray[Any], first: int = 0) -> Iterator[bytes]:
    """Yield rows as text; indices count from ``first``.

    9 digits identify every float32; of float64 it is the shortest text that reads back the same.
    """
    line = line.replace("%s", "%r" if rows.dtype == np.float64 else "%.9g")
    for start in range(0, len(rows), TEXT_CHUNK):
        some = rows[start : start + TEXT_CHUNK]
        if first:  # the last index may exceed 32 bits
            some = some.astype(np.int64) + first
        yield ((line * len(some)) % tuple(some.ravel().tolist())).encode("ascii")


GLB_MOST_BYTES = 2**32 - 1  # the length in the header has 32 bits
FLOAT, UNSIGNED_INT, VERTICES, INDICES = 5126, 5125, 34962, 34963  # constants of glTF


def write_glb(parts: Parts, path: Path, world: World) -> None:
    """Write binary glTF, a node for each part.

    Vertices are float32, relative to ``world.origin``; the nodes move them there, and scale them
    from the unit to metres, those of glTF. FileError if a mesh has no triangle, which glTF does not
    allow, or the file exceeds 4.29 GB.
    """
    metres = LENGTHS[world.unit or "m"]
    place = {"translation": [metres * x for x in world.origin]} if any(world.origin) else {}
    place |= {"scale": [metres] * 3} if metres != 1 else {}
    scene: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "super-sdf"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(parts)))}],
        **{key: [] for key in ("nodes", "meshes", "accessors", "bufferViews")},
    }
    arrays: list[NDArray[Any]] = []
    length = 0
    for number, (name, mesh) in enumerate(parts.items()):
        if not len(mesh.faces):
            raise FileError("a mesh without triangles cannot be .glb: give .ply")
        named = {"name": name} if name else {}
        primitive = {"attributes": {"POSITION": 2 * number}, "indices": 2 * number + 1}
        if colour := world.colours.get(name):
            materials = scene.setdefault("materials", [])
            primitive["material"] = len(materials)
            shown = {"baseColorFactor": [*map(linear, colour), 1], "metallicFactor": 0}
            materials.append({**named, "pbrMetallicRoughness": shown})
        scene["nodes"].append({"mesh": number, **named, **place})
        scene["meshes"].append({"primitives": [primitive], **named})
        vertices = mesh.vertices - np.array(world.origin) if any(world.origin) else mesh.vertices
        vertices = vertices.astype("<f4")
        ends = {"min": vertices.min(0).tolist(), "max": vertices.max(0).tolist()}
        positions = {"componentType": FLOAT, "type": "VEC3", "count": len(vertices), **ends}
        corners = {"componentType": UNSIGNED_INT, "type": "SCALAR", "count": mesh.faces.size}
        for array, described, target in (
            (vertices, positions, VERTICES),
            (mesh.faces.astype("<u4"), corners, INDICES),
        ):
            scene["accessors"].append({"bufferView": len(arrays), **described})
            view = {"buffer": 0, "byteOffset": length, "byteLength": array.nbytes}
            scene["bufferViews"].append({**view, "target": target})
            arrays.append(array)
            length += array.nbytes
    scene["buffers"] = [{"byteLength": length}]
    text = json.dumps(scene, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + length
    if total > GLB_MOST_BYTES:
        raise FileError(f"the mesh takes {total:,} bytes, .glb holds 4,294,967,295: give .ply")
    with path.open("wb") as file:
        file.write(struct.pack("<4sIII4s", b"glTF", 2, total, len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", length, b"BIN\0"))
        for array in arrays:
            file.write(np.ascontiguousarray(array).data)


def linear(level: int) -> float:
    """Return a level of an sRGB colour, 0 to 255, as glTF has it, from 0 to 1."""
    share = level / 255
    return share / 12.92 if share <= 0.04045 else float(((share + 0.055) / 1.055) ** 2.4)


HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'
TYPES = (
    '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="rels" '
    'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" '
    'ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>\n'
)
RELATIONS = (
    '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Target="/3D/3dmodel.model" Id="rel0" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>\n'
)
MODEL = (
    '<model unit="{}" xml:lang="en-US" '
    'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">\n<resources>'
)
UNITS = {"um": "micron", "mm": "millimeter", "cm": "centimeter", "m": "meter", "in": "inch",
         "ft": "foot"}  # fmt: skip
COMPRESSION = 1  # the fastest level: higher ones save a tenth and take three times as long


def write_3mf(parts: Parts, path: Path, world: World) -> None:
    """Write 3MF, an object for each part, in a unit or the format's default, the millimetre.

    Members opened by name have no date, so the same mesh always gives the same file.
    """
    from html import escape  # imported here, as few need it

    with ZipFile(path, "w", ZIP_DEFLATED, compresslevel=COMPRESSION) as archive:
        for member, text in (("[Content_Types].xml", TYPES), ("_rels/.rels", RELATIONS)):
            with archive.open(member, "w") as file:
                file.write((HEAD + text).encode("ascii"))
        with archive.open("3D/3dmodel.model", "w", force_zip64=True) as file:
            file.write((HEAD + MODEL.format(UNITS[world.unit or "mm"])).encode("ascii"))
            for number, (name, mesh) in enumerate(parts.items(), 1):
                quoted, shown = f'"{escape(name)}"', ""
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
