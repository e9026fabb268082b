"""Files of one mesh or several by their names: binary glTF and 3MF, written piece by piece."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import IO, Any
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
from numpy.typing import NDArray

from ..arrays import Triple
from ..errors import FileError
from ..mesh import Mesh
from .output import append_spool, little_endian, spool_beside
from .plain_meshes import (
    TEXT_CHUNK,
    Written,
    index_lines,
    number_lines,
    write_in_chunks,
    write_split,
)

JSON_BYTES = 1200  # of the scene, padded, per part
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
    '<model unit="millimeter" xml:lang="en-US" '
    'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">\n<resources>'
)
OBJECT = '<object id="{}"{} type="model"><mesh><vertices>\n'
BETWEEN = "</vertices><triangles>\n"
END = "</triangles></mesh></object>"
ITEM = '<item objectid="{}"/>'


def write_glb(
    parts: Mapping[str, Iterable[Mesh]], path: Path, about: Triple = (0.0, 0.0, 0.0)
) -> None:
    """Write meshes by their names as binary glTF; its header, of fixed length, is written last.

    Vertices are float32, relative to the point ``about``, the translation of the nodes. Raises
    FileError if a mesh has no triangle, which glTF does not allow, or the file exceeds 4.29 GB.
    """
    scene, size = Scene(about), JSON_BYTES * len(parts)
    with path.open("wb") as file:
        file.write(bytes(HEADER_BYTES + size))
        for name, pieces in parts.items():
            box = _Shift(about)
            with spool_beside(path) as waiting:
                written = write_split(pieces, (file, waiting), (box.shift, _unsigned))
                if not written.faces:
                    raise FileError("a mesh without triangles cannot be .glb: give .ply")
                append_spool(waiting, file)
            scene.add(name, written, box)
        length = file.tell()
        if length > MOST_BYTES:
            raise FileError(f"the mesh takes {length:,} bytes, .glb holds 4,294,967,295: give .ply")
        file.seek(0)
        file.write(_header(length, size, scene.described))


class _Shift:
    def __init__(self, about: Triple) -> None:
        self.about = np.array(about)
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)

    def shift(self, vertices: NDArray[Any]) -> bytes:
        """Return the bytes of vertices (n, 3) relative to the local origin, as float32."""
        shifted = (vertices - self.about if self.about.any() else vertices).astype(np.float32)
        self.low = np.minimum(self.low, shifted.min(0))
        self.high = np.maximum(self.high, shifted.max(0))
        return little_endian(shifted)


def _unsigned(faces: NDArray[Any]) -> bytes:
    return little_endian(faces.astype(np.uint32))


def _header(length: int, size: int, scene: dict[str, Any]) -> bytes:
    """Return all that precedes the vertices; its length does not depend on the numbers."""
    text = json.dumps(scene, separators=(",", ":")).ljust(size).encode("ascii")
    whole = struct.pack("<4sII", b"glTF", 2, length)
    first = struct.pack("<I4s", size, b"JSON") + text
    return whole + first + struct.pack("<I4s", length - HEADER_BYTES - size, b"BIN\0")


class Scene:
    """The scene: a node and a mesh for each part, and the layout of the buffer."""

    def __init__(self, about: Triple) -> None:
        self.place = {"translation": list(about)} if any(about) else {}
        self.buffer = {"byteLength": 0}
        self.described: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "super-sdf"},
            "scene": 0,
            "scenes": [{"nodes": []}],
            **{key: [] for key in ("nodes", "meshes", "accessors", "bufferViews")},
            "buffers": [self.buffer],
        }

    def add(self, name: str, written: Written, box: _Shift) -> None:
        """Add a part, whose vertices and indices follow those before."""
        scene, named = self.described, {"name": name} if name else {}
        mesh, first = len(scene["meshes"]), len(scene["accessors"])
        scene["scenes"][0]["nodes"].append(mesh)
        scene["nodes"].append({"mesh": mesh, **named, **self.place})
        primitive = {"attributes": {"POSITION": first}, "indices": first + 1}
        scene["meshes"].append({"primitives": [primitive], **named})
        positions = {"componentType": FLOAT, "type": "VEC3", "count": written.vertices}
        ends = {"min": box.low.tolist(), "max": box.high.tolist()}
        indices = {"componentType": UNSIGNED_INT, "type": "SCALAR", "count": 3 * written.faces}
        scene["accessors"] += [
            {"bufferView": first, **positions, **ends},
            {"bufferView": first + 1, **indices},
        ]
        for size, target in ((12 * written.vertices, VERTICES), (12 * written.faces, INDICES)):
            start = self.buffer["byteLength"]
            offset = {"byteOffset": start} if start else {}
            view = {"buffer": 0, **offset, "byteLength": size, "target": target}
            scene["bufferViews"].append(view)
            self.buffer["byteLength"] += size


def write_3mf(parts: Mapping[str, Iterable[Mesh]], path: Path) -> None:
    """Write meshes by their names as 3MF in the format's default unit, the millimetre.

    Members opened by name have no date, so the same mesh always gives the same file.
    """
    with ZipFile(path, "w", ZIP_DEFLATED, compresslevel=COMPRESSION) as archive:
        for name, text in (("[Content_Types].xml", TYPES), ("_rels/.rels", RELATIONS)):
            with archive.open(name, "w") as file:
                file.write((HEAD + text).encode("ascii"))
        with archive.open("3D/3dmodel.model", "w", force_zip64=True) as file:
            file.write((HEAD + BEFORE).encode("ascii"))
            for number, (name, pieces) in enumerate(parts.items(), 1):
                named = f' name="{name}"' if name else ""
                file.write(OBJECT.format(number, named).encode("ascii"))
                with spool_beside(path) as waiting:
                    _write_mesh(pieces, file, waiting)
                file.write(END.encode("ascii"))
            items = "".join(ITEM.format(number) for number in range(1, len(parts) + 1))
            file.write(f"</resources><build>{items}</build></model>\n".encode("ascii"))


def _write_mesh(pieces: Iterable[Mesh], file: IO[bytes], waiting: IO[bytes]) -> None:
    """Write a mesh; its triangles wait as binary numbers, which take half as much as text."""
    vertices = number_lines('<vertex x="%s" y="%s" z="%s"/>\n')
    write_split(pieces, (file, waiting), (vertices, _unsigned), TEXT_CHUNK)
    file.write(BETWEEN.encode("ascii"))
    waiting.seek(0)
    triangles = index_lines('<triangle v1="%d" v2="%d" v3="%d"/>\n')
    while rows := waiting.read(12 * TEXT_CHUNK):
        write_in_chunks(file, np.frombuffer(rows, "<u4").reshape(-1, 3), triangles, TEXT_CHUNK)
