"""Binary glTF: float32 vertices relative to a local origin, the translation of the node."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Triple
from ..errors import FileError
from ..mesh import Mesh
from .spool import append_spool, little_endian, spool_beside, write_split

JSON_BYTES = 1200  # of the scene, padded
MOST_BYTES = 2**32 - 1  # the length in the header has 32 bits
FLOAT, UNSIGNED_INT, VERTICES, INDICES = 5126, 5125, 34962, 34963  # constants of glTF


def write_glb(pieces: Iterable[Mesh], path: Path, about: Triple = (0.0, 0.0, 0.0)) -> None:
    """Write binary glTF; its header, padded to a fixed length, is written last.

    Vertices are stored relative to the point ``about``, the translation of the node.

    Raises
    ------
    FileError
        If there is no triangle, which glTF does not allow, or the file exceeds 4.29 GB.
    """
    box = Box(about)
    with path.open("wb") as file, spool_beside(path) as waiting:
        file.write(bytes(_header_bytes()))
        written = write_split(pieces, (file, waiting), (box.shift, _indices))
        if not written.faces:
            raise FileError("a mesh without triangles cannot be .glb: give .ply")
        append_spool(waiting, file)
        length = file.tell()
        if length > MOST_BYTES:
            raise FileError(f"the mesh takes {length:,} bytes, .glb holds 4,294,967,295: give .ply")
        file.seek(0)
        file.write(_header(length, _describe(written.vertices, written.faces, box)))


class Box:
    """Shifts vertices to a local origin, and keeps their bounding box.

    Parameters
    ----------
    about : three floats
        The local origin, in world units.
    """

    def __init__(self, about: Triple) -> None:
        self.about = np.array(about)
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)

    def shift(self, vertices: NDArray[Any]) -> bytes:
        """Return the bytes of vertices (n, 3) relative to the local origin, as float32."""
        shifted = (vertices - self.about if self.about.any() else vertices).astype(np.float32)
        self.low = np.minimum(self.low, shifted.min(0))
        self.high = np.maximum(self.high, shifted.max(0))
        return little_endian(shifted)


def _indices(faces: NDArray[Any]) -> bytes:
    return little_endian(faces.astype(np.uint32))


def _header_bytes() -> int:
    return 12 + 8 + JSON_BYTES + 8


def _header(length: int, scene: dict[str, Any]) -> bytes:
    """Return all that precedes the vertices; its length does not depend on the numbers."""
    text = json.dumps(scene, separators=(",", ":")).ljust(JSON_BYTES).encode("ascii")
    whole = struct.pack("<4sII", b"glTF", 2, length)
    first = struct.pack("<I4s", JSON_BYTES, b"JSON") + text
    return whole + first + struct.pack("<I4s", length - _header_bytes(), b"BIN\0")


def _describe(vertices: int, faces: int, box: Box) -> dict[str, Any]:
    """Return the scene: one node, one mesh, and the layout of the buffer."""
    node: dict[str, Any] = {"mesh": 0}
    if box.about.any():
        node["translation"] = box.about.tolist()
    return {
        "asset": {"version": "2.0", "generator": "super-sdf"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": FLOAT,
                "type": "VEC3",
                "count": vertices,
                "min": box.low.tolist(),
                "max": box.high.tolist(),
            },
            {
                "bufferView": 1,
                "componentType": UNSIGNED_INT,
                "type": "SCALAR",
                "count": 3 * faces,
            },
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 12 * vertices, "target": VERTICES},
            {
                "buffer": 0,
                "byteOffset": 12 * vertices,
                "byteLength": 12 * faces,
                "target": INDICES,
            },
        ],
        "buffers": [{"byteLength": 12 * (vertices + faces)}],
    }
