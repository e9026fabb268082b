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

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from ...arrays import BoolArray, FloatArray, IntArray
from ...threads import map_chunks
from ...network.neighbourhood import CENTRE, STRIDES
from ..cell_cases import loop_table
from ...refine.field import FineField
from ..marching import Crossings, cells_low_nodes, edge_steps, edge_table, owners_of
from ...refine.nodes import block_ijk

Index = NDArray[np.int64]
Vectors = NDArray[np.float64]
Numbers = NDArray[np.float64]
NEAR_SURFACE = 1.0  # fine spacings: slopes count at nodes that are nearer
BEND = 0.3  # change of the slopes at a node, 1 for a distance, from which there may be an edge
TEMPORARIES = 8  # numbers per node of a block
PULL = 0.5  # share of the way to the middle of its crossings that a vertex which folds its fan goes


def dot(a: Vectors, b: Vectors) -> Numbers:
    """Return the products of vectors, (n,)."""
    product: Numbers = a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]
    return product


def cross(a: Vectors, b: Vectors) -> Vectors:
    """Return the cross products of vectors, (n, 3)."""
    product: Vectors = np.empty_like(a)
    for k in range(3):
        product[..., k] = a[..., k - 2] * b[..., k - 1] - a[..., k - 1] * b[..., k - 2]
    return product


def length(vectors: Vectors) -> Numbers:
    """Return the lengths of vectors, (n,)."""
    lengths: Numbers = np.sqrt(dot(vectors, vectors))
    return lengths


def unit(vectors: Vectors) -> Vectors:
    """Return vectors of length 1; 0 stays 0."""
    units: Vectors = vectors / np.maximum(length(vectors), 1e-12)[..., None]
    return units


def sums_at(place: Index, vectors: Vectors, count: int) -> Vectors:
    """Return the sums of vectors (m, 3) at each of ``count`` places, (count, 3)."""
    return np.stack([np.bincount(place, component, count) for component in vectors.T], 1)


def voxels_near_kinks(field: FineField, threads: int = 1) -> BoolArray:
    """Return the voxels, (D,), in which slopes change at a node as at an edge."""
    bends = map_chunks(
        lambda rows: _largest_bends(field, rows),
        len(field.voxel_ijk),
        TEMPORARIES * len(field.blocks),
        threads,
    )
    near: BoolArray = np.concatenate([np.empty(0, np.float32), *bends]) > BEND
    return near


def _largest_bends(field: FineField, rows: slice) -> FloatArray:
    """Return by how much slopes change at a node near the surface, the length over the axes."""
    side, unit_slope = field.factor + 1, np.float32(2 / field.factor)
    cubes, squares = field.blocks.reshape(side, side, side, -1), np.float32(0)
    for axis in range(3):
        cube = np.moveaxis(cubes, axis, 0)
        mine = cube[..., rows]
        near = np.abs(mine) < np.float32(NEAR_SURFACE) * unit_slope
        bends = np.abs(np.diff(mine, n=2, axis=0)) * near[1:-1]
        largest = bends.reshape(-1, mine.shape[-1]).max(0)
        for step, beyond, face, within in ((-STRIDES[axis], -2, 0, 1), (STRIDES[axis], 1, -1, -2)):
            other = field.parts.table[CENTRE + step, rows]
            there = np.flatnonzero(other >= 0)
            after = cube[beyond][..., other[there]]
            bend = np.abs(after + mine[within][..., there] - 2 * mine[face][..., there])
            bend *= near[face][..., there]
            largest[there] = np.maximum(largest[there], bend.reshape(side**2, len(there)).max(0))
        squares = squares + (largest / unit_slope) ** 2
    length_of: FloatArray = np.sqrt(squares)
    return length_of


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

    row: IntArray  # (P,), the voxel of each
    low: NDArray[np.float64]  # (P, 3), the low corner of its cell, in fine spacings
    loop: Index  # (P,), which row of ``loop_table`` it is
    sides: Index  # (P,), how many crossings it has
    # (P, S), its crossings in order, counter-clockwise from outside, -1 after the last
    crossing: Index

    def chosen(self, rows: Index | slice) -> Patches:
        """Return some of the patches."""
        return Patches(
            self.row[rows], self.low[rows], self.loop[rows], self.sides[rows], self.crossing[rows]
        )

    @property
    def there(self) -> BoolArray:
        """Which entries of ``crossing`` are crossings, (P, S)."""
        return self.crossing >= 0

    def joined(self) -> tuple[Index, Index]:
        """Return the patch and the crossing of every entry of ``crossing`` that is one."""
        patch, place = np.nonzero(self.there)
        return patch, self.crossing[patch, place]


def find_patches(
    field: FineField, crossings: Crossings, voxels: BoolArray
) -> tuple[Patches, Index]:
    """Return the patches in the crossed cells of some voxels, and the crossings that they use."""
    table, factor = loop_table(), field.factor
    slot, edge_at = _edges_of(field, crossings, voxels)
    some = voxels[crossings.cell_row]
    case = crossings.case[some]
    count = table.times[case]
    cell = np.repeat(np.arange(len(count)), count)
    loop = table.first[case[cell]] + nth_of_row(cell, count)
    row = crossings.cell_row[some][cell]
    low_node = cells_low_nodes(factor)[crossings.cell[some][cell]]
    first = slot[row] * (3 * len(field.blocks)) + low_node
    edges = table.edges[loop, : table.sides[loop].max(initial=3)]  # the longest loops are rare
    at = first[:, None] + edge_steps(factor)[edges]
    there = edges >= 0
    crossing = edge_at.take(at, mode="clip")
    used = np.zeros(len(crossings.own_row), bool)
    used[crossing[there]] = True
    new = np.cumsum(used) - 1
    low = factor * field.voxel_ijk[row] + block_ijk(factor)[low_node]
    joined = np.where(there, new[np.where(there, crossing, 0)], -1)
    patches = Patches(row, low.astype(np.float64), loop, table.sides[loop], joined)
    return patches, np.flatnonzero(used)


def _edges_of(field: FineField, crossings: Crossings, voxels: BoolArray) -> tuple[Index, IntArray]:
    """Return the voxels' places in a table, (D,), and it: the crossings on their edges."""
    others = np.flatnonzero(voxels[crossings.other_row])
    listed = voxels.copy()
    listed[owners_of(field, crossings, others)[1]] = True
    slot: Index = np.cumsum(listed) - 1
    own = np.flatnonzero(listed[crossings.own_row])
    return slot, edge_table(field, crossings, slot.take, int(listed.sum()), own, others, own)


def dilate(patches: Patches, chosen: BoolArray | Index, rings: int, count: int) -> BoolArray:
    """Return which of ``count`` crossings lie within some rings of patches round chosen ones."""
    near: BoolArray = np.zeros(count + 1, bool)  # the last is of entries that are no crossings
    for _ in range(rings):
        near[patches.crossing[chosen]] = True
        near[-1] = False
        chosen = cast(BoolArray, near[patches.crossing].any(1))
    return near[:-1]


def nth_of_row(row: NDArray[Any], counts: NDArray[Any]) -> Index:
    """Return the place of each entry among those of its row; rows come in order."""
    first: Index = np.cumsum(counts) - counts
    nth: Index = np.arange(len(row)) - first[row]
    return nth


Triangles = tuple[Index, Index]
"""Patches (t,), and the corners of a triangle of each, (t, 3)."""


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

    def facing(self, corners: tuple[Index, Index, Index], crossing: Index) -> Numbers:
        """Return the cosine between triangles, corners (t,) each, and the planes of crossings."""
        a, b, c = (self.points[corner] for corner in corners)
        return dot(unit(cross(b - a, c - a)), self.normal[crossing])


class Sides(NamedTuple):
    """The sides of fans: patches, first and second crossing, vertex of the feature, (s,) each."""

    patch: Index
    start: Index
    end: Index
    peak: Index


def _sides_of(patches: Patches, placed: Placed) -> Sides:
    """Return the sides of all patches with a feature, fan by fan."""
    sides = patches.sides[placed.feature]
    fan = np.repeat(np.arange(len(sides)), sides)
    patch, nth = placed.feature[fan], nth_of_row(fan, sides)
    start = patches.crossing[patch, nth]
    end = patches.crossing[patch, (nth + 1) % patches.sides[patch]]
    return Sides(patch, start, end, len(placed.position) + fan)


def unfolded(patches: Patches, placed: Placed) -> Placed:
    """Return the vertices, those that lie beyond a side of their fan moved inwards."""
    sides = _sides_of(patches, placed)
    corners = sides.start, sides.end, sides.peak
    facing = np.maximum(placed.facing(corners, sides.start), placed.facing(corners, sides.end))
    folded = np.zeros(len(placed.feature), bool)
    folded[sides.peak[facing < 0] - len(placed.position)] = True
    inwards = np.where(folded[:, None], PULL * (middles(patches, placed) - placed.peak), 0)
    return replace(placed, peak=placed.peak + inwards)


def middles(patches: Patches, placed: Placed) -> Vectors:
    """Return the middles of the crossings of patches with a feature, (f, 3)."""
    mine, count = patches.crossing[placed.feature], patches.sides[placed.feature]
    points = np.where((mine >= 0)[..., None], placed.position[mine], 0)
    middle: Vectors = points.sum(1) / count[:, None]
    return middle


def triangles_of(patches: Patches, placed: Placed) -> Triangles:
    """Return the triangles of all patches, in their order."""
    flat = np.ones(len(patches.row), bool)
    flat[placed.feature] = False
    parts = [flat_triangles(patches, flat), *fan_triangles(patches, placed)]
    patch = np.concatenate([rows for rows, _ in parts])
    corners = np.concatenate([triangles for _, triangles in parts])
    order = np.argsort(patch, kind="stable")
    return patch[order], corners[order]


def flat_triangles(patches: Patches, chosen: BoolArray) -> Triangles:
    """Return the triangles of patches without a feature: those of marching cubes."""
    rows = np.flatnonzero(chosen)
    patch = np.repeat(rows, patches.sides[rows] - 2)
    nth = nth_of_row(patch, np.bincount(patch, minlength=len(chosen)))
    corners = loop_table().triangles[patches.loop[patch], nth]
    return patch, np.take_along_axis(patches.crossing[patch], corners, 1)


def fan_triangles(patches: Patches, placed: Placed) -> Iterator[Triangles]:
    """Yield the triangles of patches with a feature: fans, and pairs across turned sides."""
    sides = _sides_of(patches, placed)
    one, other = _turned(sides, placed)
    kept = np.ones(len(sides.patch), bool)
    kept[one] = kept[other] = False
    yield sides.patch[kept], np.stack([sides.start, sides.end, sides.peak], 1)[kept]
    a, b, peak, beyond = sides.start[other], sides.end[other], sides.peak[other], sides.peak[one]
    yield sides.patch[other], np.stack([a, beyond, peak], 1)
    yield sides.patch[other], np.stack([b, peak, beyond], 1)


def _turned(sides: Sides, placed: Placed) -> tuple[Index, Index]:
    """Return the sides that are turned, as rows of the earlier fan's and of the later one's."""

    def worst(*pairs: tuple[tuple[Index, Index, Index], Index]) -> Numbers:
        least: Numbers = np.min([placed.facing(*pair) for pair in pairs], axis=0)
        return least

    one, other = _shared(sides)
    a, b, peak, beyond = sides.start[other], sides.end[other], sides.peak[other], sides.peak[one]
    turned = worst(((a, beyond, peak), a), ((b, peak, beyond), b))
    near, far = (a, b, peak), (b, a, beyond)
    better = turned > np.minimum(worst((near, a), (near, b), (far, a), (far, b)), 0)
    return one[better], other[better]


def _shared(sides: Sides) -> tuple[Index, Index]:
    """Return the sides that two fans share, as rows of the earlier and of the later one.

    Two fans that share two sides, across an ambiguous face, keep both: turned, their vertices would
    be joined twice.
    """
    size = int(max(sides.start.max(initial=0), sides.end.max(initial=0))) + 1
    key, reverse = sides.start * size + sides.end, sides.end * size + sides.start
    order = np.argsort(key)
    last = max(len(key) - 1, 0)
    partner = order[np.minimum(np.searchsorted(key[order], reverse), last)]
    one = np.flatnonzero((key[partner] == reverse) & (np.arange(len(key)) < partner))
    other = partner[one]
    joined = sides.peak[one] * (int(sides.peak.max(initial=0)) + 1) + sides.peak[other]
    _, index, times = np.unique(joined, return_inverse=True, return_counts=True)
    once = times[index] == 1
    return one[once], other[once]
