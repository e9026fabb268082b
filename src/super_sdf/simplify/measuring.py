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

from ..arrays import face_normals, length
from ..surface.mesh import Mesh, row_keys
from ..truth.solid import Points, Solid

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
        self.mesh, self.solid, self.side = mesh, Solid(mesh), mean_side(mesh)
        self.distance = np.zeros(len(mesh.vertices))
        self.near = np.zeros(len(mesh.vertices), np.uint64)  # key of a triangle; 0: not measured
        start, end = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
        self.edges = np.stack([start, end])[:, start < end]
        # of the edges: keys of what their ends and middles are near, if within the limit; distances
        self.seen = np.zeros((3, self.edges.shape[1]), np.uint64)
        self.off = np.zeros(self.edges.shape[1])
        self.keys, self.back = np.zeros(1, np.uint64), np.full((2, 1), np.inf)  # largest, mean

    def compare(self, other: Solid, error: float = np.inf) -> tuple[Points, Deviation]:
        """Return points near this mesh, (n, 3), where the two are farther apart than an error."""
        limit, vertices = BETWEEN * error, self.solid.mesh.vertices
        keys = row_keys(other.mesh.vertices[other.mesh.faces].reshape(-1, 9))
        self.near[self.distance > limit] = 0
        stale = ~np.isin(self.near, keys)
        self.distance[stale], face, _ = other.nearest(vertices[stale])
        self.near[stale] = keys[face]
        bar = limit if limit < np.inf else float(self.distance.max())
        on_edges = self._bent_edges(other, keys, bar)
        feet, largest_back, mean_back = self._back(other, keys, limit)
        wrong = [
            vertices[self.distance > limit],
            on_edges[: len(on_edges) * (limit < np.inf)],
            feet,
        ]
        area = np.linalg.norm(face_normals(vertices, self.mesh.faces), axis=1)
        mean = float(self.distance[self.mesh.faces].mean(1) @ area / area.sum())
        largest = float(max(self.distance.max(), self.off.max(initial=0)))
        return np.concatenate(wrong), Deviation(largest, mean, largest_back, mean_back)

    def _bent_edges(self, other: Solid, keys: NDArray[np.uint64], limit: float) -> Points:
        """Measure edges that may be farther away than their ends; return points beyond a limit.

        With its ends on two triangles that share an edge, an edge of length L is at most L / 4
        times the largest angle away that one of these makes with those beside it.
        """
        at_ends = self.near[self.edges]
        self.off[at_ends[0] == at_ends[1]] = 0
        is_known = (at_ends == self.seen[:2]).all(0) & np.isin(self.seen[2], keys)
        some = np.flatnonzero((at_ends[0] != at_ends[1]) & ~is_known)
        order = np.argsort(keys)
        face = order[np.searchsorted(keys[order], at_ends[:, some])]
        normals = face_normals(other.mesh.vertices, other.mesh.faces)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        beside = other.mesh.pair_edges()[0].reshape(-1, 3) // 3
        angle = np.linalg.norm(normals[:, None] - normals[beside], axis=2).max(1)
        low, high = self.solid.mesh.vertices[self.edges[:, some]]
        rise = length(high - low) * angle[face].max(0) / 4
        bent = self.distance[self.edges[:, some]].max(0) + rise > limit
        bent |= (beside[face[0]] != face[1][:, None]).all(1)
        low, high = low[bent], high[bent]
        middles = (low + high) / 2
        off, nearest, _ = other.nearest(middles)
        more = (off > SUSPECT * limit) & (off <= limit)
        points = low[more] + SHARES * (high[more] - low[more])  # (4, n, 3)
        beside_middle = other.distance(points.reshape(-1, 3)).reshape(len(SHARES), -1)
        wrong = middles[off > limit], points[beside_middle > limit]
        off[more] = np.maximum(off[more], beside_middle.max(0))
        self.off[some], self.seen[:, some] = 0, at_ends[[0, 1, 0]][:, some]
        self.off[some[bent]], self.seen[2, some[bent]] = off, keys[nearest] * (off <= limit)
        return np.concatenate(wrong)

    def _back(
        self, other: Solid, keys: NDArray[np.uint64], limit: float
    ) -> tuple[Points, float, float]:
        """Return the feet on this mesh of points of the other that are too far, and distances."""
        vertices, faces = other.mesh.vertices, other.mesh.faces
        sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), 1)
        number = sides[:, 0].astype(np.int64) * len(vertices) + sides[:, 1]
        _, first, edge = np.unique(number, return_index=True, return_inverse=True)
        ends = vertices[sides[first]]
        places = np.concatenate([keys, row_keys(ends.reshape(-1, 6))])  # triangles, then edges
        order = np.argsort(self.keys)
        at = order[np.searchsorted(self.keys[order], places).clip(max=len(order) - 1)]
        is_known = (self.keys[at] == places) & (self.back[0, at] <= limit)
        known = np.where(is_known, self.back[:, at], 0)
        middle, edges = (np.flatnonzero(~some) for some in (is_known[: len(keys)], is_known))
        edges = edges[len(middle) :]
        points, owner = vertices[faces[middle]].mean(1), middle
        step, wrong, sums = self.side / 2, [np.zeros((0, 3))], np.zeros((2, len(places)))
        for _ in range(2):  # both ends, and points between them no farther apart than a step
            low, high = ends[edges - len(keys)].transpose(1, 0, 2)
            parts = np.maximum(np.ceil(length(high - low) / step).astype(np.int64), 3)
            row = np.repeat(np.arange(len(edges)), parts + 1)
            place = np.arange(len(row)) - np.repeat(np.cumsum(parts + 1) - parts - 1, parts + 1)
            on_edges = low[row] + (place / parts[row])[:, None] * (high - low)[row]
            points, owner = np.concatenate([points, on_edges]), np.append(owner, edges[row])
            found, _, feet = self.solid.nearest(points)
            wrong.append(feet[found > limit])
            np.maximum.at(known[0], owner, found)
            sums += [np.bincount(owner, some, len(places)) for some in (found, None)]
            edges = edges[(known[0, edges] > NEAR * limit) & (known[0, edges] <= limit)]
            points, owner, step = points[:0], owner[:0], step / 4
        measured = sums[1] > 0
        known[1, measured] = sums[0, measured] / sums[1, measured]
        self.keys, self.back = places, known
        mean = known[1, : len(keys)] / 2 + known[1, len(keys) + edge.reshape(-1, 3)].mean(1) / 2
        area = np.linalg.norm(face_normals(other.mesh.vertices, other.mesh.faces), axis=1)
        return np.concatenate(wrong), float(known[0].max()), float(mean @ area / area.sum())


def mean_side(mesh: Mesh) -> float:
    """Return the mean length of the first sides of all triangles."""
    start, end = mesh.vertices.astype(np.float64)[mesh.faces[:, :2].T]
    return float(length(end - start).mean())
