"""Simplifying a mesh within a measured distance, or to a number of triangles.

>>> from super_sdf import simplify_mesh
>>> simplify_mesh(mesh, error=0.02 * grid.voxel_size).mesh               # doctest: +SKIP

Where a simplified mesh is too far from the unsimplified one, or no longer a manifold, the triangles
around the place are kept, and the rest is simplified again. Passes over the result follow: there
the triangles to keep are already larger.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..arrays import BoolArray
from ..mesh import Mesh
from ..options import check_goal, check_mesh
from ..topology import irregular_places, row_keys
from ..truth.solid import Points, Solid
from .collapsing import collapse_to, collapse_within
from .deviation import Deviation, Original

# Edges are collapsed while the new vertex is within this many errors of the planes around it (root
# of the sum of squares). At 1, 1.4, 2, 2.8 and 4, a part keeps 17, 17, 13, 15 and 20 % of its
# triangles at 32^3, another one 9, 9, 8, 9 and 12 %.
PLANE_DISTANCE = 2.0
MOST_PASSES = 12
ENOUGH = 0.9  # a pass that leaves more of the triangles is the last one
ROUNDS = 8  # of keeping more triangles, before smaller distances are tried
HALVINGS = 3


@dataclass(frozen=True, eq=False)
class Simplified:
    """A simplified mesh and its distance from the unsimplified one.

    Attributes
    ----------
    mesh : Mesh
        Closed, oriented and manifold if the unsimplified mesh was; its open edges are the same.
    triangles_before : int
        Triangles of the unsimplified mesh.
    deviation : Deviation
        In world units.
    warnings : tuple of str
        What was asked for and not reached.
    """

    mesh: Mesh
    triangles_before: int
    deviation: Deviation
    warnings: tuple[str, ...] = ()


def simplify_mesh(
    mesh: Mesh, *, error: float | None = None, triangles: int | None = None
) -> Simplified:
    """Simplify a mesh within a distance, or to a number of triangles.

    Parameters
    ----------
    mesh : Mesh
        Vertices at the same position must be one vertex.
    error : float, optional
        Largest distance, in world units, between the two surfaces, measured both ways at the
        vertices and at points less than an edge of ``mesh`` apart.
    triangles : int, optional
        Largest number of triangles. If it cannot be reached, a warning says how many are left.

    Returns
    -------
    Simplified
        With vertices of the same type. Open edges stay exactly where they are.

    Raises
    ------
    OptionError
        If not exactly one of ``error`` and ``triangles`` is given, or it is not positive.
    FileError
        If the extra ``simplify`` is not installed.
    """
    check_mesh(mesh)
    error, triangles = check_goal(error, triangles)
    if not len(mesh.faces):
        return Simplified(mesh, 0, Deviation(0.0, 0.0, 0.0, 0.0))
    original = Original(mesh)
    if error is not None:
        result, warnings = within(mesh, original, error)
    else:
        result, warnings = down_to(mesh, triangles or 0)
    return Simplified(result, len(mesh.faces), original.deviation(result), warnings)


def within(mesh: Mesh, original: Original, error: float) -> tuple[Mesh, tuple[str, ...]]:
    """Return a mesh within a distance of the original one, and a warning if it is not simpler."""
    result = mesh
    for _ in range(MOST_PASSES):
        coarser = _one_pass(result, original, error)
        if coarser is None or len(coarser.faces) >= len(result.faces):
            break
        before, result = len(result.faces), coarser
        if len(result.faces) > ENOUGH * before:
            break
    if result is mesh:
        return mesh, (f"the mesh was not simplified: none of its {len(mesh.faces):,} triangles can "
                      f"be spared within {error:.6g}",)  # fmt: skip
    return result, ()


def _one_pass(base: Mesh, original: Original, error: float) -> Mesh | None:
    """Return a coarser mesh than ``base`` within the distance of the original one, or None."""
    for halving in range(HALVINGS):
        distance = PLANE_DISTANCE * error / 2**halving
        result = _keeping(
            base,
            lambda kept, distance=distance: collapse_within(base, kept, distance),  # type: ignore[misc]
            lambda result: original.beyond(result, error),
        )
        if result is not None:
            return result
    return None


def down_to(mesh: Mesh, triangles: int) -> tuple[Mesh, tuple[str, ...]]:
    """Return a mesh with at most so many triangles, and a warning if it has more."""
    result: Mesh | None = mesh
    if len(mesh.faces) > triangles:
        nowhere = np.zeros((0, 3))
        result = _keeping(
            mesh, lambda kept: collapse_to(mesh, kept, triangles), lambda result: nowhere
        )
    if result is None:
        result = mesh
    if len(result.faces) > triangles:
        return result, (f"{triangles:,} triangles cannot be reached without faults of the mesh: "
                        f"it has {len(result.faces):,}",)  # fmt: skip
    return result, ()


def _keeping(
    base: Mesh, collapse: Callable[[BoolArray], Mesh], too_far: Callable[[Mesh], Points]
) -> Mesh | None:
    """Collapse a mesh, keeping ever more triangles until nothing is wrong; None if that fails.

    Parameters
    ----------
    base : Mesh
    collapse : callable
        Takes a mask of the triangles to keep, (m,), and returns the collapsed mesh.
    too_far : callable
        Takes the collapsed mesh and returns points, (n, 3), at which it is not accepted.
    """
    kept, before = np.zeros(len(base.faces), bool), irregular_places(base)
    tree: Solid | None = None
    for _ in range(ROUNDS):
        result = collapse(kept)
        if not len(result.faces):
            return None
        faults = new_faults(before, irregular_places(result))
        wrong = np.concatenate([faults, too_far(result)])
        if not len(wrong):
            return result if euler(result) == euler(base) else None
        tree = tree or Solid(base)
        kept |= around(base, tree.nearest_face(wrong))
    return None


def new_faults(before: Points, after: Points) -> Points:
    """Return the points, (n, 3), where a mesh has other irregular places, (k, 6), than before."""
    ours, theirs = row_keys(after), row_keys(before)
    made, lost = after[~np.isin(ours, theirs)], before[~np.isin(theirs, ours)]
    return np.concatenate([made, lost]).reshape(-1, 3)


def around(mesh: Mesh, faces: np.ndarray) -> BoolArray:
    """Return a mask, (m,), of these faces and of all that share a vertex with them."""
    near = np.zeros(len(mesh.vertices), bool)
    near[mesh.faces[faces]] = True
    found: BoolArray = near[mesh.faces].any(1)
    return found


def euler(mesh: Mesh) -> int:
    """Return twice the Euler characteristic of a mesh, plus its number of open edges."""
    return 2 * len(np.unique(mesh.faces)) - len(mesh.faces)
