"""The meshes in a page: packed as text, and coarse marching cubes of a grid's samples.

Positions are rounded to 1/65535 of their box, compressed, in base64. In the compressed bytes follow
each other: the differences of consecutive x, then y, then z, modulo 2^16; those of consecutive
corners of the triangles, modulo 2^32; and if residuals are known, one signed byte each, 127 for
``FULL`` voxels, -128 for an unknown one. ``viewer.js`` unpacks them.
"""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import CORNERS, FloatArray
from ..check.check import FULL, Certificate
from ..errors import check_modules
from ..grid.samples import as_triple
from ..grid.sdf_grid import SdfGrid, with_fields
from ..options import MARCHING
from ..refine.band import neighbour_table, rescale
from ..refine.field import FineField
from ..refine.nodes import share_parts
from ..surface.extract import extract
from ..surface.mesh import Mesh

MOST_TRIANGLES = 500_000  # of a mesh in a page: 3 to 5 MB
STEPS = 65535  # along the longest side of the box


def packed_mesh(title: str, mesh: Mesh, certificate: Certificate | None = None) -> dict[str, Any]:
    """Return a mesh as it stands in the JSON of a page, simplified if it is large.

    With a certificate that has evidence, the residuals at its vertices are in it.
    """
    caption = f"{title}: {len(mesh.faces):,} triangles"
    if len(mesh.faces) > MOST_TRIANGLES:  # in one pass, unlike ``simplify_mesh``: only to be seen
        check_modules(f"a view of more than {MOST_TRIANGLES:,} triangles", "simplify", ("pyfqmr",))
        from ..simplify.collapsing import collapse_to

        mesh = collapse_to(mesh, np.zeros(len(mesh.faces), bool), MOST_TRIANGLES)
        caption += f", shown simplified to {len(mesh.faces):,}"
    vertices = mesh.vertices.astype(np.float64)
    low, high = (vertices.min(0), vertices.max(0)) if len(vertices) else np.zeros((2, 3))
    step = float((high - low).max()) / STEPS or 1.0
    places = np.rint((vertices - low) / step).astype(np.uint16)
    parts = [_differences(places.T), _differences(mesh.faces.astype(np.uint32))]
    has_residuals = certificate is not None and certificate.has_evidence
    if certificate and has_residuals:
        parts.append(residual_bytes(certificate.residuals_at(mesh.vertices)).tobytes())
    return {
        "caption": caption,
        "vertices": len(places),
        "triangles": len(mesh.faces),
        "low": low.tolist(),
        "step": step,
        "residuals": has_residuals,
        "data": base64.b64encode(zlib.compress(b"".join(parts), 6)).decode("ascii"),
    }


def _differences(rows: NDArray[Any]) -> bytes:
    """Return the differences of consecutive unsigned numbers, row by row; they compress better."""
    flat = np.ascontiguousarray(rows).ravel()
    return np.diff(flat, prepend=flat.dtype.type(0)).astype(flat.dtype.newbyteorder("<")).tobytes()


def residual_bytes(residuals: FloatArray) -> NDArray[np.int8]:
    """Return residuals in voxels, (n,), as bytes."""
    known = np.rint(np.clip(residuals / FULL, -1, 1) * 127)
    return np.where(np.isnan(residuals), -128, known).astype(np.int8)


def coarse_surface(grid: SdfGrid, offset: float = 0.0) -> Mesh:
    """Return marching cubes of a grid's samples: every cell is a block of factor 1."""
    values = rescale(grid, offset)
    some = every = values <= 0
    for axis in range(3):
        low, high = (slice(None),) * axis + (slice(-1),), (slice(None),) * axis + (slice(1, None),)
        some, every = some[low] | some[high], every[low] & every[high]
    cell_ijk = np.argwhere(some & ~every).astype(np.int32)
    blocks = np.stack([values[tuple((cell_ijk + corner).T)] for corner in CORNERS])
    parts = share_parts(neighbour_table(cell_ijk, some.shape))
    field = FineField(some.shape, 1, cell_ijk, blocks, parts)
    middle = as_triple(grid.to_world([0.5, 0.5, 0.5]), "middle of the first cell")
    return extract(field, with_fields(grid, origin=middle), mesher=MARCHING, cap=False)[0]
