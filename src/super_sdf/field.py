"""The fine field where it is known: blocks of nodes round the surface, never a dense array."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .band import NEIGHBOURHOOD, neighbour_table
from .grid import BoolArray, FloatArray, IntArray
from .nodes import BARELY_INSIDE, BARELY_OUTSIDE, number_shared_nodes


@dataclass(frozen=True, eq=False)
class FineField:
    """Values on the nodes of some voxels' blocks.

    Attributes
    ----------
    shape : three ints
        Samples of the coarse grid along each axis.
    factor : int
        K; the fine lattice has ``K * n + 1`` nodes along an axis of n samples.
    voxel_ijk : (D, 3) int32
        The decoded voxels, in C order.
    numbers : (D, (K+1)^3) int32
        The nodes of each voxel's block, rows of ``values``.
    values : (n,) float32
        Signed distances in half voxels, negative inside.
    band_voxels : int
        Voxels that the network saw.
    noisy_voxels : int
        Those of them round which samples differ by more than distances can.
    pinned : int
        Nodes whose sign had to be set to that of a voxel that holds no surface: where this is not
        0, the input is no distance field there, or the network failed.
    """

    shape: tuple[int, int, int]
    factor: int
    voxel_ijk: IntArray
    numbers: IntArray
    values: FloatArray
    band_voxels: int
    noisy_voxels: int
    pinned: int

    def inside_blocks(self, rows: BoolArray) -> BoolArray:
        """Say which nodes of some voxels' blocks are inside, (n, K+1, K+1, K+1)."""
        inside: BoolArray = (self.values <= 0)[self.numbers[rows]]
        return inside.reshape(-1, *(self.factor + 1,) * 3)


def border_is_crossed(field: FineField) -> bool:
    """Say whether the surface runs through the outer faces of the grid."""
    for axis, samples in enumerate(field.shape):
        for voxel, node in ((0, 0), (samples - 1, field.factor)):
            at_face = field.voxel_ijk[:, axis] == voxel
            outer = np.moveaxis(field.inside_blocks(at_face), axis + 1, 0)[node]
            if (outer.any((1, 2)) & ~outer.all((1, 2))).any():
                return True
    return False


def close_at_border(field: FineField, inside: BoolArray) -> FineField:
    """Surround the grid by voxels that are outside, so that the surface is closed at its border.

    Added are the border voxels inside the solid that were not decoded, and next to all border
    voxels a layer of outer ones. The nodes beyond the border lie on it (see ``isosurface``), so
    what is added is flat.

    Parameters
    ----------
    field : FineField
        The decoded field.
    inside : (nx, ny, nz) bool
        Which coarse samples are inside.
    """
    filled = _border_voxels(field, inside)
    border = np.concatenate([field.voxel_ijk, filled])
    outer = _outer_voxels(border, field.shape)
    voxel_ijk = np.concatenate([border, outer])
    order = np.lexsort(voxel_ijk.T[::-1])
    voxel_ijk = voxel_ijk[order]

    padded = tuple(n + 2 for n in field.shape)
    numbers, count = number_shared_nodes(neighbour_table(voxel_ijk + 1, padded), field.factor)
    place = np.argsort(order)
    decoded, solid = np.split(place[: len(border)], [len(field.voxel_ijk)])
    values = np.full(count, BARELY_OUTSIDE, np.float32)
    values[numbers[solid]] = BARELY_INSIDE
    values[numbers[decoded]] = field.values[field.numbers]
    return replace(field, voxel_ijk=voxel_ijk, numbers=numbers, values=values)


def _border_voxels(field: FineField, inside: BoolArray) -> IntArray:
    """Return the border voxels that are inside and not decoded."""
    wanted = inside.copy()
    wanted[1:-1, 1:-1, 1:-1] = False
    wanted[tuple(field.voxel_ijk.T)] = False
    return np.argwhere(wanted).astype(np.int32)


def _outer_voxels(voxel_ijk: IntArray, shape: tuple[int, int, int]) -> IntArray:
    """Return the neighbours of these voxels that lie one voxel outside the grid."""
    last = np.array(shape, np.int32) - 1
    border = voxel_ijk[((voxel_ijk == 0) | (voxel_ijk == last)).any(1)]
    around = (border[:, None] + NEIGHBOURHOOD).reshape(-1, 3)
    beyond = around[((around < 0) | (around > last)).any(1)]
    return np.unique(beyond, axis=0).astype(np.int32)
