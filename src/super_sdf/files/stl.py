"""Binary STL: each triangle stores the positions of its corners, in float32.

A triangle may use vertices of earlier pieces, so all vertices so far are kept in a temporary file,
which is read back through a memory map.
"""

from __future__ import annotations

import mmap
import struct
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..mesh import Mesh
from .spool import little_endian, write_in_chunks

CHUNK = 1 << 15  # triangles at a time
ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def write_stl(pieces: Iterable[Mesh], path: Path) -> None:
    """Write binary STL; the header, which has the number of triangles, is written last."""
    vertices = faces = 0
    with (
        path.open("wb") as file,
        tempfile.TemporaryFile(dir=path.parent, prefix=f"{path.name}.") as waiting,
    ):
        file.write(_stl_header(0))
        for piece in pieces:
            write_in_chunks(waiting, piece.vertices, _single)
            vertices, faces = vertices + len(piece.vertices), faces + len(piece.faces)
            _write_triangles(file, waiting, vertices, piece.faces)
        file.seek(0)
        file.write(_stl_header(faces))


def _stl_header(faces: int) -> bytes:
    return b"made by super-sdf".ljust(80) + struct.pack("<I", faces)


def _single(vertices: NDArray[Any]) -> bytes:
    return little_endian(vertices.astype(np.float32, copy=False))


def _write_triangles(
    file: IO[bytes], waiting: IO[bytes], vertices: int, faces: NDArray[Any]
) -> None:
    """Write triangles with the positions of their corners; mapped pages are released again."""
    if not len(faces):
        return
    waiting.flush()
    with mmap.mmap(waiting.fileno(), 12 * vertices, access=mmap.ACCESS_READ) as mapped:
        for start in range(0, len(faces), CHUNK):
            positions = np.frombuffer(mapped, "<f4").reshape(-1, 3)
            corners = positions[faces[start : start + CHUNK]]
            del positions  # otherwise the map cannot be closed
            file.write(_stl_rows(corners))
            if hasattr(mmap, "MADV_DONTNEED"):
                mapped.madvise(mmap.MADV_DONTNEED)


def _stl_rows(corners: NDArray[Any]) -> bytes:
    """Return the bytes of triangles, (n, 3, 3), with their unit normals."""
    sides = corners[:, 1:].astype(np.float64) - corners[:, :1]
    sides /= np.maximum(np.abs(sides).max((1, 2), keepdims=True), np.finfo(np.float64).tiny)
    normals = np.cross(sides[:, 0], sides[:, 1])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    rows = np.zeros(len(corners), ROW)
    rows["normal"], rows["corners"] = normals, corners
    return rows.tobytes()
