"""The fine lattice as a grid of its own, whose planes are made from the sparse field when needed.

In the blocks of the field its values are the refined ones. Elsewhere, away from the surface, they
are the coarse samples interpolated trilinearly (extrapolated in the half voxel beyond the outermost
ones), with the sign of the sample whose voxel the node lies in.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray
from ..grid.field import EXACT, NOISY, NONE_EXACT, Field
from ..grid.planes import SamplePlanes
from ..grid.sdf_grid import SdfGrid
from .band import rescale
from .field import FineField
from .nodes import BARELY_INSIDE, BARELY_OUTSIDE


class FineLattice(SamplePlanes):
    """The values at all nodes of the fine lattice, in world units, negative inside.

    Node (i, j, k) is at the coarse index ``(i, j, k) / K - 1/2``. The field has the coarse grid
    that it was made from. Of a slab, the planes of nodes in its own planes of voxels are right.
    """

    dtype = np.dtype(np.float32)

    def __init__(self, field: FineField) -> None:
        self.field = field
        self.shape = lattice_shape(field.shape, field.factor)
        self.name = "the refined field"

    def read(self, first: int, last: int) -> FloatArray:
        """Return planes ``first`` to before ``last`` of nodes, (last - first, ny, nz) float32."""
        planes = np.empty((max(last - first, 0), *self.shape[1:]), np.float32)
        if len(planes):
            self._interpolate(planes, first)
            self._set_blocks(planes, first)
        for plane in planes:  # one by one, to save memory
            plane[...] = self.field.in_world_units(plane)
        return planes

    def _interpolate(self, planes: FloatArray, first: int) -> None:
        """Fill planes of nodes from ``first`` on with interpolated samples, in half voxels."""
        factor, grid = self.field.factor, self.field.placed
        last = first + len(planes)
        low, share = places_of_nodes(first, last, factor, grid.shape[0])
        nearest = voxels_of_nodes(first, last, factor, grid.shape[0])
        start, stop = int(low[0]), int(low[-1]) + 2
        samples = rescale(grid, self.field.offset, start, stop)
        for plane, before, beyond, voxel in zip(planes, low - start, share, nearest - start):
            plane[...] = self._refined(samples[before : before + 2], beyond)
            outside = self._spread(samples[voxel] > 0)
            np.maximum(plane, BARELY_OUTSIDE, out=plane, where=outside)
            np.minimum(plane, BARELY_INSIDE, out=plane, where=~outside)

    def _refined(self, pair: FloatArray, share: np.float32) -> FloatArray:
        """Return the plane of nodes at a share between two planes of samples."""
        plane: FloatArray = pair[0] * (1 - share) + pair[1] * share
        for axis, samples in enumerate(plane.shape):
            nodes = self.field.factor * samples + 1
            plane = interpolate(plane, *places_of_nodes(0, nodes, self.field.factor, samples), axis)
        return plane

    def _spread(self, mask: BoolArray) -> BoolArray:
        """Return for each node of a plane the mask of the voxel that it lies in."""
        for axis, samples in enumerate(mask.shape):
            nodes = self.field.factor * samples + 1
            mask = mask.take(voxels_of_nodes(0, nodes, self.field.factor, samples), axis)
        return mask

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


def voxels_of_nodes(first: int, last: int, factor: int, samples: int) -> NDArray[np.int64]:
    """Return for nodes of an axis the voxel that each lies in; on a face, the second one."""
    return np.minimum(np.arange(first, last) // factor, samples - 1)


def interpolate(
    plane: FloatArray, low: NDArray[np.int64], share: FloatArray, axis: int
) -> FloatArray:
    """Return a plane interpolated linearly along an axis, at ``share`` beyond the rows ``low``."""
    beyond = share[:, None] if axis == 0 else share
    result: FloatArray = plane.take(low, axis) * (1 - beyond)
    result += plane.take(low + 1, axis) * beyond
    return result


def lattice_shape(shape: tuple[int, int, int], factor: int) -> tuple[int, int, int]:
    """Return the number of nodes of the fine lattice along each axis, ``K n + 1``."""
    nx, ny, nz = (factor * samples + 1 for samples in shape)
    return nx, ny, nz


def fine_grid(field: FineField) -> SdfGrid:
    """Return the fine lattice of a whole grid's field, from ``upsample``, as a grid of spacing h/K.

    It can be refined again. Its samples are not stored: planes of them are made from the field, and
    from the coarse grid away from the surface, when they are needed. They are relative to the
    surface at the field's offset.
    """
    grid, lattice = field.placed, FineLattice(field)
    spacing = tuple(along / field.factor for along in grid.spacing)
    blocks = field.blocks
    ends = np.array([blocks.min(initial=np.inf), blocks.max(initial=-np.inf)], np.float32)
    lowest, highest = field.in_world_units(ends).tolist()
    extremes = min(lowest, grid.low - field.offset), max(highest, grid.high - field.offset)
    origin = grid.to_world([-0.5, -0.5, -0.5])
    kind = Field() if grid.field.kind == EXACT else Field(NOISY, True, NONE_EXACT)
    kind = replace(kind, on_lattice=grid.field.on_lattice)
    return SdfGrid.trusted(
        lattice,
        spacing,
        origin,
        grid.notes,
        direction=grid.direction,
        extremes=extremes,
        field=kind,
    )
