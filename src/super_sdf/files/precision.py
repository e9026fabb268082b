"""Whether a mesh file's numbers can hold a grid's fine mesh: asked before the work starts.

Neighbouring vertices lie down to a thousandth of the fine spacing apart. Far from the world's
origin single precision has no such steps, and vertices would fall together: triangles without
area, and a mesh that is not closed any more when a program reads it.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ..arrays import Triple
from ..errors import FileError
from ..grid.sdf_grid import SdfGrid
from ..mesh import CLEARANCE, tells_vertices_apart, vertex_type
from .meshes import SINGLE_PRECISION, WITH_LOCAL_ORIGIN, WORLD_ORIGIN


def check_format_holds(path: str | Path, grid: SdfGrid, factor: int) -> Triple:
    """Return the point that the vertices in a mesh file are to count from.

    That is the world's origin, or the grid's middle where single precision tells vertices apart
    only there and the format has a place for it. A format with double precision or text holds what
    ``isosurface.vertex_type`` lets pass.

    Raises
    ------
    GridError
        If no numbers tell neighbouring vertices apart.
    FileError
        If the format cannot tell neighbouring vertices apart wherever they count from.
    """
    suffix = Path(path).suffix.lower()
    if vertex_type(grid, factor) is np.float32 or suffix not in SINGLE_PRECISION:
        return WORLD_ORIGIN
    reach = max(abs(x) + h * n for x, h, n in zip(grid.origin, grid.spacing, grid.shape))
    if suffix in WITH_LOCAL_ORIGIN:
        reach = max(spacing * samples / 2 for spacing, samples in zip(grid.spacing, grid.shape))
        if tells_vertices_apart(np.float32, reach, grid, factor):
            return _middle(grid)
    apart = CLEARANCE * grid.voxel_size / factor
    raise FileError(
        f"{path} cannot hold the mesh: {suffix} has single precision, {_limit_at(reach)}, and "
        f"vertices are down to {apart:.2g} apart; write .ply or .obj"
    )


def local_origin_note(path: str | Path, about: Triple) -> tuple[str, ...]:
    """Return the sentence that says from which point a file counts, if not the world's origin."""
    if about == WORLD_ORIGIN:
        return ()
    point = ", ".join(f"{coordinate:.12g}" for coordinate in about)
    return (
        f"{path} has single precision: its vertices count from {point}, "
        "which the translation of its node adds",
    )


def _middle(grid: SdfGrid) -> Triple:
    """Return the middle of a grid."""
    axes = zip(grid.origin, grid.spacing, grid.shape)
    x, y, z = (origin + spacing * (samples - 1) / 2 for origin, spacing, samples in axes)
    return x, y, z


def _limit_at(reach: float) -> str:
    """Say what numbers of single precision end at, or how far apart they are."""
    limits = np.finfo(np.float32)
    if reach > float(limits.max):
        return f"numbers up to {limits.max:.2g}, the mesh reaches {reach:.2g}"
    step = max(math.ulp(reach) * 2**29, float(limits.smallest_subnormal))  # 29 bits fewer
    return f"in steps of {step:.2g} at {reach:.6g}"
