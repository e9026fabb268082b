"""One mesh a file: binary PLY and STL, OBJ and OFF as text.

All are written piece by piece, with a chunk of rows in memory at a time. Most formats need all
vertices before the first triangle, so triangles wait in a temporary file; headers with counts,
padded to a fixed length, are written last.
"""

from __future__ import annotations

import mmap
import struct
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..mesh import Mesh
from .output import append_spool, little_endian, replacing, spool_beside

CHUNK = 1 << 18  # rows written at a time
TEXT_CHUNK = 1 << 14  # rows of text at a time: Python numbers take ten times the memory
STL_CHUNK = 1 << 15  # triangles at a time
PLY_HEADER_BYTES, OFF_HEADER_BYTES = 320, 64
STL_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
COLOURS = ("red", "green", "blue")

ToBytes: TypeAlias = Callable[[NDArray[Any]], bytes]
"""Converts rows of vertices or triangles to the bytes that are written."""


class Written(NamedTuple):
    """The numbers of vertices and triangles written, and the dtype of the vertices."""

    vertices: int
    faces: int
    dtype: np.dtype[Any]


def write_split(
    pieces: Iterable[Mesh],
    files: tuple[IO[bytes], IO[bytes]],
    to_bytes: tuple[ToBytes, ToBytes],
    chunk: int | None = None,
) -> Written:
    """Write the vertices of all pieces to the first file and their triangles to the second.

    ``to_bytes`` converts rows of vertices, and of triangles, ``chunk`` at a time.
    """
    vertices, faces, dtype = 0, 0, np.dtype(np.float32)
    for piece in pieces:
        write_in_chunks(files[0], piece.vertices, to_bytes[0], chunk)
        write_in_chunks(files[1], piece.faces, to_bytes[1], chunk)
        vertices, faces = vertices + len(piece.vertices), faces + len(piece.faces)
        dtype = piece.vertices.dtype
    return Written(vertices, faces, dtype)


def write_in_chunks(
    file: IO[bytes], array: NDArray[Any], to_bytes: ToBytes, chunk: int | None = None
) -> None:
    """Write the rows of an array ``chunk`` at a time, since ``to_bytes`` copies them."""
    step = chunk or CHUNK
    for start in range(0, len(array), step):
        file.write(to_bytes(array[start : start + step]))


# PLY


def write_ply(pieces: Iterable[Mesh], path: Path) -> None:
    """Write binary little-endian PLY."""

    def header(number: str, vertices: int, faces: int) -> bytes:
        axes = [f"{number} {axis}" for axis in "xyz"]
        return _ply_header(vertices, faces, axes, size=PLY_HEADER_BYTES)

    with path.open("wb") as file, spool_beside(path) as waiting:
        file.write(header("float", 0, 0))
        written = write_split(pieces, (file, waiting), (little_endian, _ply_rows))
        append_spool(waiting, file)
        file.seek(0)
        number = "double" if written.dtype == np.float64 else "float"
        file.write(header(number, written.vertices, written.faces))


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
    properties = [
        *(f"double {axis}" for axis in "xyz"),
        "float residual",
        *(f"uchar {name}" for name in COLOURS),
    ]
    note = "residual: distance of samples to the mesh minus their value, in voxels"
    with replacing(path, force=force) as part, part.open("wb") as file:
        file.write(_ply_header(len(mesh.vertices), len(mesh.faces), properties, note))
        for first in range(0, len(mesh.vertices), CHUNK):
            chunk = slice(first, first + CHUNK)
            rows = np.empty(len(residuals[chunk]), kind)
            rows["position"], rows["residual"] = mesh.vertices[chunk], residuals[chunk]
            rows["colour"] = colours[chunk]
            file.write(rows.tobytes())
        write_in_chunks(file, mesh.faces, _ply_rows)


def _ply_header(
    vertices: int, faces: int, properties: list[str], *notes: str, size: int = 0
) -> bytes:
    """Return the header, whose last comment is padded to a size of the whole."""
    comments = [f"comment {note}" for note in ("made by super-sdf", *notes)]
    first = "\n".join(["ply", "format binary_little_endian 1.0", *comments])
    lines = [
        "",
        f"element vertex {vertices}",
        *(f"property {each}" for each in properties),
        f"element face {faces}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    rest = "\n".join(lines)
    return (first.ljust(size - len(rest)) + rest).encode("ascii")


def _ply_rows(faces: NDArray[Any]) -> bytes:
    rows = np.empty(len(faces), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    rows["count"], rows["corners"] = 3, faces
    return rows.tobytes()


# STL


def write_stl(pieces: Iterable[Mesh], path: Path) -> None:
    """Write binary STL: each triangle stores the positions of its corners, in float32.

    A triangle may use vertices of earlier pieces, so all vertices so far are kept in a temporary
    file, which is read back through a memory map.
    """
    vertices = faces = 0
    with (
        path.open("wb") as file,
        tempfile.TemporaryFile(dir=path.parent, prefix=f"{path.name}.") as waiting,
    ):
        file.write(_stl_header(0))
        for piece in pieces:
            positions = piece.vertices.astype(np.float32, copy=False)
            write_in_chunks(waiting, positions, little_endian)
            vertices, faces = vertices + len(positions), faces + len(piece.faces)
            _write_triangles(file, waiting, vertices, piece.faces)
        file.seek(0)
        file.write(_stl_header(faces))


def _stl_header(faces: int) -> bytes:
    return b"made by super-sdf".ljust(80) + struct.pack("<I", faces)


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


def write_obj(pieces: Iterable[Mesh], path: Path) -> None:
    """Write Wavefront OBJ, whose vertex indices start at 1."""
    with path.open("wb") as file, spool_beside(path) as waiting:
        file.write(b"# made by super-sdf\n")
        rows = number_lines("v %s %s %s\n"), index_lines("f %d %d %d\n", first=1)
        write_split(pieces, (file, waiting), rows, TEXT_CHUNK)
        append_spool(waiting, file)


def write_off(pieces: Iterable[Mesh], path: Path) -> None:
    """Write OFF."""

    def header(vertices: int, faces: int) -> bytes:
        text = f"OFF\n{vertices} {faces} 0".ljust(OFF_HEADER_BYTES - 1)
        return text.encode("ascii") + b"\n"

    with path.open("wb") as file, spool_beside(path) as waiting:
        file.write(header(0, 0))
        rows = number_lines("%s %s %s\n"), index_lines("3 %d %d %d\n")
        written = write_split(pieces, (file, waiting), rows, TEXT_CHUNK)
        append_spool(waiting, file)
        file.seek(0)
        file.write(header(written.vertices, written.faces))


def number_lines(line: str) -> ToBytes:
    """Return a function that formats rows of floats as lines; ``line`` has a ``%s`` per column.

    9 digits identify every float32. For float64 Python writes the shortest representation that
    reads back the same, up to 17 digits.
    """

    def to_bytes(rows: NDArray[Any]) -> bytes:
        one = line.replace("%s", "%r" if rows.dtype == np.float64 else "%.9g")
        return ((one * len(rows)) % tuple(rows.ravel().tolist())).encode("ascii")

    return to_bytes


def index_lines(line: str, first: int = 0) -> ToBytes:
    """Return a function that formats triangles as lines; vertex indices start at ``first``."""

    def to_bytes(rows: NDArray[Any]) -> bytes:
        numbers = rows.astype(np.int64) + first  # after the addition the last may exceed 32 bits
        return ((line * len(rows)) % tuple(numbers.ravel().tolist())).encode("ascii")

    return to_bytes
