"""The cubic lattice of a grid, on which the method works.

A grid with the same spacing on all axes is its own. Of others, the coarser axes are resampled to
the finest spacing (see ``resampling``), plane by plane. Masks, and fields that are meshed by their
spline, need no cubes: a solid stretched along an axis is as good a solid. They are refined as they
are, and the mesh gets its spacings at the end.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray
from ..errors import GridError
from ..neighbourhood import NEIGHBOURHOOD
from .placement import EQUAL_SPACING
from .resampling import Resampled, resample
from .sdf_grid import SdfGrid


def cubic_grid(grid: SdfGrid, offset: float = 0.0) -> SdfGrid:
    """Return a grid on the lattice that is refined: the grid itself, if its spacings are equal.

    So is that of a field that is no distance in the world, but on its own lattice (``Field``).

    Parameters
    ----------
    grid : SdfGrid
        Signed distances in world units.
    offset : float
        Distance of the surface to be meshed, in world units. Only values near it are as accurate
        as they can be.

    Returns
    -------
    SdfGrid
        Its samples are made when they are read. Origin and direction are those of ``grid``; its
        ``notes`` say what was resampled.

    Raises
    ------
    GridError
        If there is an offset, and the values are no distances in the world.
    """
    if grid.is_cubic or grid.field.on_lattice:
        check_has_offsets(grid, offset)
        return grid
    if grid.field.unseen is not None:
        raise GridError(
            "samples beside the surface are unknown, and the spacing differs between axes: mesh "
            "the spline of the values (--field scaled)"
        )
    level = -offset if grid.positive_inside else offset
    samples, spacing = resample(grid.samples, grid.spacing, level)
    extremes = (-grid.high, -grid.low) if grid.positive_inside else (grid.low, grid.high)
    return SdfGrid.trusted(
        samples,
        spacing,
        grid.origin,
        (*grid.notes, describe_resampling(grid, samples.shape)),
        direction=grid.direction,
        positive_inside=grid.positive_inside,
        extremes=extremes,
        field=grid.field,
    )


def check_has_offsets(grid: SdfGrid, offset: float) -> None:
    """Raise GridError if there is an offset, and no distances in the world to find it by."""
    if offset and grid.field.on_lattice and not grid.is_cubic:
        each = ", ".join(f"{h:g}" for h in grid.spacing)
        raise GridError(
            f"offset {offset:g}: the values are taken as {grid.field.kind}, and with the spacing "
            f"{each} they are no distances by which an offset surface could be found; mesh the "
            "solid itself (--offset 0), sample the mesh (super-sdf sample), and mesh that grid "
            "with the offset"
        )


def describe_resampling(grid: SdfGrid, shape: tuple[int, ...]) -> str:
    """Return a sentence that names the axes that are resampled, and their spacings."""
    coarser = [
        f"{name} from {h:.6g}"
        for name, h in zip("xyz", grid.spacing)
        if h > grid.voxel_size * (1 + EQUAL_SPACING)
    ]
    size = " x ".join(map(str, shape))
    return (
        f"the spacing differs between axes: the values are resampled along {' and '.join(coarser)} "
        f"to {grid.voxel_size:.6g}, the finest, to {size} samples"
    )


def sampled_places(grid: SdfGrid) -> NDArray[np.intp]:
    """Return the places of ``NEIGHBOURHOOD`` round a sample of a cubic grid that hold samples, too.

    They are those across the axes that were resampled.
    """
    samples, across = grid.samples, np.ones(27, bool)
    while isinstance(samples, Resampled):
        across &= NEIGHBOURHOOD[:, samples.axis] == 0
        samples = samples.source
    return np.flatnonzero(across)


def on_samples(grid: SdfGrid, voxel_ijk: NDArray[np.int32]) -> BoolArray:
    """Return which values of a cubic grid, at (n, 3) indices, are samples, not interpolated."""
    known, samples = np.ones(len(voxel_ijk), bool), grid.samples
    while isinstance(samples, Resampled):
        known &= samples.on_sample[voxel_ijk[:, samples.axis]]
        samples = samples.source
    return known
