"""Writing meshes in pieces: vertices go to the file, triangles wait in a temporary file beside it.

Most formats need all vertices before the first triangle. Only a chunk of rows is in memory at a
time. The temporary file has no name, so it disappears with the process, however that ends.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..mesh import Mesh

CHUNK = 1 << 18  # rows written at a time
TEXT_CHUNK = 1 << 14  # rows of text at a time: Python numbers take ten times the memory
SPOOL_BYTES = 4_000_000  # kept in memory before a file is made

ToBytes = Callable[[NDArray[Any]], bytes]
"""Converts rows of vertices or triangles to the bytes that are written."""


@dataclass(frozen=True)
class Written:
    """The numbers of vertices and triangles written, and the dtype of the vertices."""

    vertices: int
    faces: int
    dtype: np.dtype[Any]


@contextmanager
def spool_beside(part: Path) -> Iterator[IO[bytes]]:
    """Open a temporary file beside a file that is being written.

    Where the system cannot create unnamed files, it briefly has a name that
    ``parts.remove_abandoned_parts`` recognises.
    """
    folder, name = str(part.parent), f"{part.name}."
    with tempfile.SpooledTemporaryFile(SPOOL_BYTES, dir=folder, prefix=name) as spool:
        yield spool


def write_split(
    pieces: Iterable[Mesh],
    files: tuple[IO[bytes], IO[bytes]],
    to_bytes: tuple[ToBytes, ToBytes],
    chunk: int = CHUNK,
) -> Written:
    """Write the vertices of all pieces to the first file and their triangles to the second.

    Parameters
    ----------
    pieces : iterable of Mesh
        The mesh.
    files : two binary files
        For vertices and for triangles.
    to_bytes : two callables
        Convert rows of vertices, and of triangles, to bytes.
    chunk : int
        Rows converted at a time.
    """
    vertices, faces, dtype = 0, 0, np.dtype(np.float32)
    for piece in pieces:
        write_in_chunks(files[0], piece.vertices, to_bytes[0], chunk)
        write_in_chunks(files[1], piece.faces, to_bytes[1], chunk)
        vertices, faces = vertices + len(piece.vertices), faces + len(piece.faces)
        dtype = piece.vertices.dtype
    return Written(vertices, faces, dtype)


def write_in_chunks(
    file: IO[bytes], array: NDArray[Any], to_bytes: ToBytes, chunk: int = CHUNK
) -> None:
    """Write the rows of an array ``chunk`` at a time, since ``to_bytes`` copies them."""
    for start in range(0, len(array), chunk):
        file.write(to_bytes(array[start : start + chunk]))


def append_spool(waiting: IO[bytes], file: IO[bytes]) -> None:
    """Copy the temporary file ``waiting`` to the end of ``file``."""
    waiting.seek(0)
    shutil.copyfileobj(waiting, file, SPOOL_BYTES)


def little_endian(array: NDArray[Any]) -> bytes:
    """Return the bytes of an array in little-endian order."""
    return array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
