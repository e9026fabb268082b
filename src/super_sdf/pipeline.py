"""The method on a page: the paper's Section 4, a named step a line.

    grid -> band -> patches and neighbours -> network -> shared nodes averaged
         -> surface moved to touch the samples' spheres -> isosurface

>>> from super_sdf import SdfGrid, reconstruct
>>> mesh = reconstruct(SdfGrid(values, spacing=0.1))            # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from .band import (
    NEIGHBOURHOOD,
    can_hold_surface,
    find_band,
    gather_patches,
    is_lipschitz,
    neighbour_table,
    rescale,
)
from .errors import GridError
from .field import FineField, close_at_border
from .grid import FloatArray, IntArray, SdfGrid
from .isosurface import extract_mesh
from .memory import check_fits
from .mesh import Mesh
from .nodes import (
    average_shared,
    block_offsets,
    check_factor,
    number_shared_nodes,
    pin_to_skipped,
)
from .spheres import Blocks, Lattice, fit_to_spheres

Progress = Callable[[int, int], None]
"""Called with (steps done, steps in all)."""

# At most, from the network's output to the mesh, for each node of each decoded block.
BYTES_PER_BLOCK_NODE = 36

STEPS = ("band", "network", "nodes", "isosurface")


class Decoder(Protocol):
    """What the pipeline asks of a network: see ``network.Network``."""

    def __call__(
        self, patches: FloatArray, table: IntArray, voxels: IntArray, offsets: FloatArray
    ) -> FloatArray:
        """Map patches (V, 27), neighbours (V, 27), voxels (D,), offsets (Q, 3) to (D, Q)."""
        ...


def upsample(
    grid: SdfGrid,
    network: Decoder,
    factor: int = 4,
    *,
    offset: float = 0.0,
    progress: Progress | None = None,
) -> FineField:
    """Refine a coarse grid near its surface.

    Parameters
    ----------
    grid : SdfGrid
        Coarse signed distances, negative inside.
    network : Network
        From ``load_network``.
    factor : int
        How many times finer, K: 2, 4, 8, 16 (any even number up to 16).
    offset : float
        Refine round the level ``values == offset`` (world units) instead of 0 (Sec. 5.3).
    progress : callable, optional
        Called with (steps done, steps in all).

    Returns
    -------
    FineField
        Values at the nodes of spacing h/K in every voxel that can hold the surface.

    Raises
    ------
    OptionError
        If the factor is odd or out of range.
    OutOfMemoryError
        If the fine values would not fit in memory.
    GridError
        If no surface is found: thin parts may pass between samples that are all outside, so this
        is known only in the end.
    """
    check_factor(factor)
    tell = progress or (lambda done, total: None)
    rescaled = rescale(grid, offset)  # Eq. 4
    band_ijk = find_band(rescaled)  # Eq. 2
    if not len(band_ijk):
        raise no_surface(grid, offset)
    patches = gather_patches(rescaled, band_ijk)
    table = neighbour_table(band_ijk, grid.shape)
    lipschitz = is_lipschitz(patches)
    voxels = np.flatnonzero(can_hold_surface(patches, lipschitz)).astype(np.int32)
    need = len(voxels) * (factor + 1) ** 3 * BYTES_PER_BLOCK_NODE
    check_fits(need, f"factor {factor} on {len(voxels):,} voxels", "use a smaller factor")
    tell(1, len(STEPS))

    blocks = network(patches, table, voxels, block_offsets(factor))  # Eqs. 3 and 5
    tell(2, len(STEPS))

    values, decoded = join_blocks(blocks, patches, table, voxels, factor)
    own_table, numbers = decoded.own_table, decoded.nodes.numbers
    voxel_ijk = band_ijk[voxels]
    skipped = skipped_neighbours(own_table, patches[voxels], voxel_ijk, grid.shape)
    pinned = pin_to_skipped(values, numbers, skipped, factor)
    if (values > 0).all() or (values <= 0).all():
        raise no_surface(grid, offset)
    tell(3, len(STEPS))
    noisy = int((~lipschitz).sum())
    return FineField(grid.shape, factor, voxel_ijk, numbers, values, len(band_ijk), noisy, pinned)


def reconstruct(
    grid: SdfGrid,
    network: Decoder | None = None,
    factor: int = 4,
    *,
    offset: float = 0.0,
    cap: bool = False,
    progress: Progress | None = None,
) -> Mesh:
    """Turn a coarse grid into a fine mesh: ``upsample``, then ``extract_mesh``.

    ``network`` is the shipped one unless given. A surface that runs out of the grid is left open
    there, or closed along the border with ``cap``. Otherwise as ``upsample``.
    """
    if network is None:
        from .network import load_network

        network = load_network()
    field = upsample(grid, network, factor, offset=offset, progress=progress)
    mesh = mesh_field(field, grid, offset=offset, cap=cap)
    if progress:
        progress(len(STEPS), len(STEPS))
    return mesh


def mesh_field(field: FineField, grid: SdfGrid, *, offset: float = 0.0, cap: bool = False) -> Mesh:
    """Mesh what ``upsample`` returned, with ``cap`` closed along the grid's border."""
    if cap:
        field = close_at_border(field, np.less_equal(rescale(grid, offset), 0))
    return extract_mesh(field, grid)


def no_surface(grid: SdfGrid, offset: float) -> GridError:
    """Return the error for a grid in which nothing is to be found."""
    low, high = grid.values.min(), grid.values.max()
    return GridError(f"no surface at {offset:g}: the values go from {low:.6g} to {high:.6g}")


def join_blocks(
    blocks: FloatArray, patches: FloatArray, table: IntArray, voxels: IntArray, factor: int
) -> tuple[FloatArray, Blocks]:
    """Return one value a node, (n,), from what each block (D, Q) says, and who has which node."""
    row_of = rows_among(voxels, len(table))
    own_table = row_of[table[voxels]]  # -1, absent, reads the last row: -1 again
    numbers, count = number_shared_nodes(own_table, factor)
    values = average_shared(blocks, numbers, count)  # Eq. 7
    decoded = Blocks(table, row_of, own_table, Lattice(numbers, count, factor))
    return fit_to_spheres(values, patches, decoded), decoded


def rows_among(voxels: IntArray, count: int) -> IntArray:
    """Return which row of ``voxels`` each of ``count`` voxels is, -1 if none; one -1 more."""
    row_of = np.full(count + 1, -1, np.int32)
    row_of[voxels] = np.arange(len(voxels), dtype=np.int32)
    return row_of


def skipped_neighbours(
    own_table: IntArray, patches: FloatArray, voxel_ijk: IntArray, shape: tuple[int, int, int]
) -> IntArray:
    """Return the sign, (D, 27), of each neighbour in the grid that was not decoded, else 0."""
    around = voxel_ijk[:, None] + NEIGHBOURHOOD
    in_grid = np.logical_and(around >= 0, around < np.array(shape)).all(axis=2)
    sign = np.where(patches > 0, 1, -1)
    return np.where((own_table < 0) & in_grid, sign, 0).astype(np.int32)
