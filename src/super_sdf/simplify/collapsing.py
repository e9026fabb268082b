"""Passes of collapsing edges with pyfqmr: where the result is wrong, they are made anew.

pyfqmr is fast quadric mesh simplification (Forstmann): an edge is collapsed if the sum of squared
distances of the new vertex to the planes of the triangles it replaces is under a threshold, which
rises in every round. It neither bounds the distance of triangles nor keeps every mesh a manifold
without intersections, and does not collapse the tiny edges beside nodes of the lattice, which
Manifold does first. The result of the last pass is examined. Where it is too far from what it
was made of, not a manifold, or meets itself, the triangles around the place are kept in the first
pass that got it wrong, and this pass and those after it are made anew.

What is simplified are the walls between labels, each once, so that every label stays closed, and
neighbours stay neighbours; a mesh is the wall round one label.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import chain, product
from threading import Lock
from typing import Any

import numpy as np

from ..arrays import BoolArray, length
from ..surface.mesh import Mesh, row_keys
from ..truth import Points, Solid
from .measuring import Original, find
from .walls import Walls, irregular, labels_apart

ONE_AT_A_TIME = Lock()  # pyfqmr has one mesh, in global variables
# Edges are collapsed while the new vertex is within this many errors of the planes around it (root
# of the sum of squares), step by step. Those of the first pass hardly ever leave a triangle beyond
# the error, those of the second do at some places, and leave a fifth fewer triangles.
PLANE_DISTANCES = (0.6,), (1.4, 1.4, 1.4), (1.7, 1.7)
# Manifold collapses edges within these errors, one tried after the other, of meshes with such a
# share of tiny edges, over the mean: turned solids to .0008, others from .0064.
WELDED = 0.15, 0.08, 0.25, 0.04
TINY, TINY_SHARE = 0.003, 0.003
ROUNDS, RISE = 15, 4.0  # of the threshold; fewer leave exact planes in pieces
MOST_REPEATS, HALVINGS = 16, 3  # of passes, before smaller distances are tried
# A number of triangles is sought by the error that leaves as many.
MOST_ERRORS = 12  # that are tried
FIRST_ERROR = 0.006  # in sides of a triangle, over the share of the triangles that is wanted
STRIDE, CLOSE = 4.0, 1.02  # largest ratio of an error to the next, and smallest of two in the end
FARTHEST = 0.05  # error over the diagonal: larger ones leave no fewer
MARGIN = 1.03  # over the triangles that are left: near enough


class Unsimplified:
    """Walls to simplify, and what each of their labels is measured against."""

    def __init__(self, walls: Walls) -> None:
        self.walls, self.originals = walls, [Original(mesh) for mesh, _ in labels_apart(walls)]
        alone = len(self.originals) == 1
        self.solid = self.originals[0].solid if alone else Solid(walls)

    irregular = cached_property(lambda self: irregular(self.walls)[0])


def within(of: Unsimplified, error: float) -> Walls | None:
    """Return walls within a distance of the originals; None if no triangle can be spared."""
    alone = product([of.walls], range(HALVINGS), (PLANE_DISTANCES, PLANE_DISTANCES[:1]))
    ways = chain(((start, 0, PLANE_DISTANCES) for start in welded(of, error)), alone)
    for start, halving, passes in ways:
        result = collapsed(of, start, passes, error / 2**halving, error)
        if result and len(result.faces) < len(of.walls.faces):
            return result
    return None


def down_to(of: Unsimplified, triangles: int) -> Walls:
    """Return walls of at most ``triangles`` triangles, or the fewest that are found.

    The error is sought that leaves hardly fewer. Each error that is tried is a whole
    simplification, so that the mesh is as good as that of the error.
    """
    most, found = len(of.walls.faces), [of.walls]
    farthest = FARTHEST * float(np.linalg.norm(np.ptp(of.walls.vertices, axis=0)))
    error = min(FIRST_ERROR * of.originals[0].side * most / triangles, farthest)
    low, high = 0.0, farthest  # errors that leave too many triangles, and few enough
    for _ in range(MOST_ERRORS * (most > triangles)):
        found.append(within(of, error) or of.walls)
        left = len(found[-1].faces)
        if triangles < left and (left < most or not low):
            low = error
        else:  # few enough; or an error so large that nothing is found within it
            high = error
        if triangles < MARGIN * left <= MARGIN * triangles or high < CLOSE * low:
            break
        # what is left falls about as the error rises
        error *= float(np.clip(left / triangles, 1 / STRIDE, STRIDE))
        if not CLOSE * low < error < high / CLOSE:
            error = (low * high) ** 0.5 if low else high / STRIDE
    return min(reversed(found), key=lambda walls: max(len(walls.faces) - triangles, 0))


def welded(of: Unsimplified, error: float) -> Iterator[Walls]:
    """Yield the closed mesh of one label without most of its tiny edges, if it has many."""
    one, walls = of.originals[0], of.walls
    tiny = length(np.subtract(*walls.vertices[one.edges])) < TINY * one.side
    if len(of.originals) > 1 or tiny.mean() < TINY_SHARE:
        return
    from manifold3d import Error, Manifold, Mesh64

    whole = Manifold(Mesh64(walls.vertices.astype(np.float64), walls.faces.astype(np.uint64)))
    for distance in WELDED if whole.status() == Error.NoError else ():  # else open, say
        left = whole.simplify(distance * error).to_mesh64()
        vertices = left.vert_properties.astype(walls.vertices.dtype)
        yield Walls.of(Mesh(vertices, left.tri_verts.astype(np.int32)))


def collapsed(
    of: Unsimplified, start: Walls, passes: Sequence[Sequence[float]], unit: float, error: float
) -> Walls | None:
    """Return what the last pass makes of a start once nothing is wrong with it, None if that fails.

    Of each pass are the distances, in units, within which edges are collapsed, step by step; see
    ``examine``.
    """
    stages = [(start, of.solid if start is of.walls else Solid(start))]
    kept: list[BoolArray] = []  # triangles of each stage but the last
    places, since = np.zeros((0, 3)), np.zeros(0, np.intp)  # to keep, and from which pass on
    first = 0  # pass that is to be made anew
    for _ in range(MOST_REPEATS):
        del stages[first + 1 :], kept[first:]
        for number, steps in enumerate(passes[first:], first):
            result, solid = stages[number]
            held = np.zeros(len(result.vertices), bool)
            held[result.faces[solid.nearest(places[since <= number])[1]]] = True
            held[result.faces[held[result.faces].any(1)]] = True
            kept.append(np.asarray(held[result.faces].all(1)))
            for distance in steps:
                result, held = collapse_edges(result, held, distance * unit)
            stages.append((result, Solid(result)))
        wrong = examine(of, *stages[-1], error)
        if wrong is None or not len(wrong):
            return None if wrong is None else result
        first = len(passes)
        while len(wrong) and first:  # back to the first pass that got it wrong
            first -= 1
            distances, face, _ = stages[first][1].nearest(wrong)
            earlier = kept[first][face] | ((distances > error) & (first > 0))
            places = np.concatenate([places, wrong[~earlier]])
            since = np.append(since, np.full(np.count_nonzero(~earlier), first))
            wrong = wrong[earlier]
        if len(wrong):  # although it is kept in all
            break
    return None


def examine(of: Unsimplified, result: Walls, solid: Solid, error: float) -> Points | None:
    """Return where a result is wrong, (n, 3); None if its topology is, but no place is known.

    Right are walls of which each label is within the error of its original, with no place that is
    less of a manifold than it was, without new triangles that intersect, with all components and
    their holes. ``solid`` is that of the result.
    """
    labels = [solid]
    if len(of.originals) > 1:
        labels = [Solid(mesh) for mesh, _ in labels_apart(result)]
    if len(labels) < len(of.originals) or not all(len(label.mesh.faces) for label in labels):
        return None
    wrong = [one.compare(label, error)[0] for one, label in zip(of.originals, labels)]
    if len(found := irregular(result)[0]):
        wrong.append(found[~np.isin(row_keys(found), row_keys(of.irregular))].reshape(-1, 3))
    if not any(map(len, wrong)) and len(pairs := solid.intersecting()):  # these take long to find
        corners = solid.mesh.vertices[solid.mesh.faces[pairs]].reshape(-1, 9)
        old = of.solid.mesh.vertices[of.solid.mesh.faces].reshape(-1, 9)
        is_new = find(row_keys(corners), row_keys(old)).reshape(-1, 2).min(1) < 0
        corners = corners.reshape(-1, 2, 3, 3)[is_new]
        wrong += [corners.reshape(-1, 3), corners.mean(2).reshape(-1, 3)]
    if len(far := np.concatenate(wrong)):
        return far
    lost = [lost_places(one.solid, label.mesh) for one, label in zip(of.originals, labels)]
    gone = np.concatenate([far, *(places for places in lost if places is not None)])
    return gone if len(gone) or all(places is None for places in lost) else None


def lost_places(original: Solid, after: Mesh) -> Points | None:
    """Return the vertices of components of which nothing is left; None if the topology is equal."""
    before = original.mesh
    (count, root), (left, roots) = before.components(), after.components()
    used, kept = (np.count_nonzero(np.bincount(each.faces.ravel())) for each in (before, after))
    if count == left and 2 * (used - kept) == len(before.faces) - len(after.faces):
        return None
    component = root[before.faces[:, 0]]
    found = component[original.nearest(after.vertices[np.unique(roots[after.faces[:, 0]])])[1]]
    return before.vertices[before.faces[~np.isin(component, found)]].reshape(-1, 3)


def collapse_edges(
    walls: Walls, held: BoolArray, distance: float, triangles: int = 0
) -> tuple[Walls, BoolArray]:
    """Collapse the edges whose new vertex is within a distance of the planes around it.

    That is the root of the sum of squared distances. With a number of triangles, edges are
    collapsed until no more are left; the distance is then about a side of them. The vertices
    ``held``, (n,), stay where they are, and open edges; also returned is which are held.

    pyfqmr keeps open edges and the order of triangles. So a vertex is held by a triangle of its
    own, and after the triangles of each pair of labels comes one at a vertex apart from all others.
    """
    from pyfqmr import Simplify

    if not len(walls.faces):
        return walls, held
    pair = walls.sides @ np.array([1 << 16, 1])
    order = np.argsort(pair, kind="stable")
    last = np.flatnonzero(np.diff(pair[order], append=-1))
    middle = walls.vertices.mean(0, dtype=np.float64)
    scaled = (walls.vertices - middle) / distance  # which pyfqmr's thresholds are in
    scaled = np.append(scaled, [scaled.max(0) + 2], axis=0)
    pins = np.flatnonzero(held)
    corner = np.append(np.full(len(last), len(held)), pins)
    tips = scaled[np.tile(corner, 2)] + np.repeat(np.eye(3)[:2], len(corner), axis=0)
    lone = np.stack([corner, *(len(scaled) + np.arange(len(tips)).reshape(2, -1))], 1)
    faces = np.insert(walls.faces[order], last + 1, lone[: len(last)], axis=0)
    faces = np.concatenate([faces, lone[len(last) :]]).astype(np.int32)
    options: dict[str, Any] = {"target_count": triangles + len(lone)}
    if not triangles:  # but a threshold that rises to the distance
        options = {"target_count": 0, "max_iterations": ROUNDS}
        options |= {"alpha": ROUNDS**-RISE, "K": 1, "aggressiveness": RISE}
    with ONE_AT_A_TIME:
        library = Simplify()
        library.setMesh(np.concatenate([scaled, tips]), faces)
        library.simplify_mesh(preserve_border=True, verbose=False, update_rate=5, **options)
        moved, faces, _ = library.getMesh()
    moved = moved[: len(moved) - len(tips) - 1]
    faces, pinned = np.split(faces.astype(np.int32), [len(faces) - len(pins)])
    is_mark = faces[:, 0] == len(moved)
    sides = walls.sides[order[last]][np.cumsum(is_mark)[~is_mark]]
    vertices = (moved * distance + middle).astype(walls.vertices.dtype)
    old = find(row_keys(moved), row_keys(scaled[:-1]))
    vertices[old >= 0] = walls.vertices[old[old >= 0]]
    held = np.zeros(len(moved), bool)
    held[pinned[:, 0]] = True
    return Walls(vertices, faces[~is_mark], sides), held
