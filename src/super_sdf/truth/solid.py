"""Meshes as ground truth: exact distances to them, and whether they bound a solid.

The distance is that to the nearest triangle. The sign comes from the winding number (Barill et al.,
Fast Winding Numbers for Soups and Clouds, 2018), because the pseudonormal of the nearest triangle
gives the wrong sign on meshes that intersect themselves, as real ones do.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import MeshError
from ..surface.mesh import Mesh
from .mesh_files import read_mesh

if TYPE_CHECKING:
    import igl

Points = NDArray[np.float64]
Distances = NDArray[np.float64]

# Distance from a face at which the winding number of its sides is evaluated, over the box diagonal.
SIDE_STEP = 1e-5


def normalise(mesh: Mesh) -> Mesh:
    """Return a mesh, float64, centred on its bounding box and scaled to a box diagonal of 1."""
    vertices = mesh.vertices.astype(np.float64)
    low, high = vertices.min(0), vertices.max(0)
    return Mesh((vertices - (low + high) / 2) / np.linalg.norm(high - low), mesh.faces)


class Solid:
    """The solid that a mesh, facing outward, encloses, with search trees for fast queries.

    Where pieces overlap the solid is their union, but distances are to the nearest triangle even if
    that is inside another piece.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = Mesh(mesh.vertices.astype(np.float64), mesh.faces.astype(np.int32))

    @cached_property
    def _triangles(self) -> igl.AABB:
        import igl

        tree = igl.AABB()
        tree.init(self.mesh.vertices, self.mesh.faces)
        return tree

    @cached_property
    def _winding(self) -> igl.FastWindingNumberBVH:
        import igl

        tree = igl.FastWindingNumberBVH()
        tree.init(self.mesh.vertices, self.mesh.faces)
        return tree

    @cached_property
    def unbalanced_edges(self) -> int:
        """How many edges faces do not use equally often in both directions: 0 if closed.

        An edge of four faces counts as closed: the winding number is an integer on all its sides.
        """
        faces = self.mesh.faces
        start, end = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel()
        key = np.minimum(start, end) * (faces.max(initial=0) + 1) + np.maximum(start, end)
        _, edge = np.unique(key, return_inverse=True)
        return int(np.count_nonzero(np.bincount(edge, np.sign(end - start))))

    @property
    def is_closed(self) -> bool:
        """Whether the mesh is closed, so that the winding number changes at the surface only."""
        return self.unbalanced_edges == 0

    def distance(self, points: Points) -> Distances:
        """Return the unsigned distance, (n,), of points (n, 3) to the nearest triangle."""
        return self.nearest(points)[0]

    def nearest_face(self, points: Points) -> NDArray[np.int64]:
        """Return the index of the nearest triangle, (n,), of points (n, 3)."""
        return self.nearest(points)[1]

    def nearest(self, points: Points) -> tuple[Distances, NDArray[np.int64], Points]:
        """Return distance, triangle and nearest point of points (n, 3)."""
        if not len(points):
            return np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 3))
        mesh = self.mesh
        squared, face, feet = self._triangles.squared_distance(mesh.vertices, mesh.faces, points)
        return np.sqrt(squared), np.ravel(face), feet

    def winding_number(self, points: Points) -> Distances:
        """Return the winding number of points (n, 3), (n,): 1 inside, 0 outside."""
        return self._winding.winding_number(points) if len(points) else np.zeros(0)

    def is_inside(self, points: Points) -> NDArray[np.bool_]:
        """Return a mask, (n,), of the points (n, 3) inside the solid."""
        return self.winding_number(points) > 0.5

    def signed_distance(self, points: Points) -> Distances:
        """Return the signed distance, (n,), of points (n, 3), negative inside."""
        found = self.distance(points)
        return np.where(self.is_inside(points), -found, found)

    def count_overlapping(self) -> int:
        """Count the faces with a winding number of 2 or more, or below 0, on one side.

        They belong to pieces that overlap, fold over or are inverted.
        """
        a, b, c = self.mesh.vertices[self.mesh.faces.T]
        normals = np.cross(b - a, c - a)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        whole = lengths[:, 0] > 0
        size = np.linalg.norm(np.ptp(self.mesh.vertices, axis=0))
        step = SIDE_STEP * size * normals[whole] / lengths[whole]
        centres = (a + b + c)[whole] / 3
        winding = self.winding_number(np.concatenate([centres + step, centres - step]))
        winding *= np.sign(self.mesh.volume()) or 1
        wrong = (winding > 1.5) | (winding < -0.5)
        return int(wrong.reshape(2, -1).any(0).sum())


def load_solid(path: str | Path, *, allow_open: bool = False) -> tuple[Solid, list[str]]:
    """Read a mesh file as a solid; return it with notes on its faults.

    An inverted mesh is reversed; overlapping pieces are united. FileError or MeshError if it cannot
    be read, is flat, or is open and ``allow_open`` is not set. With ``allow_open`` the sign comes
    from the generalised winding number, a guess near the holes.
    """
    solid, notes = Solid(read_mesh(path)), []
    mesh, open_edges = solid.mesh, solid.unbalanced_edges
    if open_edges and not allow_open:
        raise MeshError(
            f"{path} is open: {open_edges:,} edges have no partner, so it has no inside; "
            "close it, or use --allow-open to guess its inside"
        )
    volume = mesh.volume()
    if not np.ptp(mesh.vertices, axis=0).all() or volume == 0:
        raise MeshError(f"{path} is flat: it encloses no volume")
    if open_edges:
        notes.append(f"open at {open_edges:,} edges: inside is guessed across the holes")
    if volume < 0:
        notes.append("inverted: its faces point inward; they were reversed")
        solid = Solid(Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1])))
    if overlapping := solid.count_overlapping():
        notes.append(
            f"pieces overlap, fold over or are inverted at {overlapping:,} of "
            f"{len(mesh.faces):,} faces: inside is by winding number, and distances are to "
            "inner walls, too"
        )
    return solid, notes
