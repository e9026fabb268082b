"""The methods that make a surface of a coarse grid: ours, what it is compared with, its bound.

Each is given a case and a network, which only ours runs, and returns a surface in the frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from scipy import ndimage
from skimage.measure import marching_cubes

from ..arrays import FloatArray
from ..errors import NoSurfaceError
from ..grid.sdf_grid import SdfGrid
from ..mesh import Mesh
from ..network.decoder import Decoder
from ..pipeline import reconstruct, refine
from ..slabs.cutting import whole
from ..steps.nodes import block_ijk
from ..steps.survey import survey
from .cases import Case, spread_samples

NUDGE = np.float32(1e-9)  # what an exact zero becomes: a vertex on a node can open the surface
EMPTY = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))


@dataclass(frozen=True, eq=False)
class Surface:
    """What a method made: a mesh, and if it refines the field, a way to its values.

    ``field`` returns the values at the fine nodes, (K n + 1)^3, known at least in the band. It is
    a function because only measuring asks for it, after the clock has stopped.
    """

    mesh: Mesh
    field: Callable[[], FloatArray] | None = None


Method = Callable[[Case, Decoder], Surface]


def coarse_surface(case: Case, network: Decoder, *, table: str) -> Surface:
    """Mesh the coarse grid as it is, by one of scikit-image's tables: lorensen or lewiner."""
    field = np.array(case.grid.values)
    return Surface(isosurface(field, case.spacing, case.low + case.spacing / 2, table))


def spline_surface(case: Case, network: Decoder, *, order: int) -> Surface:
    """Mesh the spline interpolation of the coarse grid at the fine nodes."""
    field = interpolate_spline(case.grid.values, case.factor, order)
    return Surface(isosurface(field, case.fine, case.low), lambda: field)


def bound_surface(case: Case, network: Decoder) -> Surface:
    """Mesh the true distance at the fine nodes: what no upsampling to them can beat."""
    return Surface(isosurface(case.truth.copy(), case.fine, case.low))


def our_surface(case: Case, network: Decoder) -> Surface:
    """Mesh the coarse grid with super-sdf, as often as the setting says.

    Capped, as one would ask who wants solids: where no surface leaves the grid that changes
    nothing. Where no surface is found, the mesh is empty.
    """
    grid = case.grid
    try:
        for _ in range(case.setting.passes - 1):
            grid = refined_grid(grid, network, case.factor)
        mesh = reconstruct(grid, network, factor=case.factor, cap=True)
    except NoSurfaceError:
        return Surface(EMPTY)
    if case.setting.passes > 1 or case.setting.noise:
        return Surface(mesh)  # no field of the very nodes and voxels that the protocol compares
    return Surface(mesh, lambda: band_field(case.grid, network, case.factor))


def refined_grid(grid: SdfGrid, network: Decoder, factor: int) -> SdfGrid:
    """Return the fine lattice as a grid, to be refined once more: all blocks of the band.

    Elsewhere stands the nearest sample: it has the right sign, and is beyond the finer band.
    """
    field = band_field(grid, network, factor)
    rest = spread_samples(np.asarray(grid.values, np.float32), factor)
    first = np.array(grid.origin) - grid.voxel_size / 2
    values = np.where(np.isnan(field), rest, field)
    return SdfGrid.trusted(values, grid.voxel_size / factor, first)


def band_field(grid: SdfGrid, network: Decoder, factor: int) -> FloatArray:
    """Return our distances at all nodes of the band's blocks, NaN elsewhere.

    The pipeline decodes only the voxels that can hold the surface; the protocol asks for all.
    """
    band = survey(grid)
    band = replace(band, decoded=np.ones(len(band.voxel_ijk), bool))
    fine = refine(band, network, factor, whole(band))
    nodes = factor * fine.voxel_ijk[:, None] + block_ijk(factor)  # (V, Q, 3)
    field = np.full([factor * n + 1 for n in grid.shape], np.nan, np.float32)
    world = fine.values * np.float32(grid.voxel_size / 2)
    field[tuple(np.moveaxis(nodes, 2, 0))] = world[fine.numbers]
    return field


def isosurface(field: FloatArray, spacing: float, low: float, table: str = "lorensen") -> Mesh:
    """Mesh a dense field, zeros nudged in place; empty if it has one sign only."""
    field[field == 0] = NUDGE
    if not field.min() < 0 < field.max():
        return EMPTY
    vertices, faces, _, _ = marching_cubes(field, 0.0, method=table)
    return Mesh(vertices.astype(np.float64) * spacing + low, faces.astype(np.int32))


def interpolate_spline(coarse: FloatArray, factor: int, order: int) -> FloatArray:
    """Return SciPy's spline interpolation of that order at the fine nodes, (K n + 1)^3."""
    field = np.asarray(coarse, np.float32)
    for _ in range(3):  # takes the first axis and puts its nodes last: three times, all in place
        field = np.tensordot(field, lattice_weights(field.shape[0], factor, order), (0, 1))
    return field


@lru_cache(maxsize=8)
def lattice_weights(n: int, factor: int, order: int) -> FloatArray:
    """Return the weights of n samples in the K n + 1 nodes of one axis, (K n + 1, n).

    A spline is linear in the samples and a product over the axes, so this is the interpolation of
    a whole grid, without the 3 GB of coordinates of a 513^3 lattice. Beyond the outer samples,
    half a voxel on each side, it continues the last one ("nearest").
    """
    position = [np.arange(factor * n + 1) / factor - 0.5]
    columns = [
        ndimage.map_coordinates(unit, position, order=order, mode="nearest") for unit in np.eye(n)
    ]
    return np.stack(columns, axis=1).astype(np.float32)


METHODS: dict[str, Method] = {
    "mc": partial(coarse_surface, table="lorensen"),
    "mc-lewiner": partial(coarse_surface, table="lewiner"),
    "trilinear": partial(spline_surface, order=1),
    "bspline": partial(spline_surface, order=3),
    "ours": our_surface,
    "bound": bound_surface,
}
