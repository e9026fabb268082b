"""Reading the plainest of PLY files, as this package and most others write them: quickly.

That is little-endian triangles, ``property list uchar int``, after vertices whose properties are
numbers. Everything else is left to trimesh, which takes twice the time and memory.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

HEADER_LINES = 60  # at most, of a plain file
LINE_BYTES = 400
TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}
FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
HEADER = re.compile(
    r"ply\nformat binary_little_endian 1.0\n"
    r"element vertex (\d{1,10})\n((?:property [a-z]+\d* \w+\n)+)"
    r"element face (\d{1,10})\n"
    r"property list (?:uchar|uint8) (?:int|int32) vertex_ind(?:ices|ex)\nend_header\n"
)


def read_plain_ply(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32]] | None:
    """Return vertices, (n, 3), and faces, (m, 3), as they stand; None if the file is not plain."""
    with path.open("rb") as file:
        plain = HEADER.fullmatch(_header(file))
        if not plain:
            return None
        words = [line.split()[1:] for line in plain[2].splitlines()]
        names = [name for _, name in words]
        if not set("xyz") <= set(names) or len(set(names)) < len(names):
            return None
        if not {kind for kind, _ in words} <= TYPES.keys():
            return None
        row = np.dtype([(name, TYPES[kind]) for kind, name in words])
        counts = int(plain[1]), int(plain[3])
        size = counts[0] * row.itemsize + counts[1] * FACE.itemsize
        if path.stat().st_size != file.tell() + size:
            return None
        vertices = np.fromfile(file, row, counts[0])
        faces = np.fromfile(file, FACE, counts[1])
    if not (faces["count"] == 3).all():
        return None
    corners = np.ascontiguousarray(faces["corners"])
    del faces
    return np.stack([vertices[axis] for axis in "xyz"], axis=1, dtype=np.float64), corners


def _header(file: BinaryIO) -> str:
    """Return the header of a PLY file without comments, or what stands in its place."""
    lines = []
    for _ in range(HEADER_LINES):
        line = file.readline(LINE_BYTES)
        lines += [] if line.startswith((b"comment ", b"obj_info ")) else [line]
        if line in (b"end_header\n", b"") or (len(lines) == 1 and line != b"ply\n"):
            break
    return b"".join(lines).decode("latin-1")
