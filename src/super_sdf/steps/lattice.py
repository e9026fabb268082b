"""The fine lattice as a grid of its own, whose planes are made from the sparse field when needed.

In the blocks of the field its values are the refined ones. Elsewhere, away from the surface, they
are the coarse samples interpolated trilinearly (extrapolated in the half voxel beyond the outermost
ones), with the sign of the sample whose voxel the node lies in.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..grid.planes import PlaneSource
from ..grid.sdf_grid import SdfGrid
from .band import rescale
from .field import FineField
from .nodes import BARELY_INSIDE, BARELY_OUTSIDE


class FineLattice(PlaneSource):
    """The values at all nodes of the fine lattice, in world units, negative inside.

    Node (i, j, k) is at the coarse index ``(i, j, k) / K - 1/2``.

    Parameters
    ----------
    field : FineField
        The refined field, with the coarse grid that it was made from. Of a slab, the planes of
        nodes in its own planes of voxels are right.

    Attributes
    ----------
    shape : three ints
        Nodes along each axis, ``K n + 1``.
    dtype
        float32.
    """

    dtype = np.dtype(np.float32)

    def __init__(self, field: FineField) -> None:
        self.field = field
        self.shape = lattice_shape(field.shape, field.factor)
        self.name = "the refined field"

    def read(self, first: int, last: int) -> FloatArray:
        """Return planes ``first`` to before ``last`` of nodes, (last - first, ny, nz) float32."""
        planes = self._interpolated(first, max(last, first))
        self._set_blocks(planes, first)
        return self.field.in_world_units(planes).astype(np.float32)

    def _interpolated(self, first: int, last: int) -> FloatArray:
        """Return the samples interpolated at planes of nodes, in half voxels."""
        factor, grid = self.field.factor, self.field.placed
        low, share = places_of_nodes(first, last, factor, grid.shape[0])
        start, stop = (int(low[0]), int(low[-1]) + 2) if len(low) else (0, 2)
        samples = rescale(grid, self.field.offset, start, stop)
        planes = interpolate(samples, low - start, share, 0)
        for axis in (1, 2):
            places = places_of_nodes(0, self.shape[axis], factor, grid.shape[axis])
            planes = interpolate(planes, *places, axis)
        outside = samples > 0
        for axis, ends in enumerate(((first, last), (0, self.shape[1]), (0, self.shape[2]))):
            nearest = np.minimum(np.arange(*ends) // factor, grid.shape[axis] - 1)
            outside = outside.take(nearest - start if axis == 0 else nearest, axis)
        np.maximum(planes, BARELY_OUTSIDE, out=planes, where=outside)
        np.minimum(planes, BARELY_INSIDE, out=planes, where=~outside)
        return planes

    def _set_blocks(self, planes: FloatArray, first: int) -> None:
        """Write the refined values over the planes of nodes from ``first`` on."""
        field, factor = self.field, self.field.factor
        side = factor + 1
        rows = field.rows((first - 1) // factor, (first + len(planes) - 1) // factor + 1)
        at = factor * field.voxel_ijk[rows].astype(np.int64)
        blocks = field.blocks[:, rows].reshape(side, side * side, -1)
        _, ny, nz = self.shape
        face = (np.arange(side)[:, None] * nz + np.arange(side)).ravel()
        flat = planes.reshape(-1)
        for layer, values in enumerate(blocks):
            plane = at[:, 0] + layer - first
            here = np.flatnonzero((plane >= 0) & (plane < len(planes)))
            corner = (plane[here] * ny + at[here, 1]) * nz + at[here, 2]
            flat[corner + face[:, None]] = values[:, here]


def places_of_nodes(
    first: int, last: int, factor: int, samples: int
) -> tuple[NDArray[np.int64], FloatArray]:
    """Return for nodes of an axis the sample before each, and how far beyond it in spacings.

    The share is 0 to 1, or -1/2 to 3/2 in the half voxels beyond the outermost samples.
    """
    place = np.arange(first, last) / factor - 0.5
    low = np.clip(np.floor(place), 0, samples - 2).astype(np.int64)
    return low, (place - low).astype(np.float32)


def interpolate(
    values: FloatArray, low: NDArray[np.int64], share: FloatArray, axis: int
) -> FloatArray:
    """Return values interpolated linearly along an axis, at ``share`` beyond the rows ``low``."""
    shape = [1, 1, 1]
    shape[axis] = len(share)
    beyond = share.reshape(shape)
    result: FloatArray = values.take(low, axis) * (1 - beyond)
    result += values.take(low + 1, axis) * beyond
    return result


def lattice_shape(shape: tuple[int, int, int], factor: int) -> tuple[int, int, int]:
    """Return the number of nodes of the fine lattice along each axis, ``K n + 1``."""
    nx, ny, nz = (factor * samples + 1 for samples in shape)
    return nx, ny, nz


def fine_grid(field: FineField) -> SdfGrid:
    """Return the fine lattice of a field as a grid, which can be refined again.

    Its samples are not stored: planes of them are made from the field, and from the coarse grid
    away from the surface, when they are needed.

    Parameters
    ----------
    field : FineField
        Of a whole grid, from ``upsample``.

    Returns
    -------
    SdfGrid
        Of spacing h/K. The samples are relative to the surface at the field's offset.
    """
    grid, lattice = field.placed, FineLattice(field)
    spacing = tuple(along / field.factor for along in grid.spacing)
    blocks = field.blocks
    ends = np.array([blocks.min(initial=np.inf), blocks.max(initial=-np.inf)], np.float32)
    lowest, highest = field.in_world_units(ends).tolist()
    extremes = min(lowest, grid.low - field.offset), max(highest, grid.high - field.offset)
    origin = grid.to_world([-0.5, -0.5, -0.5])
    return SdfGrid.trusted(lattice, spacing, origin, grid.notes, extremes=extremes)
