"""The fine field near the surface: blocks of nodes, never a dense array.

``FineLattice`` is the whole fine lattice, whose planes are made when they are needed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray, IntArray
from ..grid.interpret import NONE_EXACT, Field
from ..grid.samples import SamplePlanes
from ..grid.sdf_grid import SdfGrid
from ..threads import chunks_of
from .band import rescale
from .bounds import NO_SPHERES, SampleSpheres
from .nodes import (
    BARELY_INSIDE,
    BARELY_OUTSIDE,
    SharedParts,
    block_ijk,
    nodes_of_part,
    number_parts,
)


@dataclass(frozen=True, eq=False, repr=False)
class FineField:
    """Values at the nodes of the decoded voxels' blocks.

    ``positions`` and ``distances`` return each node once, in world units. The arrays below are in
    index space.

    Attributes
    ----------
    shape : three ints
        Samples of the coarse grid along each axis.
    factor : int
        K; the fine lattice has ``K * n + 1`` nodes along an axis of n samples.
    voxel_ijk : (D, 3) int32
        The decoded voxels, in C order.
    blocks : (Q, D) float32
        Signed distances at the nodes of each voxel's block, in half voxels, negative inside. The
        Q = (K+1)^3 nodes are in C order; blocks that share a node have equal values there.
    grid : SdfGrid
        The coarse grid, for positions and units. In a field from a file the grid has no samples.
    offset : float
        World distance of the zero level from the solid.
    """

    shape: tuple[int, int, int]
    factor: int
    voxel_ijk: IntArray
    blocks: FloatArray
    parts: SharedParts  # which voxels share which nodes
    grid: SdfGrid
    offset: float = 0.0
    spheres: SampleSpheres = NO_SPHERES  # by which the mesher "sharp" places vertices
    # Whether the solid may leave the grid: a sample on the border is inside. If False, a surface
    # that crosses the border all the same is closed there
    leaves: bool = True
    # (n, 3), voxels on the border that are inside and have no block; None: found in the grid
    border_inside: IntArray | None = None
    # (D,), a bit for each octant of each voxel: whether all eight samples round it are known. Where
    # one is not, the surface ends. None if all are known
    octants: NDArray[np.uint8] | None = None

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.shape))
        return f"FineField(factor {self.factor}, {len(self.voxel_ijk):,} voxels of {shape})"

    @cached_property
    def numbers(self) -> IntArray:
        """The nodes of each voxel's block as indices of ``values``, (D, Q); computed when read."""
        numbers = np.empty(self.blocks.shape[::-1], np.int32)
        starts, _ = number_parts(self.parts, self.factor)
        for first, nodes in zip(starts, nodes_of_part(self.factor)):
            numbers[:, nodes] = first[:, None] + np.arange(len(nodes))
        return numbers

    @cached_property
    def values(self) -> FloatArray:
        """The values of all nodes, each once, (n,) float32 in half voxels; computed when read."""
        values = np.empty(self.numbers.max(initial=-1) + 1, np.float32)
        values[self.numbers] = self.blocks.T
        return values

    @cached_property
    def node_ijk(self) -> IntArray:
        """The indices of all nodes in the fine lattice, in the order of ``values``, (n, 3)."""
        ijk = np.empty((self.numbers.max(initial=-1) + 1, 3), np.int32)
        ijk[self.numbers] = self.factor * self.voxel_ijk[:, None] + block_ijk(self.factor)
        return ijk

    def positions(self) -> NDArray[np.float64]:
        """Return the world positions of all nodes, each once, (n, 3)."""
        return self.grid.to_world(self.node_ijk / self.factor - 0.5)

    def distances(self) -> NDArray[np.float64]:
        """Return the signed distances at ``positions``, (n,), in world units, negative inside."""
        return self.in_world_units(self.values)

    def in_world_units(self, values: FloatArray) -> NDArray[np.float64]:
        """Return values in half voxels as distances in world units, float64: without rounding."""
        return np.multiply(values, self.grid.voxel_size / 2, dtype=np.float64)


class FineLattice(SamplePlanes):
    """The values at all nodes of the fine lattice, in world units, negative inside.

    Node (i, j, k) is at the coarse index ``(i, j, k) / K - 1/2``. Away from the blocks the coarse
    samples are interpolated trilinearly, and extrapolated in the half voxel beyond the outermost
    ones; a node there has the sign of the sample in whose voxel it lies.
    """

    dtype = np.dtype(np.float32)
    name = "the refined field"

    def __init__(self, field: FineField) -> None:
        self.field, self.beside = field, field.factor
        self.shape = tuple(field.factor * samples + 1 for samples in field.shape)

    def read(self, first: int, last: int) -> FloatArray:
        """Return planes ``first`` to before ``last`` of nodes, (last - first, ny, nz) float32."""
        field, factor, grid = self.field, self.field.factor, self.field.grid
        start = max((first - 1) // factor - 1, 0)  # coarse planes on which those of nodes depend
        planes = rescale(grid, field.offset, start, min((last - 1) // factor + 2, grid.shape[0]))
        outside = planes > 0
        for axis, count in enumerate(grid.shape):
            node = np.arange(first, last) if axis == 0 else np.arange(self.shape[axis])
            place, shift = node / factor - 0.5, start if axis == 0 else 0
            # the sample before each node and how far beyond it, 0 to 1 spacing, or -1/2 to 3/2 in
            # the half voxels beyond the outermost samples; a node on a face is in the second voxel
            low = np.clip(np.floor(place), 0, count - 2).astype(np.int64)
            share = (place - low).astype(np.float32).reshape(-1, *(1,) * (2 - axis))
            below = planes.take(low - shift, axis) * (1 - share)
            planes = below + planes.take(low - shift + 1, axis) * share
            outside = outside.take(np.minimum(node // factor, count - 1) - shift, axis)
        np.maximum(planes, BARELY_OUTSIDE, out=planes, where=outside)
        np.minimum(planes, BARELY_INSIDE, out=planes, where=~outside)

        ends = (first - 1) // factor, (last - 1) // factor + 1  # of the voxels with nodes there
        rows = slice(*np.searchsorted(field.voxel_ijk[:, 0], ends).tolist())
        corner, nodes = factor * field.voxel_ijk[rows].T, block_ijk(factor).T[:, :, None]
        corner[0] -= first
        for some in chunks_of(corner.shape[1], 8 * nodes.shape[1]):
            i, j, k = corner[:, None, some] + nodes
            here = (i >= 0) & (i < len(planes))
            planes[i[here], j[here], k[here]] = field.blocks[:, rows][:, some][here]
        return np.multiply(planes, grid.voxel_size / 2, out=planes, dtype="f8", casting="same_kind")


def fine_grid(field: FineField) -> SdfGrid:
    """Return the fine lattice of a field, from ``upsample``, as a grid of spacing h/K.

    The grid can be refined again. Samples are relative to the surface at the field's offset, and
    computed plane by plane, when they are read, from the field and the coarse grid.
    """
    grid, blocks = field.grid, field.blocks
    ends = np.array([blocks.min(initial=np.inf), blocks.max(initial=-np.inf)])
    lowest, highest = field.in_world_units(ends).tolist()
    kind = Field() if grid.field.exact == (-np.inf, np.inf) else Field("noisy", True, NONE_EXACT)
    return SdfGrid.trusted(
        FineLattice(field),
        tuple(along / field.factor for along in grid.spacing),
        grid.to_world([-0.5, -0.5, -0.5]),
        grid.flagged,
        direction=grid.direction,
        extremes=(min(lowest, grid.low - field.offset), max(highest, grid.high - field.offset)),
        field=replace(kind, own_lattice=grid.field.own_lattice),
    )
