"""The methods that reconstruct a surface from a coarse grid: ours, the baselines, our bound.

Each takes a case and a network, which only ours uses, and returns a surface.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from scipy import ndimage
from skimage.measure import marching_cubes

from ..arrays import FloatArray, IntArray
from ..errors import NoSurfaceError
from ..grid.sdf_grid import SdfGrid
from ..mesh import Mesh
from ..network.decoder import Decoder
from ..options import DEFAULT_MESHER, MARCHING, SHARP
from ..pipeline import reconstruct, refine
from ..simplification.simplify import simplify_mesh
from ..slabs.cutting import whole
from ..steps.band import neighbour_table
from ..steps.field import FineField, SampleSpheres
from ..steps.meshers import extract_mesh
from ..steps.nodes import block_ijk, share_parts
from ..steps.survey import survey
from .cases import Case, spread_samples
from .names import OURS, SIMPLIFIED, meshed_by

NUDGE = np.float32(1e-9)  # replaces exact zeros: a vertex on a node can open the surface
FACTOR_FOR_ONE = 4  # with factor 1 the field is refined so far, and meshed at the voxels' corners
FACTOR_OF_BLOCKS = 4  # of the blocks that a dense field is cut into
EMPTY = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))


@dataclass(frozen=True, eq=False)
class Surface:
    """The result of a method: a mesh, and the refined field if the method has one.

    ``field`` returns the values at the fine nodes, (K n + 1)^3, known at least in the band. It is
    a function so that it is not computed while the method is timed. ``seconds`` is how long a mesh
    took that was made in an earlier run. ``facts`` are further entries of the measurement.
    """

    mesh: Mesh
    field: Callable[[], FloatArray] | None = None
    seconds: float | None = None
    facts: Mapping[str, Any] | None = None


Method = Callable[[Case, Decoder], Surface]


@dataclass(frozen=True)
class Mesher:
    """How a mesher is run on a grid and on a dense field.

    Attributes
    ----------
    refined : callable
        Takes a coarse grid, the network and the factor; returns super-sdf's mesh, closed.
    dense : callable
        Takes a field, (n, m, l) float32, the distance between its nodes and the coordinate of the
        first one on every axis; returns the mesh. It may change the field.
    """

    refined: Callable[[SdfGrid, Decoder, int], Mesh]
    dense: Callable[[FloatArray, float, float], Mesh]


def coarse_surface(case: Case, network: Decoder, *, table: str) -> Surface:
    """Mesh the coarse grid by marching cubes; ``table`` is lorensen or lewiner."""
    field = np.array(case.grid.values)
    return Surface(isosurface(field, case.spacing, case.low + case.spacing / 2, table))


def spline_surface(case: Case, network: Decoder, *, order: int) -> Surface:
    """Mesh the spline interpolation of the coarse grid at the fine nodes."""
    field = interpolate_spline(case.grid.values, case.factor, order)
    return Surface(isosurface(field, case.fine, case.low), lambda: field)


def bound_surface(case: Case, network: Decoder, *, mesher: str = DEFAULT_MESHER) -> Surface:
    """Mesh the true distances at the fine nodes: the bound of all upsampling to them."""
    return Surface(BY_MESHER[mesher].dense(case.truth.copy(), case.fine, case.low))


def our_surface(case: Case, network: Decoder, *, mesher: str = DEFAULT_MESHER) -> Surface:
    """Mesh the coarse grid with super-sdf, in as many passes as the setting has.

    The mesh is capped where the surface leaves the grid. Without a surface it is empty.
    """
    grid = case.recognised
    try:
        for _ in range(case.setting.passes - 1):
            grid = refined_grid(grid, network, case.factor)
        if case.factor == 1:
            return Surface(mesh_corners(grid, network, mesher))
        mesh = BY_MESHER[mesher].refined(grid, network, case.factor)
    except NoSurfaceError:
        return Surface(EMPTY)
    if case.setting.passes > 1 or case.setting.noise:
        return Surface(mesh)  # its field has other nodes or another band than the protocol's
    return Surface(mesh, lambda: band_field(case.grid, network, case.factor))


def refined_grid(grid: SdfGrid, network: Decoder, factor: int) -> SdfGrid:
    """Return the fine lattice as a grid, to be refined again.

    Outside the blocks of the band its values are the nearest samples, which have the right sign
    and are outside the finer band.
    """
    field = band_field(grid, network, factor)
    nearest = spread_samples(np.asarray(grid.values, np.float32), factor)
    origin = np.array(grid.origin) - grid.voxel_size / 2
    values = np.where(np.isnan(field), nearest, field)
    return SdfGrid.trusted(values, grid.voxel_size / factor, origin)


def mesh_corners(grid: SdfGrid, network: Decoder, mesher: str) -> Mesh:
    """Mesh the refined field at the corners of the voxels only: few cells, of good values."""
    fine = band_field(grid, network, FACTOR_FOR_ONE)
    corners = fine[(slice(None, None, FACTOR_FOR_ONE),) * 3]
    samples = np.asarray(grid.values, np.float32)
    field = np.where(np.isnan(corners), spread_samples(samples, 1), corners)
    low = grid.origin[0] - grid.voxel_size / 2  # the grids of cases are cubes
    return BY_MESHER[mesher].dense(field, grid.voxel_size, low)


def simplified_surface(case: Case, network: Decoder, *, method: Method, share: int) -> Surface:
    """Simplify the mesh of a method to a share of its triangles."""
    mesh = method(case, network).mesh
    return Surface(simplified_to(mesh, len(mesh.faces) // share))


def simplified_to(mesh: Mesh, triangles: int) -> Mesh:
    """Simplify a mesh to a number of triangles."""
    return simplify_mesh(mesh, triangles=triangles).mesh if triangles < len(mesh.faces) else mesh


def band_field(grid: SdfGrid, network: Decoder, factor: int) -> FloatArray:
    """Return our distances at the fine nodes in the band's blocks, NaN elsewhere, (K n + 1)^3.

    The pipeline decodes only voxels that can hold the surface; the protocol compares all.
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
    """Mesh a dense field by marching cubes; zeros in it are replaced by ``NUDGE``.

    Parameters
    ----------
    field : (n, m, l) float32
    spacing : float
        Distance between nodes.
    low : float
        Coordinate of the first node on every axis.
    table : {"lorensen", "lewiner"}

    Returns
    -------
    Mesh
        Empty if the field has one sign only.
    """
    field[field == 0] = NUDGE
    if not field.min() < 0 < field.max():
        return EMPTY
    vertices, faces, _, _ = marching_cubes(field, 0.0, method=table)
    return Mesh(vertices.astype(np.float64) * spacing + low, faces.astype(np.int32))


def interpolate_spline(coarse: FloatArray, factor: int, order: int) -> FloatArray:
    """Return SciPy's spline interpolation of a given order at the fine nodes, (K n + 1)^3."""
    field = np.asarray(coarse, np.float32)
    for _ in range(3):  # refines the first axis and moves it to the end; after three, all in order
        field = np.tensordot(field, lattice_weights(field.shape[0], factor, order), (0, 1))
    return field


@lru_cache(maxsize=8)
def lattice_weights(n: int, factor: int, order: int) -> FloatArray:
    """Return the matrix that interpolates n samples at the K n + 1 nodes of one axis, (K n + 1, n).

    Spline interpolation is linear in the samples and separable, so one matrix for each axis does
    it, without the 3 GB of coordinates of a 513^3 lattice. In the half voxel beyond the outer
    samples, their values are continued ("nearest").
    """
    position = [np.arange(factor * n + 1) / factor - 0.5]
    columns = [
        ndimage.map_coordinates(unit, position, order=order, mode="nearest") for unit in np.eye(n)
    ]
    return np.stack(columns, axis=1).astype(np.float32)


def refined_surface(grid: SdfGrid, network: Decoder, factor: int, mesher: str) -> Mesh:
    """Mesh a grid with super-sdf and a mesher, capped at the grid's border."""
    return reconstruct(grid, network, factor=factor, cap=True, mesher=mesher)


def sharp_isosurface(field: FloatArray, spacing: float, low: float) -> Mesh:
    """Mesh a dense field, (4 n + 1)^3, by the mesher that keeps edges; see ``isosurface``."""
    if not field.min() < 0 < field.max():
        return EMPTY
    field = even_sided(field)
    factor = FACTOR_OF_BLOCKS if (len(field) - 1) % FACTOR_OF_BLOCKS == 0 else 2
    shape = tuple((nodes - 1) // factor for nodes in field.shape)
    block = block_ijk(factor)
    inside = np.stack([_node_of_blocks(field, node, factor) <= 0 for node in block])
    crossed = ndimage.binary_dilation(inside.any(0) & ~inside.all(0), np.ones((3, 3, 3)), 2)
    voxel_ijk = np.argwhere(crossed).astype(np.int32)
    values = [_node_of_blocks(field, node, factor)[crossed] for node in block]
    parts = share_parts(neighbour_table(voxel_ijk, shape))
    side = spacing * factor
    blocks = np.stack(values) * np.float32(2 / side)
    middle = blocks[len(block) // 2]
    spheres = SampleSpheres(shape, voxel_ijk, middle)
    fine = FineField(shape, factor, voxel_ijk, blocks, parts, (0, shape[0]), spheres=spheres)
    grid = SdfGrid.trusted(_node_of_blocks(field, block[0], factor), side, low + side / 2)
    return extract_mesh(fine, grid, mesher=SHARP)


def even_sided(field: FloatArray) -> FloatArray:
    """Return a field with an even number of cells along each side; the last node is repeated."""
    return np.pad(field, [(0, (nodes + 1) % 2) for nodes in field.shape], mode="edge")


def _node_of_blocks(field: FloatArray, node: IntArray, factor: int) -> FloatArray:
    """Return one node of every block of a dense field."""
    first = tuple(slice(start, start + n - factor, factor) for start, n in zip(node, field.shape))
    return field[first]


BY_MESHER: dict[str, Mesher] = {
    MARCHING: Mesher(partial(refined_surface, mesher=MARCHING), isosurface),
    SHARP: Mesher(partial(refined_surface, mesher=SHARP), sharp_isosurface),
}

METHODS: dict[str, Method] = {
    "mc": partial(coarse_surface, table="lorensen"),
    "mc-lewiner": partial(coarse_surface, table="lewiner"),
    "trilinear": partial(spline_surface, order=1),
    "bspline": partial(spline_surface, order=3),
    "ours": our_surface,
    "bound": bound_surface,
}

MESHED_METHODS: dict[str, Method] = {
    meshed_by(method, mesher): partial(surface, mesher=mesher)
    for method, surface in ((OURS, our_surface), ("bound", bound_surface))
    for mesher in BY_MESHER
}

SIMPLIFIED_METHODS: dict[str, Method] = {
    name: partial(simplified_surface, method=MESHED_METHODS[ours], share=share)
    for name, (ours, share) in SIMPLIFIED.items()
}
