"""What a page shows of a result: its mesh, coarse marching cubes, and a small picture.

A mesh is text in the page: positions to 1/65535 of their box, compressed, in base64. In the
compressed bytes follow each other: the differences of consecutive x, then y, then z, modulo 2^16;
those of consecutive corners of the triangles, modulo 2^32; and if residuals are known, one signed
byte each, 127 for ``FULL`` voxels, -128 for an unknown one. ``viewer.js`` unpacks them.
"""

from __future__ import annotations

import base64
import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..check.check import FULL, Certificate
from ..grid.sdf_grid import SdfGrid
from ..surface.mesh import CLEARANCE, Mesh
from ..network.neighbourhood import CENTRE, CORNERS, STRIDES
from ..simplify.collapsing import collapse_to
from ..simplify.measuring import points_within
from ..simplify.simplify import check_room
from ..surface.cell_cases import EDGE_AXIS, EDGE_START, tables
from ..refine.survey import Band

MOST_TRIANGLES = 200_000  # of a mesh in a page: 1 to 2 MB, and fluent without a GPU
STEPS = 65535  # along the longest side of the box
MOST, UNKNOWN = 127, -128  # of a residual's byte

# Of the picture: pixels along its long side, the view from the front, the right and above with z
# up, the direction of the light in it (right, down, towards the viewer), the colour of the mesh.
LONG_SIDE, MARGIN = 160, 4
VIEW = 0.6, -1.0, 0.5
LIGHT = 0.35, -0.45, 1.0
COLOUR = 185, 199, 223
LEVELS, COVERS = 32, 5  # brightnesses, and how many of the 4 points of a pixel are on the mesh


def packed_mesh(
    title: str, mesh: Mesh, certificate: Certificate | None = None, max_memory: int | None = None
) -> dict[str, Any]:
    """Return a mesh as it stands in the JSON of a page, simplified if it is large.

    With a certificate that has evidence, the residuals at its vertices are in it.
    """
    small, caption = mesh, f"{title}: {len(mesh.faces):,} triangles"
    if len(mesh.faces) > MOST_TRIANGLES:  # in one pass, unlike ``simplify_mesh``: only to be seen
        check_room(len(mesh.faces), max_memory)
        small = collapse_to(mesh, np.zeros(len(mesh.faces), bool), MOST_TRIANGLES)
        caption += f", shown simplified to {len(small.faces):,}"
    low, step, places = _quantised(small.vertices)
    parts = [_differences(places.T), _differences(small.faces.astype(np.uint32))]
    has_residuals = certificate is not None and certificate.has_evidence
    if certificate and has_residuals:
        parts.append(residual_bytes(certificate.residuals_at(small.vertices)).tobytes())
    return {
        "caption": caption,
        "vertices": len(places),
        "triangles": len(small.faces),
        "low": [float(x) for x in low],
        "step": step,
        "residuals": has_residuals,
        "data": base64.b64encode(zlib.compress(b"".join(parts), 6)).decode("ascii"),
    }


def _quantised(vertices: NDArray[Any]) -> tuple[NDArray[np.float64], float, NDArray[np.uint16]]:
    """Return the lowest corner, the step, and positions in steps from it, (n, 3)."""
    if not len(vertices):
        return np.zeros(3), 1.0, np.zeros((0, 3), np.uint16)
    wide = vertices.astype(np.float64)
    low = wide.min(0)
    step = float((wide.max(0) - low).max()) / STEPS or 1.0
    return low, step, np.rint((wide - low) / step).astype(np.uint16)


def _differences(rows: NDArray[Any]) -> bytes:
    """Return the differences of consecutive unsigned numbers, row by row; they compress better."""
    flat = np.ascontiguousarray(rows).ravel()
    return np.diff(flat, prepend=flat.dtype.type(0)).astype(flat.dtype.newbyteorder("<")).tobytes()


def residual_bytes(residuals: FloatArray) -> NDArray[np.int8]:
    """Return residuals in voxels, (n,), as bytes."""
    known = np.rint(np.clip(residuals / FULL, -1, 1) * MOST)
    return np.where(np.isnan(residuals), UNKNOWN, known).astype(np.int8)


def coarse_surface(band: Band, grid: SdfGrid) -> Mesh:
    """Return marching cubes of the samples in a band, in world units.

    ``grid`` is the lattice of the band. The grid is not read: every cell that the surface crosses
    has a corner in the band, and the samples around that.
    """
    number, values = _crossed_cells(band)
    table, case = tables(), (values <= 0) @ (1 << np.arange(8))
    times = table.times[case]
    nth = np.arange(times.sum()) + np.repeat(table.first[case] - (np.cumsum(times) - times), times)
    edge = table.triangles[nth].ravel()
    cell = np.repeat(np.arange(len(case)), 3 * times)
    start, axis = np.array(EDGE_START)[edge], np.array(EDGE_AXIS)[edge]
    low = np.stack(np.unravel_index(number[cell], band.shape), 1) + CORNERS[start]
    key = 3 * np.ravel_multi_index(tuple(low.T), band.shape) + axis
    _, first, corners = np.unique(key, return_index=True, return_inverse=True)
    low, axis, cell, start = low[first], axis[first], cell[first], start[first]
    a, b = values[cell, start], values[cell, start + np.array([4, 2, 1])[axis]]
    position = low.astype(np.float64)
    position[np.arange(len(first)), axis] += np.clip(a / (a - b), CLEARANCE, 1 - CLEARANCE)
    faces = corners.astype(np.int32).reshape(-1, 3)
    faces = np.ascontiguousarray(faces[:, ::-1]) if grid.is_mirrored else faces
    return Mesh(grid.to_world(position), faces)


def _crossed_cells(band: Band) -> tuple[NDArray[np.int64], FloatArray]:
    """Return the low corners, numbered in the grid (c,), and the values (c, 8) of crossed cells."""
    numbers, values = [], []
    for corner in CORNERS:
        around = band.patches[:, CENTRE + (CORNERS - corner) @ STRIDES]
        inside, low = around <= 0, band.voxel_ijk - corner
        crossed = inside.any(1) & ~inside.all(1)
        crossed &= ((low >= 0) & (low < np.array(band.shape) - 1)).all(1)
        numbers.append(np.ravel_multi_index(tuple(low[crossed].T), band.shape))
        values.append(around[crossed])
    found, first = np.unique(np.concatenate(numbers), return_index=True)
    return found, np.concatenate(values)[first]


def thumbnail(mesh: Mesh) -> str | None:
    """Return a small picture of a mesh as a data URL, some 4 kB; None if it has no face.

    It is drawn point by point, at two points per pixel and axis; the nearest one is seen.
    """
    if not len(mesh.faces):
        return None
    turned, wide, tall = _turned_to_fit(mesh)
    a, b, c = turned.vertices[turned.faces.T]
    normals = np.cross(b - a, c - a)
    light = np.array(LIGHT) / np.linalg.norm(LIGHT)
    with np.errstate(invalid="ignore"):
        lit = normals @ light * np.sign(normals[:, 2]) / np.linalg.norm(normals, axis=1)
    level = np.rint((LEVELS - 1) * np.nan_to_num(np.clip(lit, 0, 1))).astype(np.uint8)
    nearest, seen = np.full(wide * tall, -np.inf), np.zeros(wide * tall, np.uint8)
    for points, _, face in points_within(turned, 0.7):
        x, y, z = points.T
        pixel = y.astype(np.intp) * wide + x.astype(np.intp)
        np.maximum.at(nearest, pixel, z)
        front = z == nearest[pixel]
        seen[pixel[front]] = level[face[front]]
    return "data:image/png;base64," + base64.b64encode(_png(nearest, seen, wide)).decode("ascii")


def _turned_to_fit(mesh: Mesh) -> tuple[Mesh, int, int]:
    """Return a mesh in half pixels: right, down, and towards the viewer; and width and height."""
    towards = np.array(VIEW) / np.linalg.norm(VIEW)
    right = np.cross([0, 0, 1], towards)
    right /= np.linalg.norm(right)
    axes = np.stack([right, -np.cross(towards, right), towards])
    used = mesh.vertices[np.unique(mesh.faces)].astype(np.float64) @ axes.T
    low, size = used.min(0), np.ptp(used, axis=0)
    scale = 2 * (LONG_SIDE - 2 * MARGIN) / (size[:2].max() or 1.0)
    wide, tall = (2 * (round(scale * side / 2) + 2 * MARGIN) for side in size[:2])
    place = (mesh.vertices.astype(np.float64) @ axes.T - low) * scale + 2 * MARGIN
    return Mesh(place, mesh.faces), wide, tall


def _png(nearest: NDArray[np.float64], seen: NDArray[np.uint8], wide: int) -> bytes:
    """Return a PNG of half as many pixels each way, from whether and how bright each is seen."""
    on = np.isfinite(nearest).reshape(-1, 2, wide // 2, 2)
    cover = on.sum((1, 3))
    bright = seen.reshape(on.shape).sum((1, 3)) // np.maximum(cover, 1)
    rows = (bright * COVERS + cover).astype(np.uint8)
    level, share = np.divmod(np.arange(LEVELS * COVERS), COVERS)
    colour = np.outer(0.25 + 0.75 * level / (LEVELS - 1), COLOUR)
    palette = np.rint(255 + (colour - 255) * (share / (COVERS - 1))[:, None]).astype(np.uint8)
    lines = np.insert(rows, 0, 0, axis=1).tobytes()  # each begins with its filter: none
    parts = {
        b"IHDR": struct.pack(">IIBBBBB", rows.shape[1], rows.shape[0], 8, 3, 0, 0, 0),
        b"PLTE": palette.tobytes(),
        b"IDAT": zlib.compress(lines, 9),
        b"IEND": b"",
    }
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in parts.items()
    )
