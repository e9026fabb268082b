"""The fine field where it is known: blocks of nodes round the surface, never a dense array."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from ..machine.threads import in_chunks
from .nodes import SharedNodes, part_of_node


@dataclass(frozen=True, eq=False, repr=False)
class FineField:
    """Values on the nodes of some voxels' blocks: those of a whole grid, or of a slab of it.

    Attributes
    ----------
    shape : three ints
        Samples of the coarse grid along each axis.
    factor : int
        K; the fine lattice has ``K * n + 1`` nodes along an axis of n samples.
    voxel_ijk : (D, 3) int32
        The decoded voxels, in C order.
    nodes : SharedNodes
        The nodes of each voxel's block.
    values : (n,) float32
        Signed distances of the nodes in half voxels, negative inside.
    planes : two ints
        The values are final in the voxels from the first of these planes to before the second, and
        in the next plane on either side; of voxels beyond they are only a help.
    band_voxels : int
        Voxels of the whole grid that the network saw.
    noisy_voxels : int
        Those of them round which samples differ by more than distances can.
    pinned : int
        Nodes in ``planes`` whose sign had to be set to that of a voxel that holds no surface: where
        this is not 0, the input is no distance field there, or the network failed.
    """

    shape: tuple[int, int, int]
    factor: int
    voxel_ijk: IntArray
    nodes: SharedNodes
    values: FloatArray
    planes: tuple[int, int]
    band_voxels: int = 0
    noisy_voxels: int = 0
    pinned: int = 0

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.shape))
        first, last = self.planes
        return (
            f"FineField(factor {self.factor}, {len(self.values):,} nodes of "
            f"{len(self.voxel_ijk):,} voxels in planes {first} to {last - 1} of {shape})"
        )

    @property
    def numbers(self) -> IntArray:
        """The nodes of each voxel's block, (D, (K+1)^3), rows of ``values``."""
        return self.nodes.numbers()

    def rows(self, first: int, last: int) -> slice:
        """Return the rows of the voxels in planes ``first`` to before ``last``."""
        start, stop = np.searchsorted(self.voxel_ijk[:, 0], [first, last])
        return slice(int(start), int(stop))

    def plane_before(self, rows: slice) -> slice:
        """Return the rows of the voxels in the plane before that of a row."""
        plane = int(self.voxel_ijk[rows.start, 0])
        return self.rows(plane - 1, plane)

    def nodes_seen_from(self, rows: slice) -> int:
        """Return how many nodes belong to the voxels of some planes and of the plane before."""
        first = self.nodes.owned_before(self.plane_before(rows).start)
        return self.nodes.owned_before(rows.stop) - first

    def own_nodes(self) -> slice:
        """Return the nodes, rows of ``values``, that belong to voxels in ``planes``."""
        rows = self.rows(*self.planes)
        return slice(self.nodes.owned_before(rows.start), self.nodes.owned_before(rows.stop))

    def signs(self) -> set[bool]:
        """Return whether there are outer nodes in ``planes`` (True), and others (False)."""
        values = self.values[self.own_nodes()]
        if not len(values):
            return set()
        return {bool(values.min() > 0), bool(values.max() > 0)}

    def inside_blocks(self, rows: slice | IntArray) -> BoolArray:
        """Say which nodes of some voxels' blocks are inside, (n, K+1, K+1, K+1)."""
        inside: BoolArray = self.values[self.nodes.numbers(rows)] <= 0
        return inside.reshape(-1, *(self.factor + 1,) * 3)


def border_is_crossed(field: FineField) -> bool:
    """Say whether the surface runs through the outer faces of the grid, in the field's planes."""
    core = np.arange(len(field.voxel_ijk))[field.rows(*field.planes)]
    side = np.indices((field.factor + 1,) * 3).reshape(3, -1)
    for axis, samples in enumerate(field.shape):
        for voxel, node in ((0, 0), (samples - 1, field.factor)):
            at_face = core[field.voxel_ijk[core, axis] == voxel]
            outer = np.flatnonzero(side[axis] == node)
            if _any_is_crossed(field, at_face, outer):
                return True
    return False


def _any_is_crossed(field: FineField, rows: IntArray, block_nodes: NDArray[np.intp]) -> bool:
    """Say whether in any of some voxels' blocks some of these nodes are inside, and others not."""
    part, place = (array[block_nodes] for array in part_of_node(field.factor))

    def crossed(chunk: slice) -> bool:
        numbers = field.nodes.starts[rows[chunk]][:, part] + place
        inside = field.values[numbers] <= 0
        return bool((inside.any(1) & ~inside.all(1)).any())

    return any(in_chunks(len(rows), len(block_nodes), crossed))
