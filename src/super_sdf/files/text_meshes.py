"""OBJ and OFF: meshes as text, with enough digits to read back the same numbers."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..mesh import Mesh
from .spool import TEXT_CHUNK, ToBytes, append_spool, spool_beside, write_split

OFF_HEADER_BYTES = 64


def write_obj(pieces: Iterable[Mesh], path: Path) -> None:
    """Write Wavefront OBJ, whose vertex indices start at 1."""
    with path.open("wb") as file, spool_beside(path) as waiting:
        file.write(b"# made by super-sdf\n")
        rows = number_lines("v %s %s %s\n"), index_lines("f %d %d %d\n", first=1)
        write_split(pieces, (file, waiting), rows, TEXT_CHUNK)
        append_spool(waiting, file)


def write_off(pieces: Iterable[Mesh], path: Path) -> None:
    """Write OFF; the header with the counts, padded to a fixed length, is written last."""
    with path.open("wb") as file, spool_beside(path) as waiting:
        file.write(_off_header(0, 0))
        rows = number_lines("%s %s %s\n"), index_lines("3 %d %d %d\n")
        written = write_split(pieces, (file, waiting), rows, TEXT_CHUNK)
        append_spool(waiting, file)
        file.seek(0)
        file.write(_off_header(written.vertices, written.faces))


def _off_header(vertices: int, faces: int) -> bytes:
    """Return the header, padded to a fixed length."""
    return f"OFF\n{vertices} {faces} 0".ljust(OFF_HEADER_BYTES - 1).encode("ascii") + b"\n"


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
