"""Exact signed distances of closed triangle meshes (libigl), without torch.

The distance is that to the nearest triangle. The sign comes from the fast winding number wherever
it can be trusted to differ from its neighbour's, because the sign of the nearest triangle's
pseudonormal is wrong on meshes that intersect themselves, as real ones do.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from scipy import ndimage


@dataclass(frozen=True, eq=False)
class TriMesh:
    """A closed triangle mesh: vertices (n, 3) float64 and faces (m, 3) int64, outward."""

    vertices: np.ndarray
    faces: np.ndarray

    def transformed(self, linear: np.ndarray, shift: np.ndarray) -> TriMesh:
        """Return the mesh with ``vertices @ linear.T + shift`` (``linear`` keeps orientation)."""
        return TriMesh(self.vertices @ linear.T + shift, self.faces)


def load_mesh(path: str) -> TriMesh:
    """Read any mesh file that trimesh reads, vertices merged."""
    import trimesh

    mesh = trimesh.load_mesh(path)
    return TriMesh(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64))


def distance(mesh: TriMesh, points: np.ndarray, limit: float = np.inf) -> np.ndarray:
    """Return the unsigned distance of each point, NaN beyond ``limit``."""
    unsigned = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_UNSIGNED
    found, _, _, _ = igl.signed_distance(points, mesh.vertices, mesh.faces, unsigned, -limit, limit)
    return found


def is_inside(mesh: TriMesh, points: np.ndarray) -> np.ndarray:
    """Say which points the mesh winds round (winding number over one half)."""
    return igl.fast_winding_number(mesh.vertices, mesh.faces, points) > 0.5


def signed_distance(mesh: TriMesh, points: np.ndarray) -> np.ndarray:
    """Return the signed distance of each point, negative inside, sign by winding number."""
    found = distance(mesh, points)
    return np.where(is_inside(mesh, points), -found, found)


def pseudonormal_distance(mesh: TriMesh, points: np.ndarray) -> np.ndarray:
    """Return the signed distance, sign by the nearest triangle: faster, wrong on bad meshes."""
    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    return igl.signed_distance(points, mesh.vertices, mesh.faces, kind)[0]


def grid_points(shape: tuple[int, int, int], spacing: float, origin: np.ndarray) -> np.ndarray:
    """Return ``origin + spacing * ijk`` for every sample of a grid, (n, 3), C order."""
    return np.indices(shape).reshape(3, -1).T * spacing + origin


def sample_grid(
    mesh: TriMesh, shape: tuple[int, int, int], spacing: float, origin: np.ndarray
) -> np.ndarray:
    """Return the signed distance at every sample of a grid, ``shape`` of float64.

    The winding number is asked only within two spacings of the surface. Beyond, the sign is
    constant on connected regions, so one point of each region tells it.
    """
    points = grid_points(shape, spacing, origin)
    found = distance(mesh, points).reshape(shape)
    near = found < 2 * spacing
    inside = np.zeros(shape, bool)
    inside[near] = is_inside(mesh, points[near.ravel()])
    regions, count = ndimage.label(~near)
    if count:
        first = np.unique(regions.ravel(), return_index=True)[1][-count:]
        region_inside = np.concatenate([[False], is_inside(mesh, points[first])])
        inside = np.where(near, inside, region_inside[regions])
    return np.where(inside, -found, found)


def unit_grid(n: int) -> tuple[tuple[int, int, int], float, np.ndarray]:
    """Return shape, spacing and origin of the test grids: voxel centres (i + 1/2)/n - 1/2."""
    return (n, n, n), 1.0 / n, np.full(3, 0.5 / n - 0.5)
