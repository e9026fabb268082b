"""Collapsing edges with pyfqmr, except in triangles that must stay as they are.

pyfqmr is fast quadric mesh simplification (Forstmann): an edge is collapsed if the sum of squared
distances of the new vertex to the planes of the triangles it replaces is under a threshold, which
rises in every round. It neither bounds the distance of triangles nor keeps every mesh a manifold:
see ``simplify``, which looks at the result.
"""

from __future__ import annotations

from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyfqmr import Simplify

from ..arrays import BoolArray, IntArray
from ..mesh import Mesh
from ..topology import row_keys

Points = NDArray[np.float64]

ROUNDS = 30  # in which the threshold rises to its end; from more, meshes get no smaller
ONE_AT_A_TIME = Lock()  # pyfqmr has one mesh, in global variables


def collapse_within(mesh: Mesh, kept: BoolArray, distance: float) -> Mesh:
    """Collapse the edges whose new vertex is within a distance of the planes around it.

    Parameters
    ----------
    mesh : Mesh
        Triangles.
    kept : (m,) bool
        The triangles that stay as they are, with their vertices. Open edges stay, too.
    distance : float
        Root of the sum of squared distances to the planes, in world units.

    Returns
    -------
    Mesh
        With vertices of the same type.
    """
    rising = {"alpha": ROUNDS**-3.0, "K": 1, "aggressiveness": 3.0}  # to 1, which is the distance
    limits = {"target_count": 0, "max_iterations": ROUNDS, "update_rate": 1}
    return _collapse(mesh, kept, distance, {**rising, **limits})


def collapse_to(mesh: Mesh, kept: BoolArray, triangles: int) -> Mesh:
    """Collapse edges until no more than a number of triangles is left; see ``collapse_within``.

    More are left where the shape, the kept triangles, or open edges do not allow fewer.
    """
    target = max(triangles - int(np.count_nonzero(kept)), 0)
    return _collapse(mesh, kept, mean_side(mesh), {"target_count": target, "update_rate": 1})


def mean_side(mesh: Mesh) -> float:
    """Return the mean length of the first sides of all triangles."""
    ends = mesh.vertices[mesh.faces[:, :2]].astype(np.float64)
    return float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).mean())


def _collapse(mesh: Mesh, kept: BoolArray, unit: float, options: dict[str, Any]) -> Mesh:
    """Return the mesh with the edges between triangles that are not kept collapsed.

    The triangles that are not kept are a mesh of its own, whose open edges pyfqmr keeps: there it
    is joined to the kept triangles again. ``unit`` is the length that pyfqmr's thresholds have.
    """
    middle = mesh.vertices.mean(0, dtype=np.float64)
    scaled = (mesh.vertices - middle) / unit
    used, faces = renumbered(mesh.faces[~kept])
    moved, collapsed = run_pyfqmr(scaled[used], faces, options)
    held = np.unique(mesh.faces[kept])
    there = position_rows(moved, scaled[held])  # rows of held vertices among the moved, or -1
    vertices = (moved * unit + middle).astype(mesh.vertices.dtype)
    vertices[there[there >= 0]] = mesh.vertices[held[there >= 0]]
    extra = held[there < 0]
    number = np.full(len(scaled), -1, np.int32)
    number[held] = there
    number[extra] = len(moved) + np.arange(len(extra))
    return Mesh(
        np.concatenate([vertices, mesh.vertices[extra]]),
        np.concatenate([collapsed, number[mesh.faces[kept]]]),
    )


def run_pyfqmr(
    vertices: Points, faces: IntArray, options: dict[str, Any]
) -> tuple[Points, IntArray]:
    """Return the vertices (n, 3) and faces (m, 3) that pyfqmr makes; open edges stay."""
    if not len(faces):
        return np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    with ONE_AT_A_TIME:
        library = Simplify()
        library.setMesh(vertices, faces)
        library.simplify_mesh(preserve_border=True, verbose=False, **options)
        moved, collapsed, _ = library.getMesh()
    return moved, collapsed.astype(np.int32)


def renumbered(faces: IntArray) -> tuple[NDArray[np.intp], IntArray]:
    """Return the vertices that faces (m, 3) use, and the faces with these numbered from 0."""
    used, numbers = np.unique(faces.ravel(), return_inverse=True)
    return used.astype(np.intp), numbers.astype(np.int32).reshape(-1, 3)


def position_rows(points: Points, wanted: Points) -> NDArray[np.intp]:
    """Return in which row of ``points`` each of the ``wanted`` points is, -1 where it is none."""
    rows = np.full(len(wanted), -1, np.intp)
    _, found, at = np.intersect1d(row_keys(points), row_keys(wanted), return_indices=True)
    same = (points[found] == wanted[at]).all(1)
    rows[at[same]] = found[same]
    return rows
