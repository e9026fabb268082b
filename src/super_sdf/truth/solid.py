"""Meshes as ground truth: exact distances to them, and whether they bound a solid at all.

The distance is that to the nearest triangle. The sign is that of the winding number (Barill et al.,
Fast Winding Numbers for Soups and Clouds, 2018), because the sign of the nearest triangle's
pseudonormal is wrong on meshes that intersect themselves, as real ones do.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import igl
import numpy as np
from numpy.typing import NDArray

from ..errors import MeshError
from ..mesh import Mesh
from .mesh_files import read_mesh

Points = NDArray[np.float64]
Distances = NDArray[np.float64]

# How far from a face its two sides are asked for their winding number, over the box diagonal.
SIDE_STEP = 1e-5


class Solid:
    """What a mesh encloses; asks are quick, for its search trees are built once.

    Parameters
    ----------
    mesh : Mesh
        Triangles, outward. Where pieces overlap the solid is their union, but distances are to
        the nearest triangle, be it inside another piece.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = Mesh(mesh.vertices.astype(np.float64), mesh.faces.astype(np.int32))

    @cached_property
    def _triangles(self) -> igl.AABB:
        tree = igl.AABB()
        tree.init(self.mesh.vertices, self.mesh.faces)
        return tree

    @cached_property
    def _winding(self) -> igl.FastWindingNumberBVH:
        tree = igl.FastWindingNumberBVH()
        tree.init(self.mesh.vertices, self.mesh.faces)
        return tree

    @cached_property
    def is_closed(self) -> bool:
        """Whether the winding number can change at the surface only."""
        return count_unbalanced_edges(self.mesh.faces) == 0

    def distance(self, points: Points) -> Distances:
        """Return the unsigned distance, (n,), of points (n, 3) to the nearest triangle."""
        if not len(points):
            return np.zeros(0)
        squared = self._triangles.squared_distance(self.mesh.vertices, self.mesh.faces, points)[0]
        return np.sqrt(squared)

    def winding_number(self, points: Points) -> Distances:
        """Return how often the mesh winds round each point, (n,): 1 inside, 0 outside."""
        return self._winding.winding_number(points) if len(points) else np.zeros(0)

    def is_inside(self, points: Points) -> NDArray[np.bool_]:
        """Say which points, (n, 3), the mesh winds round."""
        return self.winding_number(points) > 0.5

    def signed_distance(self, points: Points) -> Distances:
        """Return the distance of points (n, 3), negative inside, (n,)."""
        found = self.distance(points)
        return np.where(self.is_inside(points), -found, found)


@dataclass(frozen=True)
class Findings:
    """What is wrong with a mesh that should bound a solid.

    Attributes
    ----------
    open_edges : int
        Edges with more faces on one side than on the other.
    inverted : bool
        The faces look inward: the volume is negative.
    overlapping : int
        Faces with a side that the mesh winds round twice, or the wrong way: pieces overlap or
        fold over there, or are inverted.
    """

    open_edges: int
    inverted: bool
    overlapping: int


def examine(solid: Solid) -> Findings:
    """Look whether a mesh bounds a solid, faces outward."""
    winding = solid.winding_number(_both_sides(solid.mesh))
    inverted = solid.mesh.volume() < 0
    if inverted:
        winding = -winding
    wrong = (winding > 1.5) | (winding < -0.5)
    overlapping = int(wrong.reshape(2, -1).any(0).sum())
    return Findings(count_unbalanced_edges(solid.mesh.faces), inverted, overlapping)


def count_unbalanced_edges(faces: NDArray[np.int32]) -> int:
    """Count edges that are not run through equally often in both directions: 0 if closed.

    An edge of four faces is closed: the winding number is whole on all sides of it.
    """
    start, end = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel()
    key = np.minimum(start, end) * (faces.max(initial=0) + 1) + np.maximum(start, end)
    _, edge = np.unique(key, return_inverse=True)
    balance = np.bincount(edge, np.sign(end - start))
    return int(np.count_nonzero(balance))


def load_solid(path: str | Path, *, allow_open: bool = False) -> tuple[Solid, list[str]]:
    """Read a mesh as a solid; return it with what was found, a sentence each.

    An inverted mesh is turned round; of overlapping pieces the union is taken.

    Raises
    ------
    FileError, MeshError
        If it cannot be read, is flat, or is open and ``allow_open`` not set. With it the sign is
        that of the generalised winding number, which guesses across the holes.
    """
    solid, notes = Solid(read_mesh(path)), []
    low, high = solid.mesh.vertices.min(0), solid.mesh.vertices.max(0)
    found = examine(solid)
    if found.open_edges and not allow_open:
        raise MeshError(
            f"{path} is open: {found.open_edges:,} edges have no partner, so it has no inside; "
            "close it, or say --allow-open to guess across its holes"
        )
    if not (high > low).all() or solid.mesh.volume() == 0:
        raise MeshError(f"{path} is flat: it encloses no volume")
    if found.open_edges:
        notes.append(f"open at {found.open_edges:,} edges: inside is guessed across the holes")
    if found.inverted:
        notes.append("inverted, its faces look inward: turned round")
        solid = Solid(Mesh(solid.mesh.vertices, np.ascontiguousarray(solid.mesh.faces[:, ::-1])))
    if found.overlapping:
        notes.append(
            f"pieces overlap, fold over or are inverted at {found.overlapping:,} of "
            f"{len(solid.mesh.faces):,} faces: inside is by winding number, and distances are to "
            "inner walls, too"
        )
    return solid, notes


def _both_sides(mesh: Mesh) -> Points:
    """Return a point on either side of each face, (2 m, 3), close by; none for flat faces."""
    a, b, c = mesh.vertices[mesh.faces.T]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    whole = lengths[:, 0] > 0
    centres = (a + b + c)[whole] / 3
    size = np.linalg.norm(mesh.vertices.max(0) - mesh.vertices.min(0))
    step = SIDE_STEP * size * normals[whole] / lengths[whole]
    return np.concatenate([centres + step, centres - step])
