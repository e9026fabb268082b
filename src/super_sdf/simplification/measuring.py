"""How far two surfaces lie apart: exact distances from points of one to the triangles of the other.

The points are the vertices and a pattern on every triangle, so that a largest distance is that at
these points, not a bound of all others.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..mesh import Mesh
from ..truth.solid import Distances, Points, Solid

POINTS_AT_ONCE = 1 << 18
PER_SIDE = 1.5  # points along a triangle's side of mean length


class Original:
    """A mesh before it was simplified, with a search tree, and points all over it."""

    def __init__(self, mesh: Mesh) -> None:
        self.solid = Solid(mesh)
        corners = self.solid.mesh.vertices[mesh.faces]
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        self.step = float(sides.mean()) / PER_SIDE

    @cached_property
    def points(self) -> tuple[Points, Distances]:
        """Points of the mesh and their weights: see ``points_on``."""
        points, weights = zip(*points_on(self.solid.mesh, self.step * PER_SIDE))
        return np.concatenate(points), np.concatenate(weights)

    def beyond(self, result: Mesh, distance: float) -> Points:
        """Return points, (n, 3), of either mesh that are farther than this from the other.

        The points within triangles of this mesh, which are many, are looked at only if all others
        are near enough.
        """
        tree, vertices = Solid(result), self.solid.mesh.vertices
        found = [vertices[tree.distance(vertices) > distance]]
        for points, _ in points_on(result, self.step):
            found.append(points[self.solid.distance(points) > distance])
        if not any(map(len, found)):
            within = self.points[0][len(vertices) :]
            found.append(within[tree.distance(within) > distance])
        return np.concatenate(found)

    def deviation(self, result: Mesh) -> tuple[float, float, float, float]:
        """Return how far a simplified mesh and this one lie apart: see ``Deviation``."""
        points, weights = self.points
        there = Solid(result).distance(points)
        largest = total = area = 0.0
        for some, weight in points_on(result, self.step):
            back = self.solid.distance(some)
            largest = max(largest, float(back.max(initial=0)))
            total, area = total + float(back @ weight), area + float(weight.sum())
        mean = float(there @ weights / weights.sum())
        return float(there.max()), mean, largest, total / area


def points_on(mesh: Mesh, step: float) -> Iterator[tuple[Points, Distances]]:
    """Yield points of a mesh, (n, 3), and the area that each stands for, (n,), in chunks.

    They are the vertices, which stand for none, and those of ``points_within``.
    """
    yield mesh.vertices.astype(np.float64), np.zeros(len(mesh.vertices))
    for points, weights, _ in points_within(mesh, step):
        yield points, weights


def points_within(mesh: Mesh, step: float) -> Iterator[tuple[Points, Distances, NDArray[np.int64]]]:
    """Yield points within triangles, (n, 3), their areas and triangles, (n,), in chunks.

    They are the middles of a pattern of cells on each triangle: as many along its longest side, and
    across, as are needed to be no wider than a step.
    """
    corners, row = mesh.vertices.astype(np.float64)[mesh.faces], np.arange(len(mesh.faces))
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1), axis=2)
    apex, low, high = (corners[row, (sides.argmax(1) + turn) % 3] for turn in range(3))
    area = np.linalg.norm(np.cross(low - apex, high - apex), axis=1) / 2
    side = np.linalg.norm(high - low, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        across = np.where(side > 0, 2 * area / side, 0)
    along, rows = (np.maximum(np.ceil(x / step), 1).astype(np.int64) for x in (side, across))
    ends = np.cumsum(along * rows)
    for first in range(0, int(ends[-1]) if len(ends) else 0, POINTS_AT_ONCE):
        number = np.arange(first, min(first + POINTS_AT_ONCE, ends[-1]))
        face = np.searchsorted(ends, number, side="right")
        row, column = np.divmod(number - ends[face] + along[face] * rows[face], along[face])
        v = ((row + 0.5) / rows[face])[:, None]
        u = ((column + 0.5) / along[face])[:, None]
        base = low[face] + u * (high[face] - low[face])
        # cells are narrower, and so stand for less, towards the apex
        weight = area[face] * 2 * (1 - v[:, 0]) / (along[face] * rows[face])
        yield base + v * (apex[face] - base), weight, face
