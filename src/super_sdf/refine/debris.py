"""Leave out small pieces of the surface that no sample supports.

Where a wall or a gap is thinner than the fine lattice, the refined field has crumbs of a few nodes,
or bubbles within the solid. Such a piece is a set of nodes of one sign, joined along lattice edges,
that extends over less than a voxel. It stays

- if a sample lies in it, and is not 0;
- if it touches the sphere of an exact sample, and nothing else that stays does.

Of the others all nodes get the opposite sign. Whether they do depends on values a few voxels away
at most, so that slabs agree. Lengths are in half voxels, as in ``band``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from ..threads import map_chunks
from ..network.neighbourhood import CENTRE, NEIGHBOURHOOD, STRIDES
from .field import SampleSpheres
from .nodes import BARELY_INSIDE, BARELY_OUTSIDE, SharedParts, VoxelIndex, block_ijk
from .spheres import CELL

TOLERANCE = 0.2  # a sphere is touched by surfaces up to so far from it
LARGEST_SPHERE = 2.0  # farther samples say little of a small piece
SEEDS = 4096  # pieces that are looked at together

# Planes of voxels to either side that a value depends on: a piece, a sample whose sphere touches
# it, the nodes that this sphere touches otherwise, and the piece that these belong to.
REACH_IN_VOXELS = 4

# Places in the neighbourhood of a node: next to it along an axis; and across a face of a cell, with
# the two other corners of the face.
ALONG = np.flatnonzero(np.abs(NEIGHBOURHOOD).sum(1) == 1)
ACROSS = [
    (place, *(CENTRE + STRIDES[axis] * NEIGHBOURHOOD[place, axis] for axis in axes))
    for place in np.flatnonzero(np.abs(NEIGHBOURHOOD).sum(1) == 2)
    for axes in [np.flatnonzero(NEIGHBOURHOOD[place])]
]
Nodes = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Lattice:
    """The nodes of blocks, (Q, D + 1) float32, by their place in the fine lattice."""

    blocks: FloatArray
    factor: int
    index: VoxelIndex

    def find(self, node: Nodes) -> Nodes:
        """Return where nodes (n, 3) are among all values, -1 if in no block."""
        found = np.full(len(node), -1)
        for upper in CELL:
            left = np.flatnonzero(found < 0)
            found[left] = self._copies(node[left], upper)
        return found

    def _copies(self, node: Nodes, upper: NDArray[np.intp]) -> Nodes:
        """Return where nodes are in one of the blocks that share them: ``upper`` 1 after a face."""
        voxel = (node - 1 + upper) // self.factor
        row, inner = self.index.find(voxel), node - self.factor * voxel
        side = self.factor + 1
        place = (inner[:, 0] * side + inner[:, 1]) * side + inner[:, 2]
        return np.where(row < 0, -1, place * self.blocks.shape[1] + row)

    def set(self, node: Nodes, values: FloatArray) -> None:
        """Set the value of nodes (n, 3) in all blocks that share them."""
        for upper in CELL:
            at = self._copies(node, upper)
            self.blocks.ravel()[at[at >= 0]] = values[at >= 0]


def drop_debris(
    blocks: FloatArray, factor: int, parts: SharedParts, index: VoxelIndex, spheres: SampleSpheres
) -> tuple[IntArray, IntArray]:
    """Give the nodes of small pieces that nothing supports the opposite sign, in ``blocks``.

    Returned are the planes of voxels in which small pieces begin: of those that were dropped, and
    of those that stay because a sample that is not 0 lies in them.
    """
    lattice = Lattice(blocks, factor, index)
    node, sizes = small_pieces(lattice, find_seeds(blocks, factor, parts))
    start = np.cumsum(sizes) - sizes
    first = (np.maximum(node[start, 0] - 1, 0) // factor).astype(np.int32)
    at = lattice.find(node)
    values = blocks.ravel().take(at)
    on_sample = ((node - factor // 2) % factor == 0).all(1) & (np.abs(values) > BARELY_OUTSIDE)
    held = np.add.reduceat(on_sample, start, dtype=int) > 0 if len(start) else start > 0
    loose = at[np.repeat(~held, sizes)]
    dropped = np.zeros(len(start), bool)
    for n in np.flatnonzero(~held):
        some = slice(start[n], start[n] + sizes[n])
        dropped[n] = not is_supported(lattice, node[some], values[some], loose, spheres)
    gone = np.repeat(dropped, sizes)
    lattice.set(node[gone], np.where(values[gone] <= 0, BARELY_OUTSIDE, BARELY_INSIDE))
    return first[dropped], first[held]


def count_between(plane: IntArray, planes: tuple[int, int]) -> int:
    """Return how many of the pieces from ``drop_debris`` begin in some planes."""
    return int(np.count_nonzero((plane >= planes[0]) & (plane < planes[1])))


def find_seeds(blocks: FloatArray, factor: int, parts: SharedParts) -> Nodes:
    """Return the nodes, as voxel and place in its block (n, 2), at which small pieces may begin."""
    side, count = factor + 1, blocks.shape[1] - 1

    def seeds_of(rows: slice) -> Nodes:
        inside = (blocks[:, rows] <= 0).reshape(side, side, side, -1)
        here = inside[1:, 1:, 1:]
        first = here != inside[:-1, 1:, 1:]
        first &= here != inside[1:, :-1, 1:]
        first &= here != inside[1:, 1:, :-1]
        at = np.argwhere(first)
        place = ((at[:, 0] + 1) * side + at[:, 1] + 1) * side + at[:, 2] + 1
        return np.stack([at[:, 3] + rows.start, place], 1)

    seeds = np.concatenate([np.empty((0, 2), np.int64), *map_chunks(seeds_of, count, len(blocks))])
    for axis in range(3):  # one of the next K nodes has the other sign
        row, place = seeds.T
        inner = block_ijk(factor)[place, axis]
        beyond = parts.table[CENTRE + STRIDES[axis]].take(row)
        inside = blocks[place, row] <= 0
        ends = np.zeros(len(seeds), bool)
        for ahead in range(1, factor + 1):
            over = inner + ahead > factor
            node = place + (factor + 1) ** (2 - axis) * (ahead - factor * over)
            at = np.where(over, beyond, row)
            ends |= ((blocks[node, at] <= 0) != inside) & (at >= 0)
        seeds = seeds[ends]
    return seeds


def small_pieces(lattice: Lattice, seeds: Nodes) -> tuple[Nodes, Nodes]:
    """Return the nodes (m, 3) of pieces of at most K nodes per axis from seeds, and sizes."""
    index, factor = lattice.index, lattice.factor
    voxel = np.stack(np.unravel_index(index.keys[seeds[:, 0]], index.shape), 1)
    start = factor * voxel + block_ijk(factor)[seeds[:, 1]]
    found = [_grow(lattice, start[some : some + SEEDS]) for some in range(0, len(start), SEEDS)]
    nodes, sizes = zip((np.empty((0, 3), np.int64), np.empty(0, np.int64)), *found)
    return np.concatenate(nodes), np.concatenate(sizes)


def _grow(lattice: Lattice, start: Nodes) -> tuple[Nodes, Nodes]:
    """Return the nodes (m, 3) of the small pieces of which ``start`` are the first, and sizes.

    A node of a piece is numbered by its seed, and within it by the step from there.
    """
    reach = lattice.factor
    width = 2 * reach + 1
    box = width**3

    def unpack(number: Nodes) -> tuple[Nodes, Nodes]:
        seed, step = np.divmod(number, box)
        return seed, np.stack(np.unravel_index(step, (width,) * 3), 1) - reach

    small = np.ones(len(start), bool)
    front = np.arange(len(start)) * box + box // 2
    known = front
    while len(front):
        seed, step = unpack(front)
        beside = (step[:, None] + NEIGHBOURHOOD).reshape(-1, 3)
        at = lattice.find(start[seed].repeat(27, 0) + beside).reshape(-1, 27)
        joined = joined_nodes(lattice.blocks.ravel().take(at), at >= 0)
        joined &= small[seed, None]
        seed, beside = seed.repeat(27)[joined.ravel()], beside[joined.ravel()]
        number = seed * box + ((beside + reach) @ [width * width, width, 1])
        ends = (at < 0).reshape(-1)[joined.ravel()] | (np.abs(beside).max(1) >= reach)
        small[seed[ends | (number % box < box // 2)]] = False
        front = np.setdiff1d(number[small[seed]], known)
        known = np.concatenate([known[small[known // box]], front])
    seed, step = unpack(np.sort(known[small[known // box]]))
    node = start[seed] + step
    if not len(seed):
        return node, seed
    starts = np.flatnonzero(np.diff(seed, prepend=-1))
    sizes = np.diff(starts, append=len(seed))
    extent = np.maximum.reduceat(node, starts) - np.minimum.reduceat(node, starts)
    fits = (extent < reach).all(1)
    return node[np.repeat(fits, sizes)], sizes[fits]


def joined_nodes(values: FloatArray, known: BoolArray) -> BoolArray:
    """Return with which of the nodes around them nodes are joined in the surface, (n, 27).

    They are with nodes of their sign next to them, and with those across a face of a cell if the
    face says so (``marching``). Nodes in no block, not ``known``, have the sign of those beside.
    """
    here = values[:, CENTRE]
    same = ((values <= 0) == (here <= 0)[:, None]) | ~known
    joined: BoolArray = np.zeros(same.shape, bool)
    joined[:, ALONG] = same[:, ALONG]
    for place, one, other in ACROSS:
        across = here.astype(np.float64) * values[:, place]
        excess = across - values[:, one].astype(np.float64) * values[:, other]
        joined[:, place] = same[:, place] & ~same[:, one] & ~same[:, other]
        joined[:, place] &= np.where(here <= 0, excess > 0, excess >= 0)
    return joined


def is_supported(
    lattice: Lattice, node: Nodes, values: FloatArray, loose: Nodes, spheres: SampleSpheres
) -> bool:
    """Return whether the sphere of an exact sample touches a piece and nothing that stays.

    The piece has nodes (m, 3) with values (m,). ``loose`` is where the nodes of pieces are
    that may be dropped, from ``Lattice.find``.
    """
    if np.abs(values).max() <= BARELY_OUTSIDE:
        return False  # it has no volume
    inside = bool(values[0] <= 0)
    own = _vertices(lattice, node, values)
    for centre, radius in zip(*_spheres_beside(lattice.factor, node, inside, spheres)):
        reach = (radius + TOLERANCE) * lattice.factor / 2
        if np.linalg.norm(own - centre, axis=1).min() <= reach:
            steps = np.indices((2 * int(reach) + 3,) * 3).reshape(3, -1).T - int(reach) - 1
            around = centre + steps[np.linalg.norm(steps, axis=1) <= reach + 1]
            at = lattice.find(around)
            beside = lattice.blocks.ravel().take(at)
            rest = (at >= 0) & ((beside <= 0) == inside) & ~np.isin(at, loose)
            others = _vertices(lattice, around[rest], beside[rest])
            if np.linalg.norm(others - centre, axis=1).min(initial=np.inf) > reach:
                return True
    return False


def _vertices(lattice: Lattice, node: Nodes, values: FloatArray) -> NDArray[np.float64]:
    """Return where the surface crosses the lattice edges from nodes (n, 3), (m, 3)."""
    at = lattice.find((node[:, None] + NEIGHBOURHOOD[ALONG]).reshape(-1, 3))
    high = lattice.blocks.ravel().take(at).reshape(-1, len(ALONG)).astype(np.float64)
    low = values[:, None].astype(np.float64)
    crossed = (at >= 0).reshape(high.shape) & ((high <= 0) != (low <= 0))
    row, along = np.nonzero(crossed)
    share = (low / np.where(crossed, low - high, 1))[row, along]
    vertices: NDArray[np.float64] = node[row] + share[:, None] * NEIGHBOURHOOD[ALONG[along]]
    return vertices


def _spheres_beside(
    factor: int, node: Nodes, inside: bool, spheres: SampleSpheres
) -> tuple[Nodes, FloatArray]:
    """Return the centres (n, 3), as nodes, and radii of spheres that may touch a piece."""
    reach = int(np.ceil((LARGEST_SPHERE + TOLERANCE) / 2))
    low, high = node.min(0) // factor - reach, node.max(0) // factor + reach + 1
    around = np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), -1).reshape(-1, 3)
    row = spheres.index.find(around)
    around, row = around[row >= 0], row[row >= 0]
    radius = spheres.distance[row] * (1 if inside else -1)
    some = (radius >= 0) & (radius <= LARGEST_SPHERE)
    return factor * around[some] + factor // 2, radius[some]
