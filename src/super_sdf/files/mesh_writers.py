"""The writers of mesh files: PLY, STL, OBJ, OFF, binary glTF and 3MF.

All write a mesh piece by piece, with a chunk of rows in memory at a time. Most formats need all
vertices before the first triangle, so triangles wait in a temporary file; headers with counts,
padded to a fixed length, are written last.
"""

from __future__ import annotations

import json
import mmap
import struct
import tempfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, NamedTuple, TypeAlias
from xml.sax.saxutils import quoteattr
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray, Triple
from ..errors import FileError
from ..surface.mesh import Mesh
from ..options import LENGTHS
from .output import append_spool, little_endian, replacing, spool_beside

CHUNK = 1 << 18  # rows written at a time
TEXT_CHUNK = 1 << 14  # rows of text at a time: Python numbers take ten times the memory
STL_CHUNK = 1 << 15  # triangles at a time
PLY_HEADER_BYTES, OFF_HEADER_BYTES = 320, 64
STL_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])

Colour: TypeAlias = tuple[int, int, int]
"""Red, green and blue, from 0 to 255."""
ToBytes: TypeAlias = Callable[[NDArray[Any]], bytes]
"""Converts rows of vertices or triangles to the bytes that are written."""


class Written(NamedTuple):
    """What was written of a mesh: how many vertices and triangles, of which type."""

    vertices: int
    faces: int
    dtype: np.dtype[Any]


def write_split(
    pieces: Iterable[Mesh],
    files: tuple[IO[bytes], IO[bytes]],
    to_bytes: tuple[ToBytes, ToBytes],
    chunk: int = 0,
) -> Written:
    """Write the vertices of all pieces to the first file and their triangles to the second."""
    vertices, faces, dtype = 0, 0, np.dtype(np.float32)
    for piece in pieces:
        _write_in_chunks(files[0], piece.vertices, to_bytes[0], chunk)
        _write_in_chunks(files[1], piece.faces, to_bytes[1], chunk)
        vertices, faces = vertices + len(piece.vertices), faces + len(piece.faces)
        dtype = piece.vertices.dtype
    return Written(vertices, faces, dtype)


def _write_in_chunks(
    file: IO[bytes], rows: NDArray[Any], to_bytes: ToBytes, chunk: int = 0
) -> None:
    step = chunk or CHUNK
    for start in range(0, len(rows), step):
        file.write(to_bytes(rows[start : start + step]))


# PLY


def write_ply(pieces: Iterable[Mesh], path: Path, note: str = "") -> None:
    """Write binary little-endian PLY, with a note in its header."""
    with path.open("wb") as file, spool_beside(path) as waiting:
        file.write(bytes(PLY_HEADER_BYTES))
        written = write_split(pieces, (file, waiting), (little_endian, _ply_rows))
        append_spool(waiting, file)
        number = "double" if written.dtype == np.float64 else "float"
        axes = [f"{number} {axis}" for axis in "xyz"]
        file.seek(0)
        counts, notes = (written.vertices, written.faces), [note] * bool(note)
        file.write(_ply_header(*counts, axes, *notes, size=PLY_HEADER_BYTES))


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
    kind = np.dtype([("position", "<f8", 3), ("residual", "<f4"), ("colour", "u1", 3)])
    numbers = [f"double {axis}" for axis in "xyz"]
    properties = [*numbers, "float residual", "uchar red", "uchar green", "uchar blue"]
    note = "residual: distance of samples to the mesh minus their value, in voxels"
    with replacing(path, force=force) as part, part.open("wb") as file:
        file.write(_ply_header(len(mesh.vertices), len(mesh.faces), properties, note))
        for first in range(0, len(mesh.vertices), CHUNK):
            chunk = slice(first, first + CHUNK)
            rows = np.empty(len(residuals[chunk]), kind)
            rows["position"], rows["residual"] = mesh.vertices[chunk], residuals[chunk]
            rows["colour"] = colours[chunk]
            file.write(rows.tobytes())
        _write_in_chunks(file, mesh.faces, _ply_rows)


def _ply_header(
    vertices: int, faces: int, properties: list[str], *notes: str, size: int = 0
) -> bytes:
    """Return the header, whose last comment is padded to a size of the whole."""
    comments = [f"comment {note}" for note in ("made by super-sdf", *notes)]
    first = "\n".join(["ply", "format binary_little_endian 1.0", *comments])
    of_vertices = "".join(f"property {each}\n" for each in properties)
    rest = f"\nelement vertex {vertices}\n{of_vertices}element face {faces}\n"
    rest += "property list uchar int vertex_indices\nend_header\n"
    return (first.ljust(size - len(rest)) + rest).encode("ascii")


def _ply_rows(faces: NDArray[Any]) -> bytes:
    rows = np.empty(len(faces), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    rows["count"], rows["corners"] = 3, faces
    return rows.tobytes()


# STL


def write_stl(pieces: Iterable[Mesh], path: Path, note: str = "") -> None:
    """Write binary STL: each triangle stores the positions of its corners, in float32.

    A note stands in its header.

    A triangle may use vertices of earlier pieces, so all vertices so far are kept in a temporary
    file, which is read back through a memory map.
    """
    vertices = faces = 0
    with (
        path.open("wb") as file,
        tempfile.TemporaryFile(dir=path.parent, prefix=f"{path.name}.") as waiting,
    ):
        file.write(_stl_header(0, note))
        for piece in pieces:
            positions = piece.vertices.astype(np.float32, copy=False)
            _write_in_chunks(waiting, positions, little_endian)
            vertices, faces = vertices + len(positions), faces + len(piece.faces)
            _write_triangles(file, waiting, vertices, piece.faces)
        file.seek(0)
        file.write(_stl_header(faces, note))


def _stl_header(faces: int, note: str) -> bytes:
    return f"made by super-sdf {note}".ljust(80).encode("ascii") + struct.pack("<I", faces)


def _write_triangles(
    file: IO[bytes], waiting: IO[bytes], vertices: int, faces: NDArray[Any]
) -> None:
    """Write triangles with the positions of their corners; mapped pages are released again."""
    if not len(faces):
        return
    waiting.flush()
    with mmap.mmap(waiting.fileno(), 12 * vertices, access=mmap.ACCESS_READ) as mapped:
        for start in range(0, len(faces), STL_CHUNK):
            positions = np.frombuffer(mapped, "<f4").reshape(-1, 3)
            corners = positions[faces[start : start + STL_CHUNK]]
            del positions  # otherwise the map cannot be closed
            file.write(_stl_rows(corners))
            if hasattr(mmap, "MADV_DONTNEED"):
                mapped.madvise(mmap.MADV_DONTNEED)


def _stl_rows(corners: NDArray[Any]) -> bytes:
    sides = corners[:, 1:].astype(np.float64) - corners[:, :1]
    sides /= np.maximum(np.abs(sides).max((1, 2), keepdims=True), np.finfo(np.float64).tiny)
    normals = np.cross(sides[:, 0], sides[:, 1])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    rows = np.zeros(len(corners), STL_ROW)
    rows["normal"], rows["corners"] = normals, corners
    return rows.tobytes()


# Text, with enough digits to read back the same numbers


def write_obj(pieces: Iterable[Mesh], path: Path, note: str = "") -> None:
    """Write Wavefront OBJ, whose vertex indices start at 1, with a note in its first line."""
    with path.open("wb") as file, spool_beside(path) as waiting:
        file.write(f"# made by super-sdf {note}".rstrip().encode("ascii") + b"\n")
        rows = _number_lines("v %s %s %s\n"), _index_lines("f %d %d %d\n", first=1)
        write_split(pieces, (file, waiting), rows, TEXT_CHUNK)
        append_spool(waiting, file)


def write_off(pieces: Iterable[Mesh], path: Path) -> None:
    """Write OFF."""
    with path.open("wb") as file, spool_beside(path) as waiting:
        file.write(bytes(OFF_HEADER_BYTES))
        rows = _number_lines("%s %s %s\n"), _index_lines("3 %d %d %d\n")
        written = write_split(pieces, (file, waiting), rows, TEXT_CHUNK)
        append_spool(waiting, file)
        head = f"OFF\n{written.vertices} {written.faces} 0".ljust(OFF_HEADER_BYTES - 1)
        file.seek(0)
        file.write(f"{head}\n".encode("ascii"))


def _number_lines(line: str) -> ToBytes:
    """Return what formats rows of floats as lines, with a ``%s`` per column.

    9 digits identify every float32; of float64 it is the shortest text that reads back the same.
    """

    def to_bytes(rows: NDArray[Any]) -> bytes:
        one = line.replace("%s", "%r" if rows.dtype == np.float64 else "%.9g")
        return ((one * len(rows)) % tuple(rows.ravel().tolist())).encode("ascii")

    return to_bytes


def _index_lines(line: str, first: int = 0) -> ToBytes:
    def to_bytes(rows: NDArray[Any]) -> bytes:
        numbers = rows.astype(np.int64) + first  # after the addition the last may exceed 32 bits
        return ((line * len(rows)) % tuple(numbers.ravel().tolist())).encode("ascii")

    return to_bytes


# Several meshes by their names

NO_COLOURS: Mapping[str, Colour] = MappingProxyType({})

JSON_BYTES = 1200  # of the scene, padded, per part, besides its name, which it has up to 3 times
HEADER_BYTES = 12 + 8 + 8  # without the scene
MOST_BYTES = 2**32 - 1  # the length in the header has 32 bits
FLOAT, UNSIGNED_INT, VERTICES, INDICES = 5126, 5125, 34962, 34963  # constants of glTF

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
COMPRESSION = 1  # the fastest level: higher ones save a tenth and take three times as long
BEFORE = (
    '<model unit="{}" xml:lang="en-US" '
    'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">\n<resources>'
)
UNITS = {"um": "micron", "mm": "millimeter", "cm": "centimeter", "m": "meter", "in": "inch",
         "ft": "foot"}  # fmt: skip
MATERIAL = '<basematerials id="{}"><base name={} displaycolor="{}"/></basematerials>'
OBJECT = '<object id="{}"{} type="model"><mesh><vertices>\n'


def write_glb(
    parts: Mapping[str, Iterable[Mesh]],
    path: Path,
    unit: str | None = None,
    colours: Mapping[str, Colour] = NO_COLOURS,
    about: Triple = (0.0, 0.0, 0.0),
) -> None:
    """Write meshes by their names as binary glTF; its header, of fixed length, is written last.

    Some may have colours. Vertices are float32, relative to the point ``about``. The nodes move
    them there, and scale them from the unit to metres, those of glTF. Raises FileError if a mesh
    has no triangle, which glTF does not allow, or the file exceeds 4.29 GB.
    """
    scene = _Scene(about, LENGTHS[unit or "m"])
    size = sum(JSON_BYTES + 3 * len(json.dumps(name)) for name in parts)
    size += -size % 4
    with path.open("wb") as file:
        file.write(bytes(HEADER_BYTES + size))
        for name, pieces in parts.items():
            box = _Shift(about)
            with spool_beside(path) as waiting:
                written = write_split(pieces, (file, waiting), (box.shift, _unsigned))
                if not written.faces:
                    raise FileError("a mesh without triangles cannot be .glb: give .ply")
                append_spool(waiting, file)
            scene.add(name, written, box, colours.get(name))
        length = file.tell()
        if length > MOST_BYTES:
            raise FileError(f"the mesh takes {length:,} bytes, .glb holds 4,294,967,295: give .ply")
        text = json.dumps(scene.described, separators=(",", ":")).ljust(size).encode("ascii")
        file.seek(0)
        file.write(struct.pack("<4sIII4s", b"glTF", 2, length, size, b"JSON") + text)
        file.write(struct.pack("<I4s", length - HEADER_BYTES - size, b"BIN\0"))


class _Shift:
    """Converts vertices to float32 relative to a point, and keeps their bounding box."""

    def __init__(self, about: Triple) -> None:
        self.about = np.array(about)
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)

    def shift(self, vertices: NDArray[Any]) -> bytes:
        shifted = (vertices - self.about if self.about.any() else vertices).astype(np.float32)
        self.low = np.minimum(self.low, shifted.min(0))
        self.high = np.maximum(self.high, shifted.max(0))
        return little_endian(shifted)


def _unsigned(faces: NDArray[Any]) -> bytes:
    return little_endian(faces.astype(np.uint32))


class _Scene:
    """The scene: a node and a mesh for each part, and the layout of the buffer."""

    def __init__(self, about: Triple, metres: float) -> None:
        scale = {"scale": [metres] * 3} if metres != 1 else {}
        self.place = {"translation": [metres * x for x in about], **scale} if any(about) else scale
        self.described: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "super-sdf"},
            "scene": 0,
            "scenes": [{"nodes": []}],
            **{key: [] for key in ("nodes", "meshes", "accessors", "bufferViews")},
            "buffers": [{"byteLength": 0}],
        }

    def add(self, name: str, written: Written, box: _Shift, colour: Colour | None) -> None:
        scene, named = self.described, {"name": name} if name else {}
        mesh, first = len(scene["meshes"]), len(scene["accessors"])
        scene["scenes"][0]["nodes"].append(mesh)
        scene["nodes"].append({"mesh": mesh, **named, **self.place})
        primitive = {"attributes": {"POSITION": first}, "indices": first + 1}
        if colour:
            materials = scene.setdefault("materials", [])
            primitive["material"] = len(materials)
            shown = {"baseColorFactor": [*map(linear, colour), 1], "metallicFactor": 0}
            materials.append({**named, "pbrMetallicRoughness": shown})
        scene["meshes"].append({"primitives": [primitive], **named})
        positions = {"componentType": FLOAT, "type": "VEC3", "count": written.vertices}
        ends = {"min": box.low.tolist(), "max": box.high.tolist()}
        indices = {"componentType": UNSIGNED_INT, "type": "SCALAR", "count": 3 * written.faces}
        scene["accessors"] += [
            {"bufferView": first, **positions, **ends},
            {"bufferView": first + 1, **indices},
        ]
        buffer = scene["buffers"][0]
        for size, target in ((12 * written.vertices, VERTICES), (12 * written.faces, INDICES)):
            offset = {"byteOffset": buffer["byteLength"]} if buffer["byteLength"] else {}
            view = {"buffer": 0, **offset, "byteLength": size, "target": target}
            scene["bufferViews"].append(view)
            buffer["byteLength"] += size


def linear(level: int) -> float:
    """Return a level of an sRGB colour, 0 to 255, as glTF has it, from 0 to 1."""
    share = level / 255
    return share / 12.92 if share <= 0.04045 else float(((share + 0.055) / 1.055) ** 2.4)


def write_3mf(
    parts: Mapping[str, Iterable[Mesh]],
    path: Path,
    unit: str | None = None,
    colours: Mapping[str, Colour] = NO_COLOURS,
) -> None:
    """Write meshes by their names as 3MF, in a unit or the format's default, the millimetre.

    Some may have colours.

    Members opened by name have no date, so the same mesh always gives the same file. Triangles
    wait as binary numbers, which take half as much as text.
    """
    rows = _number_lines('<vertex x="%s" y="%s" z="%s"/>\n'), _unsigned
    triangles = _index_lines('<triangle v1="%d" v2="%d" v3="%d"/>\n')
    with ZipFile(path, "w", ZIP_DEFLATED, compresslevel=COMPRESSION) as archive:
        for name, text in (("[Content_Types].xml", TYPES), ("_rels/.rels", RELATIONS)):
            with archive.open(name, "w") as file:
                file.write((HEAD + text).encode("ascii"))
        with archive.open("3D/3dmodel.model", "w", force_zip64=True) as file:
            file.write((HEAD + BEFORE.format(UNITS[unit or "mm"])).encode("ascii"))
            for number, (name, pieces) in enumerate(parts.items(), 1):
                named = f" name={quoteattr(name)}" if name else ""
                if name in colours:
                    material = len(parts) + number
                    shown = "#{:02X}{:02X}{:02X}".format(*colours[name])
                    text = MATERIAL.format(material, quoteattr(name), shown)
                    file.write(text.encode("utf-8"))
                    named += f' pid="{material}" pindex="0"'
                file.write(OBJECT.format(number, named).encode("utf-8"))
                with spool_beside(path) as waiting:
                    write_split(pieces, (file, waiting), rows, TEXT_CHUNK)
                    file.write(b"</vertices><triangles>\n")
                    waiting.seek(0)
                    while data := waiting.read(12 * TEXT_CHUNK):
                        file.write(triangles(np.frombuffer(data, "<u4").reshape(-1, 3)))
                file.write(b"</triangles></mesh></object>")
            items = "".join(f'<item objectid="{n}"/>' for n in range(1, len(parts) + 1))
            file.write(f"</resources><build>{items}</build></model>\n".encode("ascii"))
