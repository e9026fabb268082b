"""Binary PLY with a colour and a residual for each vertex."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..mesh import Mesh
from .output import replacing
from .ply import ply_rows
from .spool import CHUNK, write_in_chunks

COLOURS = ("red", "green", "blue")


def write_coloured_ply(
    mesh: Mesh,
    residuals: FloatArray,
    colours: NDArray[np.uint8],
    path: Path,
    *,
    force: bool = False,
) -> None:
    """Write binary little-endian PLY, complete or not at all.

    Parameters
    ----------
    mesh : Mesh
        Its positions are written as double.
    residuals : (n,) float32
        The property ``residual`` of each vertex.
    colours : (n, 3) uint8
        Red, green and blue.
    path : Path
        The file.
    force : bool
        Replace it if it exists.

    Raises
    ------
    WriteError
        If it cannot be written.
    """
    kind = np.dtype([("position", "<f8", 3), ("residual", "<f4"), ("colour", "u1", 3)])
    with replacing(path, force=force) as part, part.open("wb") as file:
        file.write(_header(len(mesh.vertices), len(mesh.faces)))
        for first in range(0, len(mesh.vertices), CHUNK):
            chunk = slice(first, first + CHUNK)
            rows = np.empty(len(residuals[chunk]), kind)
            rows["position"], rows["residual"] = mesh.vertices[chunk], residuals[chunk]
            rows["colour"] = colours[chunk]
            file.write(rows.tobytes())
        write_in_chunks(file, mesh.faces, ply_rows)


def _header(vertices: int, faces: int) -> bytes:
    """Return the header."""
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment made by super-sdf",
        "comment residual: distance of samples to the mesh minus their value, in voxels",
        f"element vertex {vertices}",
        *(f"property double {axis}" for axis in "xyz"),
        "property float residual",
        *(f"property uchar {name}" for name in COLOURS),
        f"element face {faces}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    return "\n".join(lines).encode("ascii")
