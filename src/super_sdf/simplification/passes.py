"""Passes of collapsing and measuring: what turned out wrong is kept, the rest collapsed again.

Where a collapsed mesh is too far from the unsimplified one, or no longer a manifold, the triangles
around the place are kept, and the rest is collapsed again. Passes over the result follow, in which
the triangles to keep are larger already.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import igl
import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray
from ..mesh import Mesh
from ..progress import ShareCallback
from ..topology import irregular_places, row_keys
from ..truth.solid import Points, Solid
from .collapsing import collapse_to, collapse_within, mean_side, renumbered
from .measuring import Original

# Edges are collapsed while the new vertex is within this many errors of the planes around it (root
# of the sum of squares). At 1, 1.4, 2, 2.8 and 4, a part keeps 17, 17, 13, 15 and 20 % of its
# triangles at 32^3, another one 9, 9, 8, 9 and 12 %.
PLANE_DISTANCE = 2.0
MOST_PASSES = 20
ENOUGH = 0.9  # a pass that leaves more of the triangles is the last one
LEAST_DISTANCE = 1e-3  # of a triangle's side: the first of the distances that double
DOUBLINGS = 20
MOST_ROUNDS = 8  # of keeping more triangles, before smaller distances are tried
HALVINGS = 3
LEFT = 0.85  # share of the work that is left after a round: a guess


class Rounds:
    """Counts rounds of collapsing and measuring, whose number is not known before."""

    def __init__(self, progress: ShareCallback | None = None) -> None:
        self.progress, self.left = progress, 1.0

    def count(self) -> None:
        """Report that a round begins."""
        if self.progress:
            self.progress(1 - self.left)
        self.left *= LEFT


def within(
    mesh: Mesh, original: Original, error: float, rounds: Rounds
) -> tuple[Mesh, tuple[str, ...]]:
    """Return a mesh within a distance of the original one, and a warning if it is not simpler."""
    result = mesh
    for _ in range(MOST_PASSES):
        coarser = _one_pass(result, original, error, rounds)
        if coarser is None or len(coarser.faces) >= len(result.faces):
            break
        before, result = len(result.faces), coarser
        if len(result.faces) > ENOUGH * before:
            break
    if result is mesh:
        return mesh, ("the mesh was not simplified: none of its triangles can be spared within the "
                      "error",)  # fmt: skip
    return result, ()


def _one_pass(base: Mesh, original: Original, error: float, rounds: Rounds) -> Mesh | None:
    """Return a coarser mesh than ``base`` within the distance of the original one, or None."""
    for halving in range(HALVINGS):
        distance = PLANE_DISTANCE * error / 2**halving
        result = _keeping(
            base,
            partial(collapse_within, base, distance=distance),
            lambda result: original.beyond(result, error),
            rounds,
        )
        if result is not None:
            return result
    return None


def down_to(mesh: Mesh, triangles: int, rounds: Rounds) -> tuple[Mesh, tuple[str, ...]]:
    """Return a mesh of at most ``triangles`` triangles, or the smallest found and a warning."""
    result = _nearly_to(mesh, triangles, rounds) if len(mesh.faces) > triangles else mesh
    for _ in range(MOST_PASSES):
        if len(result.faces) <= triangles:
            return result, ()
        collapse = partial(collapse_to, result, triangles=triangles)
        coarser = _keeping(result, collapse, nothing, rounds)
        if coarser is None or len(coarser.faces) >= len(result.faces):
            break
        result = coarser
    return result, (f"{triangles:,} triangles cannot be reached while the mesh stays a manifold of "
                    f"the same topology: it has {len(result.faces):,}",)  # fmt: skip


def _nearly_to(mesh: Mesh, triangles: int, rounds: Rounds) -> Mesh:
    """Return a mesh with no fewer triangles, by passes with distances that double.

    So flat parts come first, where a collapsed edge costs nothing.
    """
    result, side = mesh, mean_side(mesh)
    for doubling in range(DOUBLINGS):
        distance = LEAST_DISTANCE * side * 2**doubling
        collapse = partial(collapse_within, result, distance=distance)
        coarser = _keeping(result, collapse, nothing, rounds)
        if coarser is None or len(coarser.faces) < triangles:
            break
        result = coarser
    return result


def nothing(mesh: Mesh) -> Points:
    """Return no points: any distance is accepted."""
    return np.zeros((0, 3))


def _keeping(
    base: Mesh,
    collapse: Callable[[BoolArray], Mesh],
    too_far: Callable[[Mesh], Points],
    rounds: Rounds,
) -> Mesh | None:
    """Collapse a mesh, keeping ever more triangles until nothing is wrong; None if that fails.

    Parameters
    ----------
    base : Mesh
    collapse : callable
        Takes a mask of the triangles to keep, (m,), and returns the collapsed mesh.
    too_far : callable
        Takes the collapsed mesh and returns points, (n, 3), at which it is not accepted.
    rounds : Rounds
    """
    before = irregular_places(base)
    kept: BoolArray = np.zeros(len(base.faces), bool)
    tree: Solid | None = None
    for _ in range(MOST_ROUNDS):
        rounds.count()
        result = collapse(kept)
        if not len(result.faces):
            return None
        faults = new_faults(before, irregular_places(result))
        wrong = np.concatenate([faults, too_far(result)])
        if not len(wrong):
            return result if same_topology(result, base) else None
        tree = tree or Solid(base)
        kept[around(base, tree.nearest_face(wrong))] = True
    return None


def new_faults(before: Points, after: Points) -> Points:
    """Return the points, (n, 3), where a mesh has irregular places, (k, 6), that it had not before.

    Also those where it had open edges before and has none.
    """
    ours, theirs = row_keys(after), row_keys(before)
    made, lost = after[~np.isin(ours, theirs)], before[~np.isin(theirs, ours)]
    lost = lost[(lost[:, :3] != lost[:, 3:]).any(1)]
    return np.concatenate([made, lost]).reshape(-1, 3)


def around(mesh: Mesh, faces: NDArray[np.int64]) -> BoolArray:
    """Return a mask, (m,), of these faces and of all that share a vertex with them."""
    near = np.zeros(len(mesh.vertices), bool)
    near[mesh.faces[faces]] = True
    found: BoolArray = np.any(near[mesh.faces], axis=1)
    return found


def same_topology(one: Mesh, other: Mesh) -> bool:
    """Return whether both meshes have as many components with the same Euler characteristics.

    That of the whole mesh alone does not change when a ball and a hole are lost.
    """
    return np.array_equal(euler_numbers(one), euler_numbers(other))


def euler_numbers(mesh: Mesh) -> NDArray[np.int64]:
    """Return twice the Euler characteristic of each component plus its open edges, (k,), sorted."""
    _, faces = renumbered(mesh.faces)
    component = igl.vertex_components(faces)
    vertices, triangles = np.bincount(component), np.bincount(component[faces[:, 0]])
    return np.sort(2 * vertices - triangles)
