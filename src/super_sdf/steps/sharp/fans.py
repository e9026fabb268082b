"""The triangles of patches: as marching cubes has them, or a fan round the vertex of a feature.

The side that two fans share is turned, so that it joins their vertices and runs along the edge.
Not where this would fold the surface: the triangles of a face should look as its planes do.

Vertices of the mesh are numbered here by crossing, then by feature. Positions are in fine spacings,
from node (0, 0, 0) of the fine lattice.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...arrays import BoolArray
from ..cell_cases import loop_table
from .patches import Index, Patches, nth_of_row
from .planes import Numbers, Vectors, dot, unit

PULL = 0.5  # share of the way to the middle of its crossings that a vertex which folds its fan goes

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
        return dot(unit(np.cross(b - a, c - a)), self.normal[crossing])


@dataclass(frozen=True, eq=False)
class Sides:
    """The sides of fans: patches, first and second crossing, vertex of the feature, (s,) each."""

    patch: Index
    start: Index
    end: Index
    peak: Index

    @classmethod
    def of(cls, patches: Patches, placed: Placed) -> Sides:
        """Return the sides of all patches with a feature, fan by fan."""
        sides = patches.sides[placed.feature]
        fan = np.repeat(np.arange(len(sides)), sides)
        patch, nth = placed.feature[fan], nth_of_row(fan, sides)
        start = patches.crossing[patch, nth]
        end = patches.crossing[patch, (nth + 1) % patches.sides[patch]]
        return cls(patch, start, end, len(placed.position) + fan)


def unfolded(patches: Patches, placed: Placed) -> Placed:
    """Return the vertices with those moved inwards that lie beyond a side of their fan.

    There a triangle of the fan faces away from the planes at both of its crossings.
    """
    sides = Sides.of(patches, placed)
    corners = sides.start, sides.end, sides.peak
    facing = np.maximum(placed.facing(corners, sides.start), placed.facing(corners, sides.end))
    folded = np.zeros(len(placed.feature), bool)
    folded[sides.peak[facing < 0] - len(placed.position)] = True
    mine, count = patches.crossing[placed.feature], patches.sides[placed.feature]
    points = np.where((mine >= 0)[..., None], placed.position[mine], 0)
    middle = points.sum(1) / count[:, None]
    inwards = np.where(folded[:, None], PULL * (middle - placed.peak), 0)
    return replace(placed, peak=placed.peak + inwards)


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
    sides = Sides.of(patches, placed)
    one, other = _turned(sides, placed)
    kept = np.ones(len(sides.patch), bool)
    kept[one] = kept[other] = False
    yield sides.patch[kept], np.stack([sides.start, sides.end, sides.peak], 1)[kept]
    a, b, peak, beyond = sides.start[other], sides.end[other], sides.peak[other], sides.peak[one]
    yield sides.patch[other], np.stack([a, beyond, peak], 1)
    yield sides.patch[other], np.stack([b, peak, beyond], 1)


def _turned(sides: Sides, placed: Placed) -> tuple[Index, Index]:
    """Return the sides that are turned, as rows of the earlier fan's and of the later one's."""
    one, other = _shared(sides)
    a, b, peak, beyond = sides.start[other], sides.end[other], sides.peak[other], sides.peak[one]
    turned = _worst(placed, ((a, beyond, peak), a), ((b, peak, beyond), b))
    near, far = (a, b, peak), (b, a, beyond)
    kept = _worst(placed, (near, a), (near, b), (far, a), (far, b))
    better = turned > np.minimum(kept, 0)
    return one[better], other[better]


def _worst(placed: Placed, *pairs: tuple[tuple[Index, Index, Index], Index]) -> Numbers:
    """Return the least cosine of pairs of triangles and crossings, (t,)."""
    facing = [placed.facing(corners, crossing) for corners, crossing in pairs]
    worst: Numbers = np.min(facing, axis=0)
    return worst


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
