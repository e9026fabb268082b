"""Binary glTF: single precision, about a local origin that its node adds in double precision."""

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

JSON_BYTES = 1200
MOST_BYTES = 2**32 - 1  # the length at its head has 32 bits
FLOAT, UNSIGNED_INT, VERTICES, INDICES = 5126, 5125, 34962, 34963  # glTF's numbers


def write_glb(pieces: Iterable[Mesh], path: Path, about: Triple = (0.0, 0.0, 0.0)) -> None:
    """Write binary glTF; its head, padded to one length, is written last.

    Vertices are written as they lie about the point ``about``, which the node's translation adds.

    Raises
    ------
    FileError
        If there is no triangle, which glTF cannot say, or the file grows beyond 4.29 GB.
    """
    box = Box(about)
    with path.open("wb") as file, spool_beside(path) as waiting:
        file.write(bytes(_head_bytes()))
        written = write_split(pieces, (file, waiting), (box.place, _indices))
        if not written.faces:
            raise FileError("a mesh without triangles cannot be .glb: give .ply")
        append_spool(waiting, file)
        length = file.tell()
        if length > MOST_BYTES:
            raise FileError(f"the mesh takes {length:,} bytes, .glb holds 4,294,967,295: give .ply")
        file.seek(0)
        file.write(_head(length, _describe(written.vertices, written.faces, box)))


class Box:
    """Places vertices about a point, and keeps the extremes of what was placed."""

    def __init__(self, about: Triple) -> None:
        self.about = np.array(about)
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)

    def place(self, vertices: NDArray[Any]) -> bytes:
        """Return vertices about the point, in single precision."""
        placed = (vertices - self.about if self.about.any() else vertices).astype(np.float32)
        self.low = np.minimum(self.low, placed.min(0))
        self.high = np.maximum(self.high, placed.max(0))
        return little_endian(placed)


def _indices(faces: NDArray[Any]) -> bytes:
    return little_endian(faces.astype(np.uint32))


def _head_bytes() -> int:
    return 12 + 8 + JSON_BYTES + 8


def _head(length: int, scene: dict[str, Any]) -> bytes:
    """Return all that stands before the vertices, of the same length whatever the numbers."""
    text = json.dumps(scene, separators=(",", ":")).ljust(JSON_BYTES).encode("ascii")
    whole = struct.pack("<4sII", b"glTF", 2, length)
    first = struct.pack("<I4s", JSON_BYTES, b"JSON") + text
    return whole + first + struct.pack("<I4s", length - _head_bytes(), b"BIN\0")


def _describe(vertices: int, faces: int, box: Box) -> dict[str, Any]:
    """Return the scene: one node, one mesh, and where its numbers lie."""
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
