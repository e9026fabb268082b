"""Passes of collapsing edges with pyfqmr: where the result is wrong, they are made anew.

pyfqmr is fast quadric mesh simplification (Forstmann): an edge is collapsed if the sum of squared
distances of the new vertex to the planes of the triangles it replaces is under a threshold, which
rises in every round. It neither bounds the distance of triangles nor keeps every mesh a manifold
without intersections. So the mesh of the last pass is examined. Where it is too far from the
unsimplified mesh, not a manifold, or meets itself, the triangles around the place are kept in the
first pass that got it wrong, and this pass and those after it are made anew.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyfqmr import Simplify

from ..surface.mesh import Mesh, row_keys
from ..truth.solid import Points, Solid, smallest_angles
from .measuring import Original, mean_side

ONE_AT_A_TIME = Lock()  # pyfqmr has one mesh, in global variables
# Edges are collapsed while the new vertex is within this many errors of the planes around it (root
# of the sum of squares), step by step. Those of the first pass hardly ever leave a triangle beyond
# the error, those of the second do at some places, and leave a fifth fewer triangles.
PLANE_DISTANCES = (1.0,), (1.4, 1.4, 1.4), (1.7, 1.7)
ROUNDS = 30, 3.0  # of the threshold, and its rise; from more rounds, meshes get no smaller
FEW_ROUNDS, LARGE = (8, 5.0), 1 << 12  # nearly as well, from this many triangles on
FEW_SLIVERS = 0.002  # of the triangles, which stay
THIN, LOW, STEADY = 0.5, 0.3, 0.7  # of slivers: degrees; height over the error; cosine of normals
MOST_REPEATS, HALVINGS = 16, 3  # of passes, before smaller distances are tried
# A number of triangles is sought by the error that leaves as many.
MOST_ERRORS = 12  # that are tried
FIRST_ERROR = 0.006  # in sides of a triangle, over the share of the triangles that is wanted
STRIDE, CLOSE = 4.0, 1.02  # largest ratio of an error to the next, and smallest of two in the end
FARTHEST = 0.05  # error over the diagonal: larger ones leave no fewer
MARGIN = 1.03  # over the triangles that are left: near enough

Pass = Sequence[dict[str, float]]
"""What ``collapse_edges`` is told, step by step."""


def collapsed(
    mesh: Mesh,
    passes: Sequence[Pass],
    original: Original,
    error: float,
    count_round: Callable[[], None],
) -> Mesh | None:
    """Return what the last pass makes once nothing is wrong with it, None if that fails.

    Right is a mesh within the error of the original, with no place that is less of a manifold than
    in ``mesh``, without triangles that intersect, with all components and their holes.
    """
    meshes = [mesh]
    solids = [original.solid if mesh is original.mesh else Solid(mesh)]
    kept: list[NDArray[np.bool_]] = []  # triangles of each mesh but the last
    places, since = np.zeros((0, 3)), np.zeros(0, np.intp)  # to keep, and from which pass on
    first, before = 0, irregular_places(mesh)  # pass that is to be made anew
    for _ in range(MOST_REPEATS):
        count_round()
        del meshes[first + 1 :], solids[first + 1 :], kept[first:]
        for number, steps in enumerate(passes[first:], first):
            result = meshes[number]
            corners = result.faces[solids[number].nearest_face(places[since <= number])]
            chosen: NDArray[np.bool_] = np.zeros(len(result.vertices), bool)
            chosen[corners] = True
            held: NDArray[np.bool_] = np.any(chosen[result.faces], axis=1)
            kept.append(held)
            count = np.count_nonzero(held)
            for step in steps:
                result = collapse_edges(result, held, **step)
                held = np.arange(len(result.faces)) >= len(result.faces) - count
            if number == len(passes) - 1 and error < np.inf:
                result = turn_edges(result, held, LOW * error)
            meshes.append(result)
            solids.append(Solid(result))
        if not len(result.faces):
            return None
        wrong = faults(result, mesh, before)
        if error < np.inf:
            wrong = np.concatenate([wrong, original.compare(solids[-1], error)[0]])
        if not len(wrong):
            if same_topology(result, mesh):
                return result
            # keep the components of which nothing is left, in all passes
            component = mesh.components()[1][mesh.faces[:, 0]]
            roots = np.unique(result.components()[1][result.faces[:, 0]])
            found = component[solids[0].nearest_face(solids[-1].mesh.vertices[roots])]
            missing = solids[0].mesh.vertices[np.unique(mesh.faces[~np.isin(component, found)])]
            if not len(missing):
                return None
            first, places = 0, np.concatenate([places, missing])
            since = np.append(since, np.zeros(len(missing), np.intp))
            continue
        first = len(passes)
        while len(wrong) and first:  # back to the first pass that got it wrong
            first -= 1
            distance, face, _ = solids[first].nearest(wrong)
            earlier = kept[first][face] | ((distance > error) & (first > 0))
            places = np.concatenate([places, wrong[~earlier]])
            since = np.append(since, np.full(np.count_nonzero(~earlier), first))
            wrong = wrong[earlier]
        if len(wrong):  # although it is kept in all
            return None
    return None


def faults(result: Mesh, mesh: Mesh, before: NDArray[np.float64]) -> Points:
    """Return where a mesh is less of a manifold than another one, or meets itself, (n, 3).

    ``before`` are the irregular places of the other mesh.
    """
    found = irregular_places(result)
    made = found[~np.isin(row_keys(found), row_keys(before))]
    lost = before[~np.isin(row_keys(before), row_keys(found))]
    lost = lost[(lost[:, :3] != lost[:, 3:]).any(1)]  # open edges that are none any more
    wrong = np.concatenate([made, lost]).reshape(-1, 3)
    pairs = Solid(result).intersecting()
    if not len(pairs):
        return wrong
    corners = result.vertices[result.faces[pairs]].astype(np.float64)  # (k, 2, 3, 3)
    old = row_keys(mesh.vertices[mesh.faces].reshape(-1, 9).astype(np.float64))
    is_old = np.isin(row_keys(corners.reshape(-1, 9)), old).reshape(-1, 2).all(1)
    corners = corners[~is_old].reshape(-1, 3, 3)
    return np.concatenate([wrong, corners.reshape(-1, 3), corners.mean(1)])


def within(
    mesh: Mesh, original: Original, error: float, count_round: Callable[[], None]
) -> tuple[Mesh, tuple[str, ...]]:
    """Return a mesh within a distance of the original one, and a warning if it is not simpler."""
    for halving in range(HALVINGS):
        unit = error / 2**halving
        passes = [[{"distance": unit * share} for share in steps] for steps in PLANE_DISTANCES]
        for some in (passes, passes[:1]):
            result = collapsed(mesh, some, original, error, count_round)
            if result and len(result.faces) < len(mesh.faces):
                return result, ()
    return mesh, (
        "the mesh was not simplified: none of its triangles can be spared within the error",
    )


def down_to(
    mesh: Mesh, original: Original, triangles: int, count_round: Callable[[], None]
) -> tuple[Mesh, tuple[str, ...]]:
    """Return a mesh of at most ``triangles`` triangles, or the smallest found and a warning.

    The error is sought that leaves hardly fewer. Each error that is tried is a whole
    simplification, so that the mesh is as good as that of the error.
    """
    if len(mesh.faces) <= triangles:
        return mesh, ()
    farthest = FARTHEST * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    error = min(FIRST_ERROR * original.side * len(mesh.faces) / triangles, farthest)
    low, more, high, fewer = 0.0, len(mesh.faces), np.inf, 0  # errors and what they leave
    reached, least = None, mesh
    for _ in range(MOST_ERRORS):
        result = within(mesh, original, error, count_round)[0]
        left = len(result.faces)
        if left <= triangles:
            reached, high, fewer = result, error, left
        elif left < len(mesh.faces) or not low:
            low, more, least = error, left, min(least, result, key=lambda one: len(one.faces))
        else:  # an error so large that nothing is found within it
            farthest = error
        if triangles < MARGIN * left <= MARGIN * triangles or min(high, farthest) < CLOSE * low:
            break
        # what is left falls about as a power of the error
        if reached and low:
            share = np.log(more / triangles) / np.log(more / fewer)
            error = float(low * (high / low) ** np.clip(share, 0.15, 0.85))
        elif reached:
            error = high * max(fewer / triangles, 1 / STRIDE)
        else:
            error = min(low * min(more / triangles, STRIDE), (low * farthest) ** 0.5)
    if reached:
        return reached, ()
    steps = [{"triangles": float(triangles)}] * 5
    exact = collapsed(least, [steps], original, np.inf, count_round)  # whatever the distance
    if exact and len(exact.faces) <= triangles:
        return exact, ()
    return least, (
        f"{triangles:,} triangles cannot be reached while the mesh stays a manifold of the same "
        f"topology: it has {len(least.faces):,}",
    )


def same_topology(one: Mesh, other: Mesh) -> bool:
    """Return whether both meshes have as many components with the same Euler characteristics.

    That of the whole mesh alone does not change when a ball and a hole are lost. Open edges count.
    """
    numbers = []
    for mesh in (one, other):
        _, component = mesh.components()
        triangles = np.bincount(component[mesh.faces[:, 0]], minlength=len(component))
        vertices = np.bincount(component[np.unique(mesh.faces)], minlength=len(component))
        numbers.append(np.sort((2 * vertices - triangles)[triangles > 0]))
    return np.array_equal(numbers[0], numbers[1])


def collapse_edges(
    mesh: Mesh, kept: NDArray[np.bool_], *, distance: float = 0.0, triangles: float = 0
) -> Mesh:
    """Collapse the edges whose new vertex is within a distance of the planes around it.

    That is the root of the sum of squared distances, in world units. Or, without a distance, those
    until no more than a number of triangles is left, unless the shape does not allow it. The
    triangles that are ``kept``, (m,), stay as they are, with their vertices; open edges stay, too.
    The others are a mesh of its own, whose open edges pyfqmr keeps: there it is joined to the kept
    triangles again.
    """
    target = max(int(triangles) - int(np.count_nonzero(kept)), 0)
    options: dict[str, Any] = {"target_count": target, "update_rate": 1}
    if distance:
        rounds, rise = FEW_ROUNDS if len(mesh.faces) > LARGE else ROUNDS
        options = {"target_count": 0, "max_iterations": rounds}
        options |= {"alpha": rounds**-rise, "K": 1, "aggressiveness": rise}  # to the distance
    unit = distance or mean_side(mesh)  # the length that pyfqmr's thresholds have
    middle = mesh.vertices.mean(0, dtype=np.float64)
    scaled = (mesh.vertices - middle) / unit
    is_used = np.bincount(mesh.faces[~kept].ravel(), minlength=len(scaled)) > 0
    faces, moved = (np.cumsum(is_used, dtype=np.int32) - 1)[mesh.faces[~kept]], scaled[is_used]
    if len(faces):
        with ONE_AT_A_TIME:
            library = Simplify()
            library.setMesh(moved, faces)
            library.simplify_mesh(preserve_border=True, verbose=False, **options)
            moved, faces, _ = library.getMesh()
    held = np.unique(mesh.faces[kept])
    _, found, at = np.intersect1d(row_keys(moved), row_keys(scaled[held]), return_indices=True)
    vertices = (moved * unit + middle).astype(mesh.vertices.dtype)
    vertices[found] = mesh.vertices[held[at]]
    extra, number = np.delete(held, at), np.full(len(scaled), -1, np.int32)
    number[held[at]], number[extra] = found, len(moved) + np.arange(len(extra))
    faces = np.concatenate([faces.astype(np.int32), number[mesh.faces[kept]]])
    return Mesh(np.concatenate([vertices, mesh.vertices[extra]]), faces)


def turn_edges(mesh: Mesh, held: NDArray[np.bool_], distance: float) -> Mesh:
    """Turn the longest edges of slivers that are lower than a distance, where that makes none.

    So the surface moves by less than the distance. The triangles ``held``, (m,), stay.
    """
    points, faces, count = mesh.vertices.astype(np.float64), mesh.faces.copy(), len(mesh.vertices)
    for _ in range(4):  # not all edges can be turned at once
        corners = points[faces]
        thin = np.flatnonzero((smallest_angles(corners) < THIN) & ~held)
        if len(thin) <= FEW_SLIVERS * len(faces):
            break
        sides = np.linalg.norm(corners[thin] - np.roll(corners[thin], -1, axis=1), axis=2)
        solid, flat = Solid(Mesh(points, faces)), faces.ravel()
        normals = solid.normals()
        is_low = np.linalg.norm(normals[thin], axis=1) < distance * sides.max(1, initial=0)
        if not is_low.any():
            break
        half, opposite = (3 * thin + sides.argmax(1))[is_low], solid.mesh.pair_edges()[0]
        half = half[(opposite[half] >= 0) & ~held[opposite[half] // 3]]
        one, other = half // 3, opposite[half] // 3
        a, b, c = (flat[3 * one + (half + turn) % 3] for turn in range(3))
        d = flat[3 * other + (opposite[half] + 2) % 3]
        new = np.stack([c, a, d, d, b, c], axis=1).reshape(-1, 2, 3)
        better = smallest_angles(points[new.reshape(-1, 3)]).reshape(-1, 2).min(1) > THIN
        after = Solid(Mesh(points, new.reshape(-1, 3))).normals().reshape(-1, 2, 3)
        lengths = np.linalg.norm(after, axis=2) * np.linalg.norm(normals[other], axis=1)[:, None]
        steady = (np.einsum("nij,nj->ni", after, normals[other]) > STEADY * lengths).all(1)
        edges = flat.astype(np.int64) * count + np.roll(faces, -1, axis=1).ravel()
        free = ~np.isin(c * np.int64(count) + d, edges) & ~np.isin(d * np.int64(count) + c, edges)
        taken: set[int] = set()
        for row in np.flatnonzero(better & steady & free):
            quad = {int(corner) for corner in new[row].ravel()}
            if not quad & taken:
                taken |= quad
                faces[[one[row], other[row]]] = new[row]
        if not taken:
            break
    return Mesh(mesh.vertices, faces)


def irregular_places(mesh: Mesh) -> NDArray[np.float64]:
    """Return where a mesh is no closed manifold, (n, 6): the two ends of an edge, or a point twice.

    These are the edges, in the direction of their triangle, without exactly one triangle that
    passes them in the other direction, and the vertices at which several fans of triangles meet, or
    that are at the position of another one, or at which two triangles have the same three corners.
    """
    positions, faces = mesh.vertices.astype(np.float64), mesh.faces
    opposite = mesh.pair_edges()[0]
    unpaired, points = opposite < 0, [np.flatnonzero(mesh.count_fans(opposite) > 1)]
    for rows in (positions, np.sort(faces, axis=1).astype(np.float64)):
        _, inverse, uses = np.unique(row_keys(rows), return_inverse=True, return_counts=True)
        points.append(np.flatnonzero(uses[inverse] > 1))
    points[2] = faces[points[2]].ravel().astype(np.intp)
    sides = (faces.ravel()[unpaired], np.roll(faces, -1, 1).ravel()[unpaired])
    return np.concatenate([positions[np.concatenate([end, *points])] for end in sides], axis=1)
