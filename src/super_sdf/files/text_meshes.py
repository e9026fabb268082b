"""OBJ and OFF: meshes as text, with as many digits as tell every number from its neighbours."""

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
    """Write Wavefront OBJ; its triangles count vertices from 1."""
    with path.open("wb") as file, spool_beside(path) as waiting:
        file.write(b"# made by super-sdf\n")
        rows = number_lines("v %s %s %s\n"), index_lines("f %d %d %d\n", first=1)
        write_split(pieces, (file, waiting), rows, TEXT_CHUNK)
        append_spool(waiting, file)


def write_off(pieces: Iterable[Mesh], path: Path) -> None:
    """Write OFF; the counts at its head, padded to one length, are written last."""
    with path.open("wb") as file, spool_beside(path) as waiting:
        file.write(_off_header(0, 0))
        rows = number_lines("%s %s %s\n"), index_lines("3 %d %d %d\n")
        written = write_split(pieces, (file, waiting), rows, TEXT_CHUNK)
        append_spool(waiting, file)
        file.seek(0)
        file.write(_off_header(written.vertices, written.faces))


def _off_header(vertices: int, faces: int) -> bytes:
    """Return the head, of the same length whatever the numbers."""
    return f"OFF\n{vertices} {faces} 0".ljust(OFF_HEADER_BYTES - 1).encode("ascii") + b"\n"


def number_lines(line: str) -> ToBytes:
    """Return what turns rows of numbers into lines: each ``%s`` stands for one.

    9 digits tell all single-precision numbers apart. For double precision Python writes as few as
    tell them apart, up to 17.
    """

    def to_bytes(rows: NDArray[Any]) -> bytes:
        one = line.replace("%s", "%r" if rows.dtype == np.float64 else "%.9g")
        return ((one * len(rows)) % tuple(rows.ravel().tolist())).encode("ascii")

    return to_bytes


def index_lines(line: str, first: int = 0) -> ToBytes:
    """Return what turns triangles into lines, vertices counted from ``first``."""

    def to_bytes(rows: NDArray[Any]) -> bytes:
        numbers = rows.astype(np.int64) + first  # the last may not fit in 32 bits any more
        return ((line * len(rows)) % tuple(numbers.ravel().tolist())).encode("ascii")

    return to_bytes
