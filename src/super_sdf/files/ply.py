"""Binary PLY, written piece by piece as a mesh is made."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..mesh import Mesh

CHUNK = 1 << 18  # vertices or faces written at a time
SPOOL_BYTES = 4_000_000  # triangles that wait in memory before they go to a file beside
HEADER_BYTES = 320


def write_ply(pieces: Iterable[Mesh], path: Path) -> None:
    """Write binary little-endian PLY.

    All vertices come before all triangles, and their numbers before both: triangles wait beside,
    and the header, which is padded to one length, is written last.
    """
    vertices, faces, number = 0, 0, "float"
    spool = partial(tempfile.SpooledTemporaryFile, SPOOL_BYTES, dir=path.parent)
    with path.open("wb") as file, spool() as waiting:
        file.write(_ply_header(number, 0, 0))
        for piece in pieces:
            write_in_chunks(file, piece.vertices, _little_endian)
            write_in_chunks(waiting, piece.faces, _ply_rows)
            number = "double" if piece.vertices.dtype == np.float64 else "float"
            vertices, faces = vertices + len(piece.vertices), faces + len(piece.faces)
        waiting.seek(0)
        shutil.copyfileobj(waiting, file, SPOOL_BYTES)
        file.seek(0)
        file.write(_ply_header(number, vertices, faces))


def _ply_header(number: str, vertices: int, faces: int) -> bytes:
    """Return the header, of the same length whatever the numbers: its comment is padded."""
    first = "ply\nformat binary_little_endian 1.0\ncomment made by super-sdf"
    lines = [
        "",
        f"element vertex {vertices}",
        *(f"property {number} {axis}" for axis in "xyz"),
        f"element face {faces}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    rest = "\n".join(lines)
    return (first + " " * (HEADER_BYTES - len(first) - len(rest)) + rest).encode("ascii")


def write_in_chunks(
    file: IO[bytes], array: NDArray[Any], to_bytes: Callable[[NDArray[Any]], bytes]
) -> None:
    """Write rows of an array, some at a time: the bytes are a copy."""
    for start in range(0, len(array), CHUNK):
        file.write(to_bytes(array[start : start + CHUNK]))


def _little_endian(array: NDArray[Any]) -> bytes:
    """Return the bytes of numbers, least significant first."""
    return array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()


def _ply_rows(faces: NDArray[Any]) -> bytes:
    """Return triangles as PLY's lists: how many corners, then which."""
    rows = np.empty(len(faces), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    rows["count"], rows["corners"] = 3, faces
    return rows.tobytes()
