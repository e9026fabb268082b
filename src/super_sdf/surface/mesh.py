"""A triangle mesh: volume, open edges, and the precision that its vertices need."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import IntArray
from ..errors import GridError, OptionTypeError, seen
from ..grid.sdf_grid import SdfGrid

# A vertex stays this share of its lattice edge away from both ends. Otherwise vertices would
# coincide where a node's value is 0, and programs that merge points would tear the mesh.
CLEARANCE = 1e-3


@dataclass(frozen=True, eq=False, repr=False)
class Mesh:
    """Triangles of a surface, counter-clockwise seen from outside.

    Attributes
    ----------
    vertices : (n, 3) float32 or float64
        World positions; float64 where float32 does not resolve neighbouring vertices.
    faces : (m, 3) int32
        Indices of the corners in ``vertices``.
    """

    vertices: NDArray[Any]
    faces: IntArray

    def __repr__(self) -> str:
        text = f"{len(self.vertices):,} vertices {self.vertices.dtype}, {len(self.faces):,} faces"
        if len(self.vertices):
            low, high = self.vertices.min(0), self.vertices.max(0)
            box = ", ".join(f"{a:.6g} to {b:.6g}" for a, b in zip(low, high))
            text += f", x, y, z from {box}"
        return f"Mesh({text})"

    def transformed(self, linear: NDArray[Any], shift: NDArray[Any]) -> Mesh:
        """Return the mesh with ``vertices @ linear.T + shift`` (``linear`` keeps orientation)."""
        return Mesh(self.vertices @ linear.T + shift, self.faces)

    def volume(self) -> float:
        """Return the enclosed volume, in cubic world units; positive if normals point outward."""
        if not len(self.faces):
            return 0.0
        corners = self.vertices.astype(np.float64)
        a, b, c = (corners - corners.mean(0))[self.faces.T]
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)

    def open_edges(self) -> int:
        """Count the edges that are not used exactly once in each direction: 0 in a closed mesh."""
        start = self.faces.ravel().astype(np.int64)
        end = np.roll(self.faces, -1, axis=1).ravel().astype(np.int64)
        size = len(self.vertices)
        forward, times = np.unique(start * size + end, return_counts=True)
        backward = forward % size * size + forward // size
        unpaired = np.setxor1d(forward, backward, assume_unique=True)
        return int((start == end).sum()) + int((times > 1).sum()) + len(unpaired)

    def is_closed(self) -> bool:
        """Return whether there are faces and no edge is open."""
        return len(self.faces) > 0 and self.open_edges() == 0


def check_mesh(mesh: Any) -> None:
    """Raise OptionTypeError if ``mesh`` is not a ``Mesh``."""
    if not isinstance(mesh, Mesh):
        raise OptionTypeError(f"mesh is {seen(mesh)}: give one from reconstruct(grid)")


def join_meshes(pieces: list[Mesh]) -> Mesh:
    """Join pieces, in order, whose faces index the vertices of all pieces."""
    if len(pieces) == 1:
        return pieces[0]
    return Mesh(
        np.concatenate([piece.vertices for piece in pieces]),
        np.concatenate([piece.faces for piece in pieces]),
    )


def vertex_type(grid: SdfGrid, factor: int) -> type[np.float32] | type[np.float64]:
    """Return the dtype that resolves neighbouring vertices: float32 if possible, else float64."""
    reach = grid.reach
    for kind in (np.float32, np.float64):
        if tells_vertices_apart(kind, reach, grid, factor):
            return kind
    raise GridError(
        f"the grid reaches to {reach:.6g}, too far from the origin for its spacing, "
        f"{grid.voxel_size:.6g}: vertices could not be told apart; give a nearer origin"
    )


def tells_vertices_apart(
    kind: type[np.float32] | type[np.float64], reach: float, grid: SdfGrid, factor: int
) -> bool:
    """Return whether floats of this kind resolve neighbouring vertices up to ``reach``."""
    least = CLEARANCE / 2 * grid.voxel_size / factor
    finfo = np.finfo(kind)
    fine = float(finfo.tiny) < least and float(finfo.eps) * reach < least
    return fine and reach < float(finfo.max)
