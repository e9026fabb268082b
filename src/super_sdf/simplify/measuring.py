"""How far a simplified mesh is from the mesh that it was made of, in both directions.

Between two meshes that lie close to each other, distances are largest at vertices of either mesh
and where their edges cross. So measured are the vertices of both, points along the edges of the
simplified mesh, its centroids, and points along those edges of the original mesh whose ends are
nearest to triangles that meet at an angle. Each distance is exact, from a point to triangles.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import face_normals, length, unit
from ..surface.mesh import Mesh, row_keys
from ..truth.solid import Points, Solid

Keys = NDArray[np.uint64]
BETWEEN = 0.97  # of the error, which no measured point exceeds: others may be a little farther away
SHARES = np.array([[[1]], [[2]], [[4]], [[5]]]) / 6  # where an edge is measured beside its middle,
SUSPECT = 0.35  # if that is as far away as this share of the limit
NEAR = 0.6  # of the limit, from which on edges of the simplified mesh get four times the points


class Deviation(NamedTuple):
    """Distances between a mesh and a simplified one, in world units; means are over the area."""

    largest: float  # from vertices of the mesh and points on its edges
    mean: float
    largest_back: float  # from vertices of the simplified mesh, points on its edges, and centroids
    mean_back: float


class Original:
    """A mesh before it was simplified, to measure simplified ones against.

    What was measured of one simplified mesh holds for the triangles and edges that the next one
    still has: to them, the distance of a vertex is no larger, and theirs is the same.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.solid, self.side = Solid(mesh), mean_side(mesh)
        self.distance = np.full(len(mesh.vertices), np.inf)
        self.near = np.zeros(len(mesh.vertices), np.uint64)  # key of the nearest triangle
        start, end = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
        self.edges = np.stack([start, end])[:, start < end]
        # of the edges: keys of what their ends and middles are near, if within the limit; distances
        self.seen = np.zeros((3, self.edges.shape[1]), np.uint64)
        self.off = np.zeros(self.edges.shape[1])
        self.keys, self.back = np.zeros(1, np.uint64), np.full((2, 1), np.inf)  # largest, mean

    def compare(self, other: Solid, error: float) -> tuple[Points, Deviation]:
        """Return points near this mesh, (n, 3), where the two are farther apart than an error.

        Without bounds of the error, the points mean nothing.
        """
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
        mean = float(self.distance[faces].mean(1) @ area / area.sum())
        largest = float(max(self.distance.max(), self.off.max(initial=0)))
        wrong = np.concatenate([vertices[self.distance > limit], on_edges, feet])
        return wrong, Deviation(largest, mean, *back)

    def _bent_edges(self, other: Solid, keys: Keys, face: NDArray[np.intp], limit: float) -> Points:
        """Measure edges that may be farther away than their ends; return points beyond a limit.

        With its ends on two triangles that share an edge, an edge of length L is at most L / 4
        times the largest angle away that one of these makes with those beside it. ``face`` is the
        triangle that each vertex is nearest to.
        """
        at_ends = self.near[self.edges]
        self.off[at_ends[0] == at_ends[1]] = 0
        is_known = (at_ends == self.seen[:2]).all(0) & np.isin(self.seen[2], keys)
        some = np.flatnonzero((at_ends[0] != at_ends[1]) & ~is_known)
        one, next_one = face[self.edges[:, some]]
        normals = unit(face_normals(other.mesh.vertices / self.side, other.mesh.faces))
        beside = other.mesh.pair_edges()[0].reshape(-1, 3) // 3
        angle = length(normals[:, None] - normals[beside]).max(1)
        low, high = self.solid.mesh.vertices[self.edges[:, some]]
        rise = length(high - low) * np.maximum(angle[one], angle[next_one]) / 4
        bent = self.distance[self.edges[:, some]].max(0) + rise > limit
        bent |= (beside[one] != next_one[:, None]).all(1)
        self.off[some], self.seen[:, some] = 0, at_ends[[0, 1, 0]][:, some]
        some, low, high = some[bent], low[bent], high[bent]
        middles = (low + high) / 2
        off, nearest, _ = other.nearest(middles)
        more = (off > SUSPECT * limit) & (off <= limit)
        points = low[more] + SHARES * (high[more] - low[more])  # (4, n, 3)
        beside_middle = other.distance(points.reshape(-1, 3)).reshape(len(SHARES), -1)
        wrong = middles[off > limit], points[beside_middle > limit]
        off[more] = np.maximum(off[more], beside_middle.max(0))
        self.off[some], self.seen[2, some] = off, keys[nearest] * (off <= limit)
        return np.concatenate(wrong)

    def _back(self, other: Solid, keys: Keys, limit: float) -> tuple[Points, float, float]:
        """Return the feet on this mesh of points of the other that are too far, and distances."""
        vertices, faces, count = other.mesh.vertices, other.mesh.faces, len(keys)
        sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), 1)
        number = sides.astype(np.int64) @ [len(vertices), 1]
        _, first, edge = np.unique(number, return_index=True, return_inverse=True)
        ends = vertices[sides[first]]
        places = np.concatenate([keys, row_keys(ends.reshape(-1, 6))])  # triangles, then edges
        at = find(places, self.keys)
        is_known = (at >= 0) & (self.back[0, at] <= limit)
        known, new = np.where(is_known, self.back[:, at], 0), np.flatnonzero(~is_known)
        owner, edges = new[new < count], new[new >= count]
        points, step = vertices[faces[owner]].mean(1), self.side / 2
        wrong, sums = [np.zeros((0, 3))], np.zeros((2, len(places)))
        for _ in range(2):  # both ends, and points between them no farther apart than a step
            low, high = ends[edges - count].transpose(1, 0, 2)
            parts = np.maximum(np.ceil(length(high - low) / step).astype(np.int64), 3)
            row = np.repeat(np.arange(len(edges)), parts + 1)
            share = (np.arange(len(row)) - np.searchsorted(row, row)) / parts[row]
            points = np.concatenate([points, low[row] + share[:, None] * (high - low)[row]])
            owner = np.append(owner, edges[row])
            found, _, feet = self.solid.nearest(points)
            wrong.append(feet[found > limit])
            np.maximum.at(known[0], owner, found)
            sums += [np.bincount(owner, some, len(places)) for some in (found, None)]
            edges = edges[(known[0, edges] > NEAR * limit) & (known[0, edges] <= limit)]
            points, owner, step = points[:0], owner[:0], step / 4
        known[1, new] = sums[0, new] / sums[1, new]
        self.keys, self.back = places, known
        mean = known[1, :count] / 2 + known[1, count + edge.reshape(-1, 3)].mean(1) / 2
        area = length(face_normals(vertices, faces))
        return np.concatenate(wrong), float(known[0].max()), float(mean @ area / area.sum())


def find(keys: Keys, among: Keys) -> NDArray[np.intp]:
    """Return where keys stand among others, (n,); -1 where they do not."""
    order = np.argsort(among)
    at = order[np.searchsorted(among[order], keys).clip(max=len(among) - 1)]
    return np.where(among[at] == keys, at, -1)


def mean_side(mesh: Mesh) -> float:
    """Return the mean length of the first sides of all triangles."""
    start, end = mesh.vertices.astype(np.float64)[mesh.faces[:, :2].T]
    return float(length(end - start).mean())
