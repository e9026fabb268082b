"""How far two surfaces lie apart: exact distances from points of one to the triangles of the other.

The points are the vertices, and those of a pattern on the triangles of the simplified mesh, so that
a largest distance is that at these points, not a bound of all others. Of the unsimplified mesh, the
middles of triangles are points, too, where a corner may not be the farthest point.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..surface.mesh import Mesh, row_keys
from ..truth.solid import Distances, Points, Solid

POINTS_AT_ONCE = 1 << 18
SIDES = 2 / 3  # of the unsimplified mesh, between points of the pattern


class Original:
    """A mesh before it was simplified, and how far simplified ones were found to be from it.

    What was measured of one simplified mesh holds for the triangles that the next one still has: to
    them, the distance of a vertex is no larger, and theirs is the same.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh, self.solid = mesh, Solid(mesh)
        self.step = SIDES * mean_side(mesh)
        self.distance, self.largest_middle = np.zeros(len(mesh.vertices)), 0.0
        self.near: NDArray[np.intp] = np.full(len(mesh.vertices), -1)  # triangle, or not measured
        self.keys = np.zeros(0, np.uint64)  # of triangles of the simplified mesh, (m,)
        self.back = np.zeros((2, 0))  # their largest distance, nan if not measured; its integral

    def beyond(self, result: Mesh, distance: float) -> Points:
        """Return points of this mesh, (n, 3), where the other one is farther away than this.

        They are its vertices, or if these are near enough, the middles of its triangles, or else
        what is nearest to points of the other.
        """
        self._keep_what_stays(result)
        tree, vertices, faces = Solid(result), self.solid.mesh.vertices, self.mesh.faces
        stale = np.flatnonzero(self.near < 0)
        self.distance[stale], self.near[stale], _ = tree.nearest(vertices[stale])
        far = self.distance > distance
        self.near[far] = -1
        if far.any():
            return vertices[far]
        # Triangles are convex: one whose corners are near the same triangle of the other mesh is
        # nowhere farther from it than its corners.
        near = self.near[faces]
        middles = vertices[faces[(near[:, :1] != near[:, 1:]).any(1)]].mean(1)
        off = tree.distance(middles)
        self.largest_middle = float(off.max(initial=0))
        if self.largest_middle > distance:
            return middles[off > distance]
        return np.concatenate(list(self._measure_back(tree.mesh, distance)))

    def deviation(self, result: Mesh) -> tuple[float, float, float, float]:
        """Return how far a simplified mesh and this one lie apart: see ``Deviation``."""
        self.beyond(result, np.inf)
        area = areas(self.mesh)
        around = self.distance[self.mesh.faces].mean(1)
        return (
            max(float(self.distance.max()), self.largest_middle),
            float(around @ area / area.sum()),
            float(self.back[0].max()),
            float(self.back[1].sum() / areas(Solid(result).mesh).sum()),
        )

    def _keep_what_stays(self, result: Mesh) -> None:
        """Keep what was measured at triangles that a mesh still has."""
        keys = row_keys(result.vertices.astype(np.float64)[result.faces].reshape(-1, 9))
        order = np.argsort(keys)
        at = np.searchsorted(keys, self.keys, sorter=order) if len(keys) else self.keys
        same = order[np.minimum(at, len(keys) - 1)]
        stays = keys[same] == self.keys
        back = np.full((2, len(keys)), np.nan)
        back[:, same[stays]] = self.back[:, stays]
        self.near = np.append(np.where(stays, same, -1), -1)[self.near]
        self.keys, self.back = keys, back

    def _measure_back(self, result: Mesh, distance: float) -> Iterator[Points]:
        """Measure triangles that are not yet; yield what is nearest to those farther than this."""
        new = np.flatnonzero(np.isnan(self.back[0]))
        faces = result.faces[new]
        used, corner = np.unique(faces, return_inverse=True)
        found, _, feet = self.solid.nearest(result.vertices[used])
        yield feet[found > distance]
        largest, total = found[corner.reshape(-1, 3)].max(1, initial=0), np.zeros(len(new))
        for points, weights, face in points_within(Mesh(result.vertices, faces), self.step):
            found, _, feet = self.solid.nearest(points)
            np.maximum.at(largest, face, found)
            total += np.bincount(face, found * weights, len(new))
            yield feet[found > distance]
        self.back[:, new] = np.where(largest > distance, np.nan, largest), total


def mean_side(mesh: Mesh) -> float:
    """Return the mean length of the first sides of all triangles."""
    start, end = mesh.vertices.astype(np.float64)[mesh.faces[:, :2].T]
    return float(np.linalg.norm(end - start, axis=1).mean())


def areas(mesh: Mesh) -> Distances:
    """Return the areas of triangles, (m,)."""
    a, b, c = mesh.vertices[mesh.faces.T]
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


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
