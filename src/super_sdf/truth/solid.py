"""Meshes as ground truth: read from files, with exact distances and sides.

The distance is that to the nearest triangle. The sign comes from the winding number (Barill et al.,
Fast Winding Numbers for Soups and Clouds, 2018), because the pseudonormal of the nearest triangle
gives the wrong sign on meshes that intersect themselves, as real ones do.
"""

from __future__ import annotations

import logging
import warnings
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import length
from ..errors import FileError, MeshError
from ..files.formats import check_regular_file
from ..surface.mesh import Mesh

Points = NDArray[np.float64]
Distances = NDArray[np.float64]

LARGEST_COORDINATE = 1e30  # products and squares of larger ones overflow
MERGE_DISTANCE = 1e-8  # vertices closer than this are merged
SMALLEST_STEP = 1e-18  # of the largest coordinate, so that multiples of it fit in 64 bits


def read_mesh(path: str | Path) -> Mesh:
    """Read any mesh file that trimesh reads, with merged float64 vertices.

    FileError if no mesh can be read, MeshError if what the file holds is no finite surface.
    """
    path = check_regular_file(path)
    try:
        import trimesh

        logging.getLogger("trimesh").addHandler(logging.NullHandler())  # else Python prints them
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # unprocessed: otherwise faces with non-finite vertices would be dropped silently
            found = trimesh.load_mesh(path, process=False, skip_materials=True)
            vertices = np.array(getattr(found, "vertices", ()), np.float64).reshape(-1, 3)
            faces = np.array(getattr(found, "faces", ()), np.int64).reshape(-1, 3)
    except Exception as error:  # the readers of trimesh raise all kinds of errors
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
        raise FileError(f"{path} cannot be read as a mesh: {reason}") from error
    if not len(faces):
        raise MeshError(f"{path} holds no triangle: give a surface mesh")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError(f"{path} has a face of a vertex that it does not hold: repair it")
    used, corners = np.unique(faces, return_inverse=True)
    mesh = Mesh(vertices[used], corners.astype(np.int32).reshape(-1, 3))
    if not (largest := np.abs(mesh.vertices).max()) <= LARGEST_COORDINATE:
        raise MeshError(f"{path} reaches to {largest:.3g}: repair it, or scale it to under 1e30")
    return merged(mesh)


def merged(mesh: Mesh) -> Mesh:
    """Merge vertices within ``MERGE_DISTANCE``, for meshes under 1 that share of their size.

    Unlike in trimesh, normals and textures do not keep vertices separate: a mesh is not open along
    its seams.
    """
    from trimesh.grouping import unique_rows

    step = MERGE_DISTANCE * min(1.0, float(np.ptp(mesh.vertices, axis=0).max()))
    step = max(step, float(np.abs(mesh.vertices).max()) * SMALLEST_STEP) or 1.0
    places = np.round(mesh.vertices / step).astype(np.int64)
    first, place = unique_rows(places, keep_order=True)
    if len(first) == len(mesh.vertices):
        return mesh
    return Mesh(mesh.vertices[first], place.astype(np.int32)[mesh.faces])


class Solid:
    """The solid that a mesh, facing outward, encloses, with search trees for fast queries.

    Where pieces overlap the solid is their union, but distances are to the nearest triangle even if
    that is inside another piece. Points are (n, 3).
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = Mesh(mesh.vertices.astype(np.float64), mesh.faces.astype(np.int32))

    def _tree(self, kind: str) -> Any:
        """Return a search tree of igl for the triangles."""
        import igl

        tree = getattr(igl, kind)()
        tree.init(self.mesh.vertices, self.mesh.faces)
        return tree

    _triangles = cached_property(lambda self: self._tree("AABB"))
    _winding = cached_property(lambda self: self._tree("FastWindingNumberBVH"))

    @cached_property
    def unbalanced_edges(self) -> int:
        """How many edges faces do not use equally often in both directions: 0 if closed.

        An edge of four faces counts as closed: the winding number is an integer on all its sides.
        """
        faces = self.mesh.faces.astype(np.int64)
        start, end = faces.ravel(), np.roll(faces, -1, 1).ravel()
        key = np.minimum(start, end) * (start.max(initial=0) + 1) + np.maximum(start, end)
        _, edge = np.unique(key, return_inverse=True)
        return int(np.count_nonzero(np.bincount(edge, np.sign(end - start))))

    def nearest(self, points: Points) -> tuple[Distances, NDArray[np.int64], Points]:
        """Return the distance to the nearest triangle, that triangle, and its nearest point."""
        if not len(points):
            return np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 3))
        both = self.mesh.vertices, self.mesh.faces
        squared, face, feet = self._triangles.squared_distance(*both, points)
        return np.sqrt(squared), np.ravel(face), feet

    def distance(self, points: Points) -> Distances:
        """Return the unsigned distance, (n,), to the nearest triangle."""
        return self.nearest(points)[0]

    def is_inside(self, points: Points) -> NDArray[np.bool_]:
        """Return a mask, (n,), of the points inside the solid."""
        inside: NDArray[np.bool_] = np.zeros(len(points), bool)
        return self._winding.winding_number(points) > 0.5 if len(points) else inside

    def signed_distance(self, points: Points) -> Distances:
        """Return the signed distance, (n,), negative inside."""
        found = self.distance(points)
        return np.where(self.is_inside(points), -found, found)

    def intersecting(self) -> NDArray[np.int64]:
        """Return the pairs of triangles, (k, 2), that meet off a common vertex or edge.

        Vertices at the same position must be one vertex.
        """
        import igl.predicates

        faces = self.mesh.faces.astype(np.int64)
        whole = np.flatnonzero((faces != np.roll(faces, 1, axis=1)).all(1))
        return whole[igl.predicates.find_self_intersections(self.mesh.vertices, faces[whole])[1]]


def smallest_angles(corners: Points) -> Distances:
    """Return the smallest angle of each triangle, (m,), in degrees; corners are (m, 3, 3)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    sides = np.sort(length(corners - np.roll(corners, 1, axis=1)), axis=1)
    sine = length(np.cross(b - a, c - a)) / np.maximum(sides[:, 1] * sides[:, 2], 1e-300)
    return np.degrees(np.arcsin(np.minimum(sine, 1)))


def load_solid(path: str | Path, *, allow_open: bool = False) -> tuple[Solid, list[str]]:
    """Read a mesh file as a solid; return it with notes on its faults.

    An inverted mesh is reversed. FileError or MeshError if it cannot
    be read, is flat, or is open and ``allow_open`` is not set. With ``allow_open`` the sign comes
    from the generalised winding number, a guess near the holes.
    """
    solid, notes = Solid(read_mesh(path)), []
    mesh, open_edges, volume = solid.mesh, solid.unbalanced_edges, solid.mesh.volume()
    if open_edges and not allow_open:
        raise MeshError(
            f"{path} is open: {open_edges:,} edges have no partner, so it has no inside; "
            "close it, or use --allow-open to guess its inside"
        )
    if not np.ptp(mesh.vertices, axis=0).all() or volume == 0:
        raise MeshError(f"{path} is flat: it encloses no volume")
    if open_edges:
        notes.append(f"open at {open_edges:,} edges: inside is guessed across the holes")
    if volume < 0:
        notes.append("inverted: its faces point inward; they were reversed")
        solid = Solid(Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1])))
    return solid, notes
