"""Meshes that come in pieces: vertices go to the file, triangles wait in a file beside it.

Most formats want all vertices before the first triangle. No more of a mesh is in memory than a
chunk of rows; the file beside has no name, so it ends with the process however that ends.
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

CHUNK = 1 << 18  # rows that are written at a time
TEXT_CHUNK = 1 << 14  # rows of text: Python's numbers take ten times the memory
SPOOL_BYTES = 4_000_000  # what waits in memory before it goes to a file

ToBytes = Callable[[NDArray[Any]], bytes]
"""What is written of some rows of vertices or triangles."""


@dataclass(frozen=True)
class Written:
    """How many vertices and triangles were written, and the vertices' dtype."""

    vertices: int
    faces: int
    dtype: np.dtype[Any]


@contextmanager
def spool_beside(part: Path) -> Iterator[IO[bytes]]:
    """Open a temporary file beside a file that is being written.

    Where the system cannot make a file without a name, it has for a moment one that
    ``parts.remove_abandoned_parts`` knows.
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
    """Write the vertices of all pieces to one file and their triangles to another."""
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
    """Write rows of an array, some at a time: the bytes are a copy."""
    for start in range(0, len(array), chunk):
        file.write(to_bytes(array[start : start + chunk]))


def append_spool(waiting: IO[bytes], file: IO[bytes]) -> None:
    """Copy what waited to the end of the file."""
    waiting.seek(0)
    shutil.copyfileobj(waiting, file, SPOOL_BYTES)


def little_endian(array: NDArray[Any]) -> bytes:
    """Return the bytes of numbers, least significant first."""
    return array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
