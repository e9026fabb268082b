"""The methods that reconstruct a surface from a coarse grid: ours, the baselines, our bound, peers.

Each takes a case and a network, which only ours uses, and returns a surface. The name of a method
may say more: ``ours-marching`` is meshed by marching cubes, ``ours/4`` is simplified to a quarter
of its triangles, ``ours/within`` within .02 voxel, ``ours@base:float32`` uses that network.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import ndimage

from super_sdf.arrays import FloatArray
from super_sdf.errors import NoSurfaceError, OptionError
from super_sdf.grid.sdf_grid import SdfGrid
from super_sdf.network.contract import Decoder, adapt
from super_sdf.pipeline import extract_mesh, reconstruct, refine_band
from super_sdf.refine.band import neighbour_table, survey
from super_sdf.refine.bounds import SampleSpheres
from super_sdf.refine.field import FineField
from super_sdf.refine.nodes import block_ijk, share_parts
from super_sdf.simplify.simplify import simplify_mesh
from super_sdf.surface.mesh import Mesh

from .kinds import BY_METHOD, KINDS
from .ndc import neural_dual_contouring
from .shapes import Case
from .surfaces import EMPTY, Surface, interpolate_spline, isosurface

FACTOR_OF_BLOCKS = 4  # of the blocks that a dense field is cut into
OURS, FLOOR = "ours", "floor"  # the floor is no method: the reference measured against itself
ON = " on "
WITHIN, ERROR = "within", 0.02  # simplified within this error, in voxels

Method = Callable[[Case, Decoder], Surface]
# What tables call each method; kinds of a method follow its name: "mc-gaussian-0.5".
LABELS = {
    "mc": "marching cubes",
    "mc-lewiner": "marching cubes, Lewiner's table",
    "mc-distances": "marching cubes of SciPy's distance transform",
    "trilinear": "trilinear + marching cubes",
    "bspline": "B-spline + marching cubes",
    OURS: "super-sdf",
    "bound": "bound: true distance at the nodes",
    FLOOR: "floor: the reference against itself",
    "dual-contouring": "dual contouring of distances",
    "ndc": "neural dual contouring",
}


def coarse_surface(case: Case, network: Decoder, *, table: str) -> Surface:
    """Mesh the coarse grid by marching cubes; ``table`` is lorensen or lewiner."""
    field = np.array(case.grid.values)
    return Surface(isosurface(field, case.spacing, case.low + case.spacing / 2, table))


def spline_surface(case: Case, network: Decoder, *, order: int) -> Surface:
    """Mesh the spline interpolation of the coarse grid at the fine nodes."""
    field = interpolate_spline(case.grid.values, case.factor, order)
    return Surface(isosurface(field, case.fine, case.low), lambda: field)


def bound_surface(case: Case, network: Decoder, *, mesher: str = "marching") -> Surface:
    """Mesh the true distances at the fine nodes: the bound of all upsampling to them."""
    dense = sharp_isosurface if mesher == "sharp" else isosurface
    return Surface(dense(case.truth.copy(), case.fine, case.low))


def our_surface(case: Case, network: Decoder, *, mesher: str = "auto") -> Surface:
    """Mesh the coarse grid with super-sdf, capped where the surface leaves the grid.

    Without a surface the mesh is empty.
    """
    try:
        grid, factor = case.recognised, case.factor
        mesh = reconstruct(grid, network, factor=factor, mesher=mesher)
    except NoSurfaceError:
        return Surface(EMPTY)
    if case.setting.noise:
        return Surface(mesh)  # its field has another band than the protocol's
    return Surface(mesh, lambda: band_field(case.grid, network, factor))


def band_field(grid: SdfGrid, network: Decoder, factor: int) -> FloatArray:
    """Return our distances at the fine nodes in the band's blocks, NaN elsewhere, (K n + 1)^3.

    The pipeline decodes only voxels that can hold the surface; the protocol compares all.
    """
    band = survey(grid)
    band = replace(band, decoded=np.ones(len(band.voxel_ijk), bool))
    fine = refine_band(band, adapt(network), factor)
    nodes = factor * fine.voxel_ijk[:, None] + block_ijk(factor)  # (V, Q, 3)
    field = np.full([factor * n + 1 for n in grid.shape], np.nan, np.float32)
    world = fine.values * np.float32(grid.voxel_size / 2)
    field[tuple(np.moveaxis(nodes, 2, 0))] = world[fine.numbers]
    return field


def sharp_isosurface(field: FloatArray, spacing: float, low: float) -> Mesh:
    """Mesh a dense field, (4 n + 1)^3, by the mesher that keeps edges; see ``isosurface``."""
    if not field.min() < 0 < field.max():
        return EMPTY
    field = np.pad(field, [(0, (nodes + 1) % 2) for nodes in field.shape], mode="edge")  # even
    factor = FACTOR_OF_BLOCKS if (len(field) - 1) % FACTOR_OF_BLOCKS == 0 else 2
    shape = tuple((nodes - 1) // factor for nodes in field.shape)
    whole = sliding_window_view(field, (factor + 1,) * 3)[::factor, ::factor, ::factor]
    inside = whole.reshape(*shape, -1) <= 0
    crossed = ndimage.binary_dilation(inside.any(-1) & ~inside.all(-1), np.ones((3, 3, 3)), 2)
    voxel_ijk = np.argwhere(crossed).astype(np.int32)
    side = spacing * factor
    blocks = whole[crossed].reshape(len(voxel_ijk), -1).T * np.float32(2 / side)
    blocks = np.ascontiguousarray(blocks)
    number = np.ravel_multi_index(tuple(voxel_ijk.T), shape)
    spheres = SampleSpheres(shape, number, blocks[len(blocks) // 2])
    parts = share_parts(neighbour_table(voxel_ijk, shape))
    grid = SdfGrid.trusted(whole[..., 0, 0, 0], side, low + side / 2)
    fine = FineField(shape, factor, voxel_ijk, blocks, parts, grid, spheres=spheres)
    return extract_mesh(fine, mesher="sharp", cap=False)


def dual_contouring(case: Case, network: Decoder) -> Surface:
    """Mesh the grid with Dual Contouring of Signed Distance Data (Carrera et al. 2026)."""
    from gpytoolbox import dual_contouring_of_signed_distance_data

    shape = case.grid.shape
    order = np.arange(np.prod(shape)).reshape(shape).ravel(order="F")  # there i varies fastest
    values = np.ravel(case.grid.values).astype(np.float64)[order]
    vertices, quads = dual_contouring_of_signed_distance_data(
        values, case.grid.to_world(np.argwhere(np.ones(shape)))[order], *shape
    )
    halves = np.asarray(quads, np.int32)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    return Surface(Mesh(np.asarray(vertices), halves))


METHODS: dict[str, Method] = {
    "mc": partial(coarse_surface, table="lorensen"),
    "mc-lewiner": partial(coarse_surface, table="lewiner"),
    "trilinear": partial(spline_surface, order=1),
    "bspline": partial(spline_surface, order=3),
    OURS: our_surface,
    "bound": bound_surface,
}
BY_NAME: dict[str, Method] = {
    **METHODS,
    f"{OURS}-marching": partial(our_surface, mesher="marching"),
    "bound-sharp": partial(bound_surface, mesher="sharp"),
    "dual-contouring": dual_contouring,
    "ndc": neural_dual_contouring,
}


def make_surface(method: str, case: Case, network: Decoder) -> Surface:
    name, _, kind = method.partition("@")[0].partition(ON)
    if kind:
        return BY_METHOD[name](KINDS[kind], case, network)
    name, _, share = name.partition("/")
    if name not in BY_NAME:
        raise OptionError(f"method is {method!r}: give one of {', '.join(BY_NAME)}")
    surface = BY_NAME[name](case, network)
    mesh, count = surface.mesh, len(surface.mesh.faces)
    if share == WITHIN:
        return Surface(simplify_mesh(mesh, error=ERROR * case.spacing))
    if share:
        wanted = count // int(share) if share.isdigit() else case.triangles[share]
        return Surface(simplify_mesh(mesh, triangles=wanted)) if wanted < count else surface
    return surface
