"""How far a simplified mesh is from the mesh that it was made of, in both directions.

Between two meshes that lie close to each other, distances are largest at vertices of either mesh
and where their edges cross. So measured are the vertices of both, points along the edges of the
simplified mesh, its centroids, and points along those edges of the original mesh whose ends are
nearest to different triangles. Each distance is exact, from a point to triangles.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import face_normals, length
from ..surface.mesh import Mesh
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
    """A mesh before it was simplified, to measure simplified ones against."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh, self.solid = mesh, Solid(mesh)
        self.edges = _edges(mesh)
        self.side = float(length(np.subtract(*self.solid.mesh.vertices[self.edges])).mean())

    def compare(self, other: Solid, error: float = np.inf) -> tuple[Points, Deviation]:
        """Return points near this mesh, (n, 3), where the two are farther apart than an error."""
        limit, vertices = BETWEEN * error, self.solid.mesh.vertices
        off, near, _ = other.nearest(vertices)
        bar, ends = min(limit, float(off.max())), near[self.edges]
        low, high = vertices[self.edges[:, ends[0] != ends[1]]]
        middles = (low + high) / 2
        off_middles = other.distance(middles)
        more = off_middles > SUSPECT * bar
        between = (low[more] + SHARES * (high[more] - low[more])).reshape(-1, 3)
        points = np.concatenate([vertices, middles, between])
        distances = np.concatenate([off, off_middles, other.distance(between)])
        corners, back, largest_back = self._back(other, limit)
        return np.concatenate([points[distances > limit], back]), Deviation(
            float(distances.max()),
            _mean(self.solid, off[self.mesh.faces].mean(1)),
            largest_back,
            _mean(other, corners),
        )

    def _back(self, other: Solid, limit: float) -> tuple[NDArray[np.float64], Points, float]:
        """Measure points of a simplified mesh.

        Returned are the mean distance of each triangle, (m,), the nearest points of this mesh to
        those beyond a limit, and the largest distance.
        """
        vertices, faces = other.mesh.vertices, other.mesh.faces
        off, _, feet = self.solid.nearest(np.concatenate([vertices, vertices[faces].mean(1)]))
        at_vertices, at_centroids = np.split(off, [len(vertices)])
        wrong, largest, step = [feet[off > limit]], float(off.max()), self.side / 2
        edges = _edges(other.mesh)
        for _ in range(2):  # both ends are measured; points between them are within a step
            low, high = vertices[edges]
            parts = np.maximum(np.ceil(length(high - low) / step).astype(np.int64), 3)
            row = np.repeat(np.arange(len(parts)), parts - 1)
            nth = np.arange(len(row)) - np.repeat(np.cumsum(parts - 1) - parts, parts - 1)
            found, _, feet = self.solid.nearest(
                low[row] + (nth / parts[row])[:, None] * (high - low)[row]
            )
            wrong.append(feet[found > limit])
            largest, worst = max(largest, found.max(initial=0)), at_vertices[edges].max(0)
            np.maximum.at(worst, row, found)
            edges, step = edges[:, (worst > NEAR * limit) & (worst <= limit)], step / 4
        means = 0.75 * at_centroids + 0.25 * at_vertices[faces].mean(1)
        return means, np.concatenate(wrong), float(largest)


def _edges(mesh: Mesh) -> NDArray[np.int32]:
    """Return the ends of the edges, (2, n): of a closed mesh, each edge once."""
    ends = np.stack([mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()])
    return ends[:, ends[0] < ends[1]]


def _mean(solid: Solid, values: NDArray[np.float64]) -> float:
    """Return the mean of values of triangles, (m,), over the area."""
    areas = length(face_normals(solid.mesh.vertices, solid.mesh.faces))
    return float(values @ areas / areas.sum())
