"""Voxels that may hold an edge, the patches of the surface in their cells, and their triangles.

On a fine grid almost all of a surface is smooth. Finding that out block by block, by the second
differences along each axis, takes a fraction of the time of looking for edges.

A patch is a piece of the surface in one cell: a loop of crossed lattice edges, from one to the
next across the faces of the cell. Two cells that share a face share the crossings on it.

The triangles of a patch are those of marching cubes, or a fan round the vertex of a feature. The
side that two fans share is turned, so that it joins their vertices and runs along the edge. Not
where this would fold the surface: the triangles of a face should look as its planes do. Vertices
of the mesh are numbered here by crossing, then by feature.

Positions are in fine spacings, from node (0, 0, 0) of the fine lattice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from ...arrays import (
    CENTRE,
    STRIDES,
    BoolArray,
    FloatArray,
    Index,
    IntArray,
    Numbers,
    Vectors,
    dot,
    unit,
)
from ...refine.field import FineField
from ...refine.nodes import block_ijk
from ...threads import map_chunks
from ..marching import (
    Crossings,
    cells_low_nodes,
    edge_steps,
    edge_table,
    owners_of,
    tables,
    values_at,
)

NEAR_SURFACE = 1.0  # fine spacings: slopes count at nodes that are nearer
BEND = 0.3  # change of the slopes at a node, 1 for a distance, from which there may be an edge
TEMPORARIES = 8  # numbers per node of a block
PULL = 0.5  # share of the way to the middle of its crossings that a vertex which folds its fan goes


def voxels_near_kinks(field: FineField, threads: int = 1) -> BoolArray:
    """Return the voxels, (D,), in which slopes change at a node as at an edge."""
    work, width = partial(_largest_bends, field), TEMPORARIES * len(field.blocks)
    bends = map_chunks(work, len(field.voxel_ijk), width, threads)
    near: BoolArray = np.concatenate([np.empty(0, np.float32), *bends]) > BEND
    return near


def _largest_bends(field: FineField, rows: slice) -> FloatArray:
    """Return by how much slopes change at a node near the surface, the length over the axes."""
    side, unit_slope = field.factor + 1, np.float32(2 / field.factor)
    nodes, squares = np.arange(side**3).reshape(side, side, side), np.float32(0)
    blocks = field.blocks.reshape(*nodes.shape, -1)[..., rows]
    near_surface = np.abs(blocks) < np.float32(NEAR_SURFACE) * unit_slope
    for axis in range(3):
        mine, near, node = (np.moveaxis(each, axis, 0) for each in (blocks, near_surface, nodes))
        steps = mine[1:] - mine[:-1]
        bends = np.abs(steps[1:] - steps[:-1])
        largest = np.multiply(bends, near[1:-1], out=bends).max((0, 1, 2))
        for step, beyond, face, within in ((-STRIDES[axis], -2, 0, 1), (STRIDES[axis], 1, -1, -2)):
            other = field.parts.table[CENTRE + step, rows]
            after = values_at(field, node[beyond][..., None], other)
            bends = after + mine[within] - 2 * mine[face]
            counts = near[face] & (other >= 0)
            largest = np.maximum(largest, (np.abs(bends) * counts).max((0, 1)))
        squares = squares + (largest / unit_slope) ** 2
    return np.sqrt(cast(FloatArray, squares))


def beside(field: FineField, chosen: BoolArray, rings: int) -> BoolArray:
    """Return the voxels, (D,), within some rings of voxels round chosen ones."""
    for _ in range(rings):
        for axis in range(3):
            step = int(STRIDES[axis])
            before, after = field.parts.table[CENTRE - step], field.parts.table[CENTRE + step]
            chosen = chosen | (chosen[before] & (before >= 0)) | (chosen[after] & (after >= 0))
    return chosen


@dataclass(frozen=True, eq=False)
class Patches:
    """The patches of the surface in the crossed cells of some blocks, in the order of the cells."""

    cell: Index  # (P,), the crossed cell of each, a row of the crossings
    row: IntArray  # (P,), its voxel
    low: NDArray[np.float64]  # (P, 3), the low corner of its cell, in fine spacings
    loop: Index  # (P,), which loop of the case tables it is
    sides: Index  # (P,), how many crossings it has
    # (P, S), its crossings in order, counter-clockwise from outside, -1 after the last
    crossing: Index

    def chosen(self, rows: Any) -> Patches:
        """Return some of the patches, by their rows or a slice."""
        if isinstance(rows, slice):
            return Patches(*(values[rows] for values in vars(self).values()))
        return Patches(*(values.take(rows, 0) for values in vars(self).values()))

    def mean(self, vectors: Vectors) -> Vectors:
        """Return the mean of the vectors (n, 3) at the crossings of each patch, (P, 3)."""
        total = np.zeros((len(self.sides), 3))
        for crossing in self.crossing.T:
            there = np.flatnonzero(crossing >= 0)
            total[there] += vectors.take(crossing[there], 0)
        return total / self.sides[:, None]

    def having(self, chosen: BoolArray) -> BoolArray:
        """Return which patches have some of the chosen crossings, (P,)."""
        found = np.append(chosen, False)  # -1 reads the last; by columns, as rows are short
        return cast(BoolArray, np.logical_or.reduce([found.take(c) for c in self.crossing.T]))

    def dilate(self, chosen: BoolArray | Index, rings: int, count: int) -> BoolArray:
        """Return which of ``count`` crossings are within some rings of patches of chosen ones."""
        near: BoolArray = np.zeros(count + 1, bool)  # the last is of entries that are no crossings
        for _ in range(rings):
            near[self.crossing[chosen]] = True
            near[-1] = False
            chosen = self.having(near[:-1])
        return near[:-1]


def find_patches(
    field: FineField, crossings: Crossings, voxels: BoolArray
) -> tuple[Patches, Index]:
    """Return the patches in the crossed cells of some voxels, and the crossings that they use.

    These are own edges of ``crossings``; patches count among those used.
    """
    table, factor = tables(), field.factor
    others = np.flatnonzero(voxels[crossings.other_row])
    listed = voxels.copy()
    listed[owners_of(field, crossings, others)[1]] = True
    slot = np.cumsum(listed) - 1
    own = np.flatnonzero(listed[crossings.own_row])
    edge_at = edge_table(field, crossings, slot.take, int(listed.sum()), own, others, own)
    some = np.flatnonzero(voxels[crossings.cell_row])
    count = table.loops[crossings.case[some]]
    cell = np.repeat(some, count)
    loop = table.first_loop[crossings.case[cell]] + nth_of_run(count)
    row, low_node = crossings.cell_row[cell], cells_low_nodes(factor)[crossings.cell[cell]]
    first = slot[row] * (3 * len(field.blocks)) + low_node
    sides = table.sides[loop].astype(np.int64)
    edges = table.edges[loop, : sides.max(initial=3)]  # the longest loops are rare
    there = edges >= 0
    crossing = edge_at.take(first[:, None] + edge_steps(factor)[edges], mode="clip")
    used = np.zeros(len(crossings.own_row), bool)
    used[crossing[there]] = True
    new = np.cumsum(used) - 1
    crossing[~there] = 0
    joined = np.where(there, new[crossing], -1)
    low = factor * field.voxel_ijk[row] + block_ijk(factor)[low_node]
    return Patches(cell, row, low.astype(np.float64), loop, sides, joined), np.flatnonzero(used)


def nth_of_run(counts: NDArray[Any]) -> Index:
    """Return the index of each entry within its run, given the lengths of consecutive runs."""
    nth: Index = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return nth


@dataclass(frozen=True, eq=False)
class Placed:
    """Where the vertices of patches are."""

    # position, normal: (n, 3), of the crossings: positions, and the normals of their planes
    position: Vectors
    normal: Vectors
    feature: Index  # (f,), the patches that hold an edge or a corner
    peak: Vectors  # (f, 3), the vertices on these

    @cached_property
    def points(self) -> Vectors:
        """All vertices in the order of their numbers, (n + f, 3)."""
        return np.concatenate([self.position, self.peak])

    def facing(self, corners: tuple[Index, Index, Index], *crossings: Index) -> Numbers:
        """Return the least cosine between triangles, corners (t,) each, and planes of crossings."""
        a, b, c = (self.points.take(corner, 0) for corner in corners)
        normal = unit(np.cross(b - a, c - a))
        least = [dot(normal, self.normal.take(at, 0)) for at in crossings]
        return least[0] if len(least) == 1 else np.minimum(*least)

    def unfolded(self, patches: Patches) -> Placed:
        """Return the same with vertices that lie beyond a side of their fan moved inwards."""
        sides = _sides_of(patches, self)
        corners = sides.start, sides.end, sides.peak
        beyond = (self.facing(corners, sides.start) < 0) & (self.facing(corners, sides.end) < 0)
        folded = np.zeros(len(self.feature), bool)
        folded[sides.peak[beyond] - len(self.position)] = True
        middle = patches.chosen(self.feature).mean(self.position)
        inwards = np.where(folded[:, None], PULL * (middle - self.peak), 0)
        return replace(self, peak=self.peak + inwards)


Triangles = tuple[Index, Index]
"""Patches (t,), and the corners of a triangle of each, (t, 3)."""


class Sides(NamedTuple):
    """The sides of fans: patches, first and second crossing, vertex of the feature, (s,) each."""

    patch: Index
    start: Index
    end: Index
    peak: Index


def _sides_of(patches: Patches, placed: Placed) -> Sides:
    """Return the sides of all patches with a feature, fan by fan."""
    sides = patches.sides[placed.feature]
    fan, nth = np.repeat(np.arange(len(sides)), sides), nth_of_run(sides)
    patch = placed.feature[fan]
    start = patches.crossing[patch, nth]
    end = patches.crossing[patch, np.where(nth + 1 < sides[fan], nth + 1, 0)]
    return Sides(patch, start, end, len(placed.position) + fan)


def triangles_of(patches: Patches, placed: Placed, chosen: BoolArray) -> Triangles:
    """Return the triangles of chosen patches, (P,), as if there were no others."""
    known = np.flatnonzero(chosen[placed.feature])
    flat = chosen.copy()
    flat[placed.feature] = False
    rows = np.flatnonzero(flat)
    times = patches.sides[rows] - 2
    patch, nth = np.repeat(rows, times), nth_of_run(times)
    places = tables().places[patches.loop[patch], nth].astype(np.int64)
    plain = np.take_along_axis(patches.crossing[patch], places, 1)
    some = replace(placed, feature=placed.feature[known], peak=placed.peak[known])
    parts = [(patch, plain), *_fan_triangles(patches, some)]
    number = np.concatenate([np.arange(len(placed.position)), len(placed.position) + known])
    return (
        np.concatenate([rows for rows, _ in parts]),
        np.concatenate([plain, *(number[corners] for _, corners in parts[1:])]),
    )


def _fan_triangles(patches: Patches, placed: Placed) -> list[Triangles]:
    """Return the triangles of patches with a feature: fans, and pairs across turned sides."""
    sides = _sides_of(patches, placed)
    one, other = _turned(sides, placed)
    kept = np.ones(len(sides.patch), bool)
    kept[one] = kept[other] = False
    a, b, peak, beyond = sides.start[other], sides.end[other], sides.peak[other], sides.peak[one]
    return [
        (sides.patch[kept], np.stack([sides.start, sides.end, sides.peak], 1)[kept]),
        (sides.patch[other], np.stack([a, beyond, peak], 1)),
        (sides.patch[other], np.stack([b, peak, beyond], 1)),
    ]


def _turned(sides: Sides, placed: Placed) -> tuple[Index, Index]:
    """Return the sides that are turned, as rows of the earlier fan's and of the later one's."""
    one, other = _shared(sides)
    a, b, peak, beyond = sides.start[other], sides.end[other], sides.peak[other], sides.peak[one]
    turned = placed.facing((a, beyond, peak), a), placed.facing((b, peak, beyond), b)
    kept = placed.facing((a, b, peak), a, b), placed.facing((b, a, beyond), a, b)
    better = np.minimum(*turned) > np.minimum(np.minimum(*kept), 0)
    return one[better], other[better]


def _shared(sides: Sides) -> tuple[Index, Index]:
    """Return the sides that two fans share, as rows of the earlier and of the later one.

    Two fans that share two sides, across an ambiguous face, keep both: turned, their vertices would
    be joined twice.
    """
    size = int(max(sides.start.max(initial=0), sides.end.max(initial=0))) + 1
    key = np.minimum(sides.start, sides.end) * size + np.maximum(sides.start, sides.end)
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(np.diff(key[order]) == 0)  # no side is that of three fans
    one, other = order[same], order[same + 1]
    joined = sides.peak[one] * (int(sides.peak.max(initial=0)) + 1) + sides.peak[other]
    _, index, times = np.unique(joined, return_inverse=True, return_counts=True)
    once = times[index] == 1
    return one[once], other[once]
