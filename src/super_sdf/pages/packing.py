"""Meshes as text in a page: positions to 1/65535 of their box, compressed, in base64.

In the compressed bytes follow each other: the differences of consecutive x, then y, then z, modulo
2^16; those of consecutive corners of the triangles, modulo 2^32; and if residuals are known, one
signed byte each, 127 for ``FULL`` voxels, -128 for an unknown one. ``viewer.js`` unpacks them.
"""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..certificate.coloured import FULL
from .shown import Shown

STEPS = 65535  # along the longest side of the box
MOST, UNKNOWN = 127, -128  # of a residual's byte


def pack(shown: Shown) -> dict[str, Any]:
    """Return a mesh as it stands in the JSON of a page."""
    low, step, places = quantise(shown.mesh.vertices)
    parts = [differences(places.T), differences(shown.mesh.faces.astype(np.uint32))]
    if shown.residuals is not None:
        parts.append(residual_bytes(shown.residuals).tobytes())
    return {
        "caption": shown.caption(),
        "vertices": len(places),
        "triangles": len(shown.mesh.faces),
        "low": [float(x) for x in low],
        "step": step,
        "residuals": shown.residuals is not None,
        "data": base64.b64encode(zlib.compress(b"".join(parts), 6)).decode("ascii"),
    }


def quantise(
    vertices: NDArray[Any],
) -> tuple[NDArray[np.float64], float, NDArray[np.uint16]]:
    """Return the lowest corner, the step, and positions in steps from it, (n, 3)."""
    if not len(vertices):
        return np.zeros(3), 1.0, np.zeros((0, 3), np.uint16)
    wide = vertices.astype(np.float64)
    low = wide.min(0)
    step = float((wide.max(0) - low).max()) / STEPS or 1.0
    return low, step, np.rint((wide - low) / step).astype(np.uint16)


def differences(rows: NDArray[Any]) -> bytes:
    """Return the differences of consecutive unsigned numbers, row by row; they compress better."""
    flat = np.ascontiguousarray(rows).ravel()
    return np.diff(flat, prepend=flat.dtype.type(0)).astype(flat.dtype.newbyteorder("<")).tobytes()


def residual_bytes(residuals: FloatArray) -> NDArray[np.int8]:
    """Return residuals in voxels, (n,), as bytes."""
    known = np.rint(np.clip(residuals / FULL, -1, 1) * MOST)
    return np.where(np.isnan(residuals), UNKNOWN, known).astype(np.int8)
