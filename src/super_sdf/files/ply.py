"""Binary PLY, written piece by piece."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..mesh import Mesh
from .spool import append_spool, little_endian, spool_beside, write_split

HEADER_BYTES = 320


def write_ply(pieces: Iterable[Mesh], path: Path) -> None:
    """Write binary little-endian PLY.

    The format has all vertices before all triangles, and their counts before both: the header,
    padded to a fixed length, is written last.
    """
    with path.open("wb") as file, spool_beside(path) as waiting:
        file.write(_ply_header("float", 0, 0))
        written = write_split(pieces, (file, waiting), (little_endian, ply_rows))
        append_spool(waiting, file)
        file.seek(0)
        number = "double" if written.dtype == np.float64 else "float"
        file.write(_ply_header(number, written.vertices, written.faces))


def _ply_header(number: str, vertices: int, faces: int) -> bytes:
    """Return the header; its comment is padded, so that its length is fixed."""
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


def ply_rows(faces: NDArray[Any]) -> bytes:
    """Return triangles as PLY lists: the number of corners, then their indices."""
    rows = np.empty(len(faces), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    rows["count"], rows["corners"] = 3, faces
    return rows.tobytes()
