"""The fine field near the surface: blocks of nodes, never a dense array."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray, IntArray
from ..errors import OptionError
from ..grid.sdf_grid import SdfGrid
from ..machine.threads import chunks_of
from .nodes import (
    SharedParts,
    VoxelIndex,
    block_ijk,
    number_parts,
    part_of_node,
    part_sizes,
)


@dataclass(frozen=True, eq=False)
class SampleSpheres:
    """The spheres of exact samples: the surface touches each and pierces none."""

    shape: tuple[int, int, int]  # samples of the grid along each axis
    voxel_ijk: IntArray  # (m, 3), the samples, in C order
    distance: FloatArray  # (m,), signed, in half voxels

    @cached_property
    def index(self) -> VoxelIndex:
        """Finds which sample lies in a voxel."""
        return VoxelIndex(self.voxel_ijk, self.shape)


@dataclass(frozen=True, eq=False, repr=False)
class FineField:
    """Values at the nodes of the decoded voxels' blocks, in a whole grid or in a slab of it.

    ``positions`` and ``distances`` are the nodes in world units, each once; ``block_positions`` and
    ``block_distances`` are those of voxels, block by block. The arrays below are in index space.

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
    parts : SharedParts
        Which voxels share which nodes.
    planes : two ints
        The slab's planes of voxels, from the first to before the second. Values are final in these
        and in as many planes on either side as the mesher needs; those of other voxels are
        intermediate.
    band_voxels : int
        Voxels in the band of the whole grid.
    noisy_voxels : int
        Those of them round which samples differ by more than distances can.
    pinned : int
        Nodes in ``planes`` whose sign had to be changed to that of a voxel that holds no surface.
        If there are any, the input is not a distance field there, or the network failed.
    dropped, lone : int
        Small pieces that begin in ``planes``: dropped since nothing supports them (``debris``), and
        kept since a sample lies in them.
    spheres : SampleSpheres, optional
        The exact samples in and beside the slab, for a mesher that leans on them.
    decoded_voxels : int
        Voxels with a block in the whole grid.
    grid : SdfGrid, optional
        The coarse grid, for positions and units. That of a field from a file has no samples.
    offset : float
        The distance from the solid, in world units, of the surface at which the values are 0.
    leaves : bool
        Whether the solid may leave the grid: a sample on the border is inside. If False, a surface
        that crosses the border all the same is closed there.
    border_inside : (n, 3) int32, optional
        The voxels on the grid's border that are inside and have no block: what a cap needs of the
        samples. None if they are to be found in ``grid``.
    octants : (D,) uint8, optional
        A bit for each octant of each voxel: whether all eight samples round it are known. Where
        one is not, the surface ends. None if all are known.
    """

    shape: tuple[int, int, int]
    factor: int
    voxel_ijk: IntArray
    blocks: FloatArray
    parts: SharedParts
    planes: tuple[int, int]
    band_voxels: int = 0
    noisy_voxels: int = 0
    pinned: int = 0
    dropped: int = 0
    lone: int = 0
    spheres: SampleSpheres | None = None
    decoded_voxels: int = 0
    grid: SdfGrid | None = None
    offset: float = 0.0
    leaves: bool = True
    border_inside: IntArray | None = None
    octants: NDArray[np.uint8] | None = None

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.shape))
        first, last = self.planes
        return (
            f"FineField(factor {self.factor}, {self.parts.count_nodes(self.factor):,} nodes of "
            f"{len(self.voxel_ijk):,} voxels in planes {first} to {last - 1} of {shape})"
        )

    @cached_property
    def numbers(self) -> IntArray:
        """The nodes of each voxel's block as indices of ``values``, (D, Q); computed when read.

        Raises
        ------
        OptionError
            If there are more nodes than 32-bit numbers.
        """
        starts, _ = number_parts(self.parts, part_sizes(self.factor))
        part, place = part_of_node(self.factor)
        return starts.T[:, part] + place

    @cached_property
    def values(self) -> FloatArray:
        """The values of all nodes, each once, (n,) float32 in half voxels; computed when read."""
        values = np.empty(self.parts.count_nodes(self.factor), np.float32)
        values[self.numbers] = self.blocks.T
        return values

    @cached_property
    def node_ijk(self) -> IntArray:
        """The indices of all nodes in the fine lattice, in the order of ``values``, (n, 3) int32.

        Node (i, j, k) is at the coarse index ``(i, j, k) / K - 1/2``.
        """
        ijk = np.empty((self.parts.count_nodes(self.factor), 3), np.int32)
        ijk[self.numbers] = self._block_node_ijk(slice(None))
        return ijk

    def positions(self) -> NDArray[np.float64]:
        """Return the world positions of all nodes, each once, (n, 3).

        Raises
        ------
        OptionError
            If the field was made without its ``grid``.
        """
        return self.placed.to_world(self.node_ijk / self.factor - 0.5)

    def distances(self) -> NDArray[np.float64]:
        """Return the signed distances at ``positions``, (n,), in world units, negative inside."""
        return self.in_world_units(self.values)

    def block_positions(self, rows: slice = slice(None)) -> NDArray[np.float64]:
        """Return the world positions of the nodes of voxels' blocks, (m, Q, 3).

        Parameters
        ----------
        rows : slice
            The voxels, rows of ``voxel_ijk``; all by default.
        """
        return self.placed.to_world(self._block_node_ijk(rows) / self.factor - 0.5)

    def block_distances(self, rows: slice = slice(None)) -> NDArray[np.float64]:
        """Return the signed distances at ``block_positions``, (m, Q), in world units."""
        return self.in_world_units(self.blocks[:, rows].T)

    def in_world_units(self, values: FloatArray) -> NDArray[np.float64]:
        """Return values in half voxels as distances in world units, float64: without rounding."""
        return np.multiply(values, self.placed.voxel_size / 2, dtype=np.float64)

    @property
    def placed(self) -> SdfGrid:
        """The coarse grid; OptionError if the field was made without it."""
        if self.grid is None:
            raise OptionError("the field has no grid: make it with upsample(grid, network)")
        return self.grid

    def _block_node_ijk(self, rows: slice) -> IntArray:
        """Return the indices of the nodes of voxels' blocks in the fine lattice, (m, Q, 3)."""
        return self.factor * self.voxel_ijk[rows][:, None] + block_ijk(self.factor)

    def rows(self, first: int, last: int) -> slice:
        """Return the rows of the voxels in planes ``first`` to before ``last``."""
        ends = np.array([first, last], self._plane.dtype)  # another type would copy the array
        start, stop = np.searchsorted(self._plane, ends)
        return slice(int(start), int(stop))

    @cached_property
    def _plane(self) -> IntArray:
        """The plane of each voxel, (D,), in one piece."""
        return np.ascontiguousarray(self.voxel_ijk[:, 0])

    @property
    def own_rows(self) -> slice:
        """The rows of the voxels in ``planes``."""
        return self.rows(*self.planes)

    def plane_before(self, rows: slice) -> slice:
        """Return the rows of the voxels in the plane before that of the first of ``rows``."""
        plane = int(self.voxel_ijk[rows.start, 0])
        return self.rows(plane - 1, plane)

    def signs(self) -> set[bool]:
        """Return which signs occur in ``planes``: True if a node is outside, False if inside."""
        values = self.blocks[:, self.own_rows]
        if not values.size:
            return set()
        return {bool(values.min() > 0), bool(values.max() > 0)}


def border_is_crossed(field: FineField, beside: int = 0) -> bool:
    """Return whether the surface crosses the border of the grid, in the field's planes.

    The border is that of the fine lattice, half a voxel beyond the outermost samples. So it may be
    crossed though all samples on the border are outside. ``beside`` is how many planes to look at
    on either side of the field's own.
    """
    rows = field.rows(field.planes[0] - beside, field.planes[1] + beside)
    side = block_ijk(field.factor)
    for axis, samples in enumerate(field.shape):
        for voxel, node in ((0, 0), (samples - 1, field.factor)):
            at_face = np.flatnonzero(field.voxel_ijk[rows, axis] == voxel) + rows.start
            outer = np.flatnonzero(side[:, axis] == node)
            for chunk in chunks_of(len(at_face), len(outer)):
                inside = field.blocks[outer[:, None], at_face[chunk]] <= 0
                if (inside.any(0) & ~inside.all(0)).any():
                    return True
    return False
