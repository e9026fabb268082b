"""How far a simplified mesh is from the mesh that it was made of, in both directions.

Between two meshes that lie close to each other, distances are largest at vertices of either mesh
and where their edges cross. So measured are the vertices of both, points along the edges and in
the triangles of the simplified mesh, and points along those edges of the original mesh whose ends
are nearest to triangles that meet at an angle. Each distance is exact, from a point to triangles.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import face_normals, length, unit
from ..surface.mesh import Mesh, row_keys
from ..truth import Points, Solid

Keys = NDArray[np.uint64]
BETWEEN = 0.97  # of the error, which no measured point exceeds: others may be a little farther away
NEAR = 0.6  # of the limit, from which on more is measured round a point or an end of an edge:
THIRDS = np.array([[-2], [-1], [1], [2]]) / 3  # of the way to the next point


class Deviation(NamedTuple):
    """Distances between a mesh and a simplified one, in world units; means are over the area."""

    largest: float  # from vertices of the mesh and points on its edges
    mean: float
    largest_back: float  # from points of the simplified mesh: vertices, on edges, in triangles
    mean_back: float


class Original:
    """A mesh before it was simplified, to measure simplified ones against.

    What was measured of one simplified mesh holds for the triangles and edges that the next one
    still has: to them, the distance of a vertex is no larger, and theirs is the same.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.solid = Solid(mesh)
        self.distance = np.full(len(mesh.vertices), np.inf)
        self.near = np.zeros(len(mesh.vertices), np.uint64)  # key of the nearest triangle
        start, end = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
        self.edges = np.stack([start, end]).take(np.flatnonzero(start < end), 1)
        self.side = float(length(np.subtract(*self.solid.mesh.vertices[self.edges])).mean())
        # of the edges: keys of what their ends and middles are near, if within the limit; distances
        self.seen = np.zeros((3, self.edges.shape[1]), np.uint64)
        self.off = np.zeros(self.edges.shape[1])
        self.keys, self.back = np.zeros(1, np.uint64), np.full((2, 1), np.inf)  # largest, mean

    def compare(self, other: Solid, error: float) -> tuple[Points, Deviation]:
        """Return points near this mesh, (n, 3), where the two are farther apart than an error."""
        limit, vertices, faces = BETWEEN * error, self.solid.mesh.vertices, self.solid.mesh.faces
        keys = row_keys(other.mesh.vertices[other.mesh.faces].reshape(-1, 9))
        face = find(self.near, keys)
        stale = (face < 0) | (self.distance > limit)
        self.distance[stale], face[stale], _ = other.nearest(vertices[stale])
        self.near = keys[face]
        bar = limit if limit < np.inf else float(self.distance.max())
        on_edges = self._bent_edges(other, keys, face, bar)
        feet, *back = self._back(other, keys, limit)
        area = length(face_normals(vertices, faces))
        mean = float(np.average(self.distance[faces].mean(1), weights=area))
        largest = float(max(self.distance.max(), self.off.max(initial=0)))
        wrong = np.concatenate([vertices[self.distance > limit], on_edges, feet])
        return wrong, Deviation(largest, mean, *back)

    def _bent_edges(self, other: Solid, keys: Keys, face: NDArray[np.intp], limit: float) -> Points:
        """Measure edges that may be farther away than their ends; return points beyond a limit.

        With its ends near two triangles that share an edge, an edge of length L is at most L / 4
        times the angle between these farther away. ``face`` is the triangle nearest to each vertex.
        """
        at_ends = self.near[self.edges]
        apart = at_ends[0] != at_ends[1]
        self.off[~apart] = 0
        some = np.flatnonzero(apart)
        is_known = (at_ends[:, some] == self.seen[:2, some]).all(0)
        some = some[~is_known | (find(self.seen[2, some], keys) < 0)]
        low, high = self.solid.mesh.vertices[self.edges[:, some]]
        corners = other.mesh.faces[face[self.edges[:, some]]]  # (2, n, 3)
        normals = unit(face_normals(other.mesh.vertices, corners.reshape(-1, 3))).reshape(2, -1, 3)
        rise = length(high - low) * length(normals[1] - normals[0]) / 4
        bent = self.distance[self.edges[:, some]].max(0) + rise > limit
        bent |= (corners[0, :, None] == corners[1, ..., None]).sum((1, 2)) < 2
        self.off[some], self.seen[:, some] = 0, at_ends[[0, 1, 0]][:, some]
        some, low, high = some[bent], low[bent], high[bent]
        middles = (low + high) / 2
        off, nearest, _ = other.nearest(middles)
        more = np.maximum(off, self.distance[self.edges[:, some]].max(0)) > NEAR * limit
        points = middles[more] + THIRDS[..., None] * (middles[more] - low[more])  # (4, n, 3)
        beside_middle = other.distance(points.reshape(-1, 3)).reshape(len(THIRDS), -1)
        wrong = middles[off > limit], points[beside_middle > limit]
        off[more] = np.maximum(off[more], beside_middle.max(0))
        self.off[some], self.seen[2, some] = off, keys[nearest] * (off <= limit)
        return np.concatenate(wrong)

    def _back(self, other: Solid, keys: Keys, limit: float) -> tuple[Points, float, float]:
        """Return the feet on this mesh of points of the other that are too far, and distances."""
        vertices, faces = other.mesh.vertices, other.mesh.faces
        sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), 1)
        number = sides[:, 0].astype(np.int64) * len(vertices) + sides[:, 1]
        _, first, edge = np.unique(number, return_index=True, return_inverse=True)
        low, high = vertices[sides[first].T]
        kinds = keys, row_keys(vertices), row_keys(np.concatenate([low, high], 1))
        ends, places = np.cumsum([len(kind) for kind in kinds]), np.concatenate(kinds)
        at = find(places, self.keys)
        is_known = (at >= 0) & (self.back[0, at] <= limit)
        known, new = np.where(is_known, self.back[:, at], 0), np.flatnonzero(~is_known)
        # points: centroids, vertices, and the middles of equal parts of edges
        triangle, vertex, some = np.split(new, np.searchsorted(new, ends[:2]))
        low, step = low[some - ends[1]], (high - low)[some - ends[1]]
        parts = np.maximum(np.ceil(length(step) / (self.side / 2)).astype(np.int64), 3)
        row, step = np.repeat(np.arange(len(some)), parts), step / parts[:, None]
        turn = np.arange(len(row)) - np.searchsorted(row, row) + 0.5
        on_edges = low[row] + turn[:, None] * step[row]
        points = vertices[faces[triangle]].mean(1), vertices[vertex - ends[0]], on_edges
        owner = np.concatenate([triangle, vertex, some[row]])
        off, _, feet = self.solid.nearest(np.concatenate(points))
        known[1, new] = (np.bincount(owner, off) / np.maximum(np.bincount(owner), 1))[new]
        near = np.flatnonzero(off > NEAR * limit)
        within, near = near[owner[near] < ends[0]], near[owner[near] >= ends[1]]
        part = near - len(triangle) - len(vertex)
        turn = (turn[part] + THIRDS).clip(0, parts[row[part]])  # (4, n)
        along = low[row[part]] + turn[..., None] * step[row[part]]
        inner = (points[0][within] + vertices[faces[triangle[within]].T]) / 2  # (3, n, 3)
        more, _, more_feet = self.solid.nearest(np.concatenate([*along, *inner]))
        off, feet = np.append(off, more), np.concatenate([feet, more_feet])
        owner = np.concatenate([owner, np.tile(owner[near], 4), np.tile(owner[within], 3)])
        np.maximum.at(known[0], owner, off)
        self.keys, self.back = places, known
        mean = known[1, : len(faces)] / 2 + known[1, ends[1] + edge.reshape(-1, 3)].mean(1) / 2
        mean = float(np.average(mean, weights=length(face_normals(vertices, faces))))
        return feet[off > limit], float(known[0].max()), mean


def find(keys: NDArray[Any], among: NDArray[Any]) -> NDArray[np.intp]:
    """Return where keys stand among others, (n,); -1 where they do not."""
    order = np.argsort(among)
    at = order[np.searchsorted(among[order], keys).clip(max=len(among) - 1)]
    return np.where(among[at] == keys, at, -1)
