"""Passes of collapsing edges with pyfqmr: what turned out wrong is kept, the rest collapsed again.

pyfqmr is fast quadric mesh simplification (Forstmann): an edge is collapsed if the sum of squared
distances of the new vertex to the planes of the triangles it replaces is under a threshold, which
rises in every round. It neither bounds the distance of triangles nor keeps every mesh a manifold.
So where a collapsed mesh is too far from the unsimplified one, or no longer a manifold, the
triangles around the place are kept, and the rest is collapsed again. Passes over the result follow,
in which the triangles to keep are larger already.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyfqmr import Simplify

from ..arrays import BoolArray, IntArray
from ..mesh import Mesh
from ..progress import ShareCallback
from ..topology import irregular_places, row_keys, vertex_components
from ..truth.solid import Points, Solid
from .measuring import Original

COLLAPSING_ROUNDS = 30  # in which the threshold rises to its end; from more, meshes get no smaller
ONE_AT_A_TIME = Lock()  # pyfqmr has one mesh, in global variables
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
ANYWHERE: Points = np.zeros((0, 3))


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
        coarser = None
        for halving in range(HALVINGS):
            distance = PLANE_DISTANCE * error / 2**halving
            collapse = partial(collapse_within, result, distance=distance)
            coarser = _keeping(result, collapse, rounds, partial(original.beyond, distance=error))
            if coarser is not None:
                break
        if coarser is None or len(coarser.faces) >= len(result.faces):
            break
        before, result = len(result.faces), coarser
        if len(result.faces) > ENOUGH * before:
            break
    if result is mesh:
        return mesh, ("the mesh was not simplified: none of its triangles can be spared within the "
                      "error",)  # fmt: skip
    return result, ()


def down_to(mesh: Mesh, triangles: int, rounds: Rounds) -> tuple[Mesh, tuple[str, ...]]:
    """Return a mesh of at most ``triangles`` triangles, or the smallest found and a warning."""
    result = _nearly_to(mesh, triangles, rounds) if len(mesh.faces) > triangles else mesh
    for _ in range(MOST_PASSES):
        if len(result.faces) <= triangles:
            return result, ()
        coarser = _keeping(result, partial(collapse_to, result, triangles=triangles), rounds)
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
        coarser = _keeping(result, partial(collapse_within, result, distance=distance), rounds)
        if coarser is None or len(coarser.faces) < triangles:
            break
        result = coarser
    return result


def _keeping(
    base: Mesh,
    collapse: Callable[[BoolArray], Mesh],
    rounds: Rounds,
    too_far: Callable[[Mesh], Points] = lambda result: ANYWHERE,
) -> Mesh | None:
    """Collapse a mesh, keeping ever more triangles until nothing is wrong; None if that fails.

    ``collapse`` takes a mask of the triangles to keep, (m,); ``too_far`` takes the collapsed mesh
    and returns points, (n, 3), at which it is not accepted.
    """
    before = irregular_places(base)
    kept: BoolArray = np.zeros(len(base.faces), bool)
    tree: Solid | None = None
    for _ in range(MOST_ROUNDS):
        rounds.count()
        result = collapse(kept)
        if not len(result.faces):
            return None
        places = irregular_places(result)
        made = places[~np.isin(row_keys(places), row_keys(before))]
        lost = before[~np.isin(row_keys(before), row_keys(places))]
        lost = lost[(lost[:, :3] != lost[:, 3:]).any(1)]  # open edges that are none any more
        faults = np.concatenate([made, lost]).reshape(-1, 3)
        wrong = np.concatenate([faults, too_far(result)])
        if not len(wrong):
            return result if same_topology(result, base) else None
        tree = tree or Solid(base)
        near = np.zeros(len(base.vertices), bool)
        near[base.faces[tree.nearest_face(wrong)]] = True
        kept[near[base.faces].any(1)] = True
    return None


def same_topology(one: Mesh, other: Mesh) -> bool:
    """Return whether both meshes have as many components with the same Euler characteristics.

    That of the whole mesh alone does not change when a ball and a hole are lost. Open edges count.
    """

    def euler_numbers(mesh: Mesh) -> NDArray[np.int64]:
        used, faces = _renumbered(mesh.faces)
        _, component = np.unique(vertex_components(faces, len(used)), return_inverse=True)
        vertices, triangles = np.bincount(component), np.bincount(component[faces[:, 0]])
        return np.sort(2 * vertices - triangles)

    return np.array_equal(euler_numbers(one), euler_numbers(other))


def collapse_within(mesh: Mesh, kept: BoolArray, distance: float) -> Mesh:
    """Collapse the edges whose new vertex is within a distance of the planes around it.

    That is the root of the sum of squared distances, in world units. The triangles that are
    ``kept``, (m,) bool, stay as they are, with their vertices; open edges stay, too.
    """
    rising = {"alpha": COLLAPSING_ROUNDS**-3.0, "K": 1, "aggressiveness": 3.0}  # to the distance
    limits = {"target_count": 0, "max_iterations": COLLAPSING_ROUNDS, "update_rate": 1}
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
    used, collapsed = _renumbered(mesh.faces[~kept])
    moved = scaled[used]
    if len(collapsed):
        with ONE_AT_A_TIME:
            library = Simplify()
            library.setMesh(moved, collapsed)
            library.simplify_mesh(preserve_border=True, verbose=False, **options)
            moved, collapsed, _ = library.getMesh()
    held = np.unique(mesh.faces[kept])
    _, found, at = np.intersect1d(row_keys(moved), row_keys(scaled[held]), return_indices=True)
    same = (moved[found] == scaled[held[at]]).all(1)
    there = np.full(len(held), -1, np.intp)  # rows of held vertices among the moved
    there[at[same]] = found[same]
    vertices = (moved * unit + middle).astype(mesh.vertices.dtype)
    vertices[there[there >= 0]] = mesh.vertices[held[there >= 0]]
    extra = held[there < 0]
    number = np.full(len(scaled), -1, np.int32)
    number[held] = there
    number[extra] = len(moved) + np.arange(len(extra))
    faces = np.concatenate([collapsed.astype(np.int32), number[mesh.faces[kept]]])
    return Mesh(np.concatenate([vertices, mesh.vertices[extra]]), faces)


def _renumbered(faces: IntArray) -> tuple[NDArray[np.intp], IntArray]:
    """Return the vertices that faces (m, 3) use, and the faces with these numbered from 0."""
    used, numbers = np.unique(faces.ravel(), return_inverse=True)
    return used.astype(np.intp), numbers.astype(np.int32).reshape(-1, 3)
