"""Whether the numbers of a mesh file can hold the fine mesh of a grid, checked before the work.

Neighbouring vertices may be as close as a thousandth of the fine spacing. Far from the world origin
float32 cannot resolve that and vertices would coincide: degenerate triangles, and a mesh that is no
longer closed when a program reads it.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ..arrays import Triple
from ..errors import FileError
from ..grid.placement import as_triple
from ..grid.sdf_grid import SdfGrid
from ..mesh import CLEARANCE, tells_vertices_apart, vertex_type
from .meshes import WORLD_ORIGIN, format_of


def check_format_holds(path: str | Path, grid: SdfGrid, factor: int) -> Triple:
    """Return the local origin for the vertices of a mesh file.

    It is the world origin, or the middle of the grid if float32 resolves neighbouring vertices only
    there and the format can store a local origin. Formats with double precision or text hold all
    that ``mesh.vertex_type`` accepts.

    Raises
    ------
    GridError
        If not even float64 resolves neighbouring vertices.
    FileError
        If the format does not resolve neighbouring vertices, whatever the local origin.
    """
    mesh_format = format_of(path)
    if vertex_type(grid, factor) is np.float32 or not mesh_format.single_precision:
        return WORLD_ORIGIN
    reach = grid.reach
    if mesh_format.local_origin:
        reach = _reach_from_middle(grid)
        if tells_vertices_apart(np.float32, reach, grid, factor):
            return _middle(grid)
    apart, suffix = CLEARANCE * grid.voxel_size / factor, Path(path).suffix.lower()
    raise FileError(
        f"{path} cannot hold the mesh: {suffix} has single precision, {_limit_at(reach)}, and "
        f"vertices are down to {apart:.2g} apart; write .ply or .obj"
    )


def local_origin_note(path: str | Path, about: Triple) -> tuple[str, ...]:
    """Return a note that names the local origin of a file, none if it is the world origin."""
    if about == WORLD_ORIGIN:
        return ()
    point = ", ".join(f"{coordinate:.12g}" for coordinate in about)
    return (
        f"{path} has single precision: its vertices are relative to {point}, "
        "the translation of its node",
    )


def _middle(grid: SdfGrid) -> Triple:
    """Return the middle of a grid, in world units."""
    axes = zip(grid.origin, grid.spacing, grid.shape)
    if grid.is_straight:
        x, y, z = (origin + spacing * (samples - 1) / 2 for origin, spacing, samples in axes)
        return x, y, z
    return as_triple(grid.to_world((np.array(grid.shape) - 1) / 2), "middle")


def _reach_from_middle(grid: SdfGrid) -> float:
    """Return the largest coordinate of the grid from its middle on, about."""
    if grid.is_straight:
        return max(spacing * samples / 2 for spacing, samples in zip(grid.spacing, grid.shape))
    sides = np.array(grid.spacing) * grid.shape / 2
    return float((np.abs(grid.direction) @ sides).max())


def _limit_at(reach: float) -> str:
    """Describe the limit of float32 at a coordinate: its largest number, or its resolution."""
    limits = np.finfo(np.float32)
    if reach > float(limits.max):
        return f"numbers up to {limits.max:.2g}, the mesh reaches {reach:.2g}"
    step = max(math.ulp(reach) * 2**29, float(limits.smallest_subnormal))  # 29 bits fewer
    return f"in steps of {step:.2g} at {reach:.6g}"
