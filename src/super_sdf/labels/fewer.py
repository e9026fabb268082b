"""Fewer triangles for the walls between labels, all at once.

Edges of the whole complex are collapsed: each wall is there once, and vertices of seams are shared.
So every label stays closed, and neighbours stay neighbours. What may go wrong is looked for: a
vertex or an edge of a label at which more than one sheet of it meets, two triangles on the same
corners and, if an error is given, a distance or an intersection. Round such places vertices are
held where they are, and all is done anew.

The triangles of each pair of labels come one after the other, and after them a triangle apart from
all others, which stays. pyfqmr keeps the order, so it tells to which pair a triangle belongs. A
vertex is held by a triangle of its own, whose open edges stay.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from itertools import pairwise
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import NEIGHBOURHOOD, IntArray, Vectors, dot, face_normals, unit
from ..surface.mesh import Mesh, row_keys
from ..surface.sharp.folds import intersecting, overlapping_boxes
from ..threads import check_count, chunks_of
from .walls import Walls

Rows = NDArray[np.intp]
SLIGHT = 0.01  # voxels from planes, by default
WITHIN = 0.7, 1.2, 1.7  # errors from planes, in passes: the last get little wrong
ROUNDS, RISE = 8, 5.0  # of the threshold of pyfqmr, which ends at 1
ONE_AT_A_TIME = Lock()  # pyfqmr has one mesh, in global variables
MOST_REPEATS, HALVINGS = 8, 3
SHARP = -0.9  # cosine between the normals of a label's triangles: walls all but touch
ALONE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])


def of_labels(walls: Walls, count: int) -> tuple[IntArray, Rows, list[int], list[int]]:
    """Return the triangles of labels 1 to ``count``, each with vertices of its own.

    Besides the triangles, facing outward, these are the point of each vertex, and where vertices
    and triangles of each label begin.
    """
    both, label = np.concatenate([walls.faces, walls.faces[:, ::-1]]), walls.sides.T.ravel()
    order = np.argsort(label, kind="stable")
    ends = np.searchsorted(label[order], np.arange(1, count + 2)).tolist()
    faces, number, first = both[order[ends[0] :]], np.empty(len(walls.points), np.int32), [0]
    points = []
    for start, stop in pairwise(ends):
        used = np.zeros(len(walls.points), bool)
        own = faces[start - ends[0] : stop - ends[0]]
        used[own] = True
        points.append(np.flatnonzero(used))
        number[points[-1]] = np.arange(first[-1], first[-1] + len(points[-1]))
        first.append(first[-1] + len(points[-1]))
        own[...] = number[own]
    check_count(first[-1], "vertices")
    return faces, np.concatenate(points), first, [end - ends[0] for end in ends]


def meshes_of(walls: Walls, count: int) -> list[Mesh]:
    """Return the closed meshes of labels 1 to ``count``."""
    faces, point, first, ends = of_labels(walls, count)
    return [
        Mesh(walls.points[point[low:high]], faces[start:stop] - np.int32(low))
        for (low, high), (start, stop) in zip(pairwise(first), pairwise(ends))
    ]


def faults(walls: Walls, count: int, spacing: float) -> Rows:
    """Return the points at which something is wrong with the walls.

    There a label's surface is no manifold, or two points or triangles are one, or two triangles
    intersect that have corners at edges with an angle near 0. ``spacing`` is that of the lattice.
    """
    faces, point, _, _ = of_labels(walls, count)
    mesh = Mesh(walls.points[point], faces)
    opposite = mesh.pair_edges()[0]
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    pinched, split = mesh.count_fans(opposite) > 1, opposite < 0
    wrong: list[Rows] = [point[pinched], point[start[split]], point[end[split]]]
    corners = row_keys(np.sort(walls.faces, axis=1).astype(np.float64))
    wrong += [walls.faces[_repeated(corners)].ravel().astype(np.intp)]
    wrong += [
        np.flatnonzero(_repeated(row_keys(walls.points.astype(np.float32).astype(np.float64))))
    ]
    normals = unit(face_normals(mesh.vertices, faces))
    sharp = np.flatnonzero(dot(normals.repeat(3, 0), normals[opposite // 3]) < SHARP)
    suspect = np.zeros(len(walls.points), bool)
    suspect[point[start[sharp]]] = suspect[point[end[sharp]]] = True
    some = walls.faces[suspect[walls.faces].any(1)].astype(np.int64)
    points = walls.points / spacing
    one, other = overlapping_boxes(points, some, np.ones(len(points), bool))
    wrong += [both.ravel() for both in intersecting(points, some[one], some[other])]
    return np.unique(np.concatenate(wrong))


def _repeated(keys: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Return which keys are there more than once."""
    _, which, times = np.unique(keys, return_inverse=True, return_counts=True)
    found: NDArray[np.bool_] = times[which] > 1
    return found


def simplified(
    walls: Walls, count: int, voxel: float, factor: int, error: float | None
) -> tuple[Walls, list[str], list[str]]:
    """Return the walls with fewer triangles, notes and warnings; distances are in world units.

    Without an ``error`` what is spared is spared within about a hundredth of a ``voxel``.
    """
    if find_spec("pyfqmr") is None:
        return walls, ["pyfqmr is not installed: no triangles are spared"], []
    middle, spacing = walls.points.mean(0), voxel / factor
    walls = replace(walls, points=walls.points - middle)
    walls = with_fewer(walls, count, [SLIGHT * voxel], spacing) or walls
    warnings = []
    if error is not None:
        found = within(walls, count, error, spacing)
        if found is None:
            warnings.append("the meshes were not simplified: no way was found within the error")
        walls = found or walls
    return replace(walls, points=walls.points + middle), [], warnings


def with_fewer(
    walls: Walls,
    count: int,
    distances: Sequence[float],
    spacing: float,
    find_wrong: Callable[[Walls], Vectors] | None = None,
) -> Walls | None:
    """Return the walls after collapses within distances of planes, one pass for each.

    ``find_wrong`` returns places of further faults, (n, 3), round which points up to about
    a ``spacing`` are to be held. None if faults remain.
    """
    held, reach = np.zeros(0, np.intp), spacing
    for _ in range(MOST_REPEATS):
        made, kept = walls, held
        for distance in distances:
            made, kept = _pass(made, kept, distance)
        places = made.points[faults(made, count, spacing)]
        if not len(places) and find_wrong:
            places = find_wrong(made)
        if not len(places):
            return made
        before = len(held)
        while len(held) == before and before < len(walls.points):
            near = np.unique(np.floor(places / reach), axis=0)[:, None] + NEIGHBOURHOOD
            among = _among(np.floor(walls.points / reach), near.reshape(-1, 3))
            held = np.union1d(held, np.flatnonzero(among))
            reach *= 1 if len(held) > before else 2
    return None


def within(walls: Walls, count: int, error: float, spacing: float) -> Walls | None:
    """Return the walls with each label within a distance of what it was, both ways.

    ``spacing`` is that of the fine lattice. None if none of several ways leads to it.
    """
    labels = [_Label(mesh) for mesh in meshes_of(walls, count)]

    def find_wrong(made: Walls) -> Vectors:
        found = zip(labels, meshes_of(made, count))
        far = np.concatenate([label.far_from(mesh, error, spacing) for label, mesh in found])
        if not len(far):
            pairs = find_self_intersections(made.points, made.faces.astype(np.int64))[1]
            far = made.points[made.faces[np.unique(pairs)]].mean(1)
        return far

    from igl.predicates import find_self_intersections

    for halving in range(HALVINGS):
        distances = error / 2**halving * np.array(WITHIN)
        if made := with_fewer(walls, count, distances.tolist(), spacing, find_wrong):
            return made
    return None


class _Label:
    """A label's mesh, to measure others against; what was measured holds while triangles stay."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh, self.nearest = mesh, _nearest(mesh)
        self.near = np.zeros(len(mesh.vertices), np.uint64)  # keys of triangles within the error
        self.known = np.zeros(0, np.uint64)  # keys of triangles of which all points are

    def far_from(self, made: Mesh, error: float, step: float) -> Vectors:
        """Return points of this mesh that are farther than the error from another, or it from them.

        Of the other mesh, points at most a ``step`` apart count.
        """
        vertices, keys = (
            self.mesh.vertices,
            row_keys(made.vertices[made.faces].reshape(-1, 9)),
        )
        new = np.flatnonzero(~np.isin(self.near, keys))
        distance, face, _ = _nearest(made)(vertices[new])
        self.near[new] = np.where(distance <= error, keys[face], 0)
        far = vertices[new[distance > error]]
        if len(far):
            return far
        new, wrong = np.flatnonzero(~np.isin(keys, self.known)), np.zeros(0, np.intp)
        for points, nth in points_on(made.vertices[made.faces[new]], step):
            distance, _, feet = self.nearest(points)
            far = np.concatenate([far, feet[distance > error]])
            wrong = np.append(wrong, nth[distance > error])
        self.known = np.union1d(self.known, np.delete(keys[new], wrong))
        return far


def _nearest(mesh: Mesh) -> Callable[[Vectors], tuple[Vectors, Rows, Vectors]]:
    """Return what finds a mesh's nearest point: the distance, the triangle, and where it is."""
    import igl

    tree, faces = igl.AABB(), mesh.faces.astype(np.int32)
    tree.init(mesh.vertices, faces)

    def nearest(points: Vectors) -> tuple[Vectors, Rows, Vectors]:
        if not len(points):
            return np.zeros(0), np.zeros(0, np.intp), np.zeros((0, 3))
        squared, face, feet = tree.squared_distance(mesh.vertices, faces, points)
        return np.sqrt(squared), np.ravel(face), feet

    return nearest


def points_on(triangles: Vectors, step: float) -> Iterator[tuple[Vectors, Rows]]:
    """Yield points of triangles (m, 3, 3), at most a step apart, corners included, and whose."""
    longest = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(1)
    parts = np.maximum(np.ceil(longest / step), 1).astype(np.int64)
    for number in np.unique(parts):
        i, j = np.array([(i, j) for i in range(number + 1) for j in range(number + 1 - i)]).T
        shares = np.stack([i, j, number - i - j]) / number
        rows = np.flatnonzero(parts == number)
        for some in (rows[chunk] for chunk in chunks_of(len(rows), 3 * len(i))):
            points = np.einsum("kn,mkd->mnd", shares, triangles[some])
            yield points.reshape(-1, 3), np.repeat(some, len(i))


def _among(rows: NDArray[Any], others: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which rows of whole numbers, (n, 3), are among others."""
    low, size = others.min(0), np.ptp(others, axis=0) + 1
    along = np.array([size[1] * size[2], size[2], 1])
    inside = ((rows >= low) & (rows < low + size)).all(1)
    found: NDArray[np.bool_] = inside & np.isin((rows - low) @ along, (others - low) @ along)
    return found


def _pass(walls: Walls, held: Rows, distance: float) -> tuple[Walls, Rows]:
    """Return the walls after collapses within a distance of planes, and the held points in them."""
    pair = walls.sides @ np.array([1 << 16, 1])
    order = np.argsort(pair, kind="stable")
    last = np.flatnonzero(np.diff(pair[order], append=-1))
    pairs, points = walls.sides[order[last]], walls.points / distance
    ends = np.tile(ALONE, (len(last), 1)) + 3 * np.repeat(np.arange(len(last)), 3)[:, None]
    tips = points[np.tile(held, 2)] + np.repeat(ALONE[1:], len(held), axis=0)
    points = np.concatenate([points, ends + points.max(0) + 1, tips])
    marks = len(walls.points) + np.arange(3 * len(last)).reshape(-1, 3)
    faces = np.insert(walls.faces[order], last + 1, marks, axis=0)
    one, other = len(points) - len(tips) + np.arange(len(tips)).reshape(2, -1)
    faces = np.concatenate([faces, np.stack([held, one, other], 1)]).astype(np.int32)

    from pyfqmr import Simplify

    options = {"max_iterations": ROUNDS, "alpha": ROUNDS**-RISE, "aggressiveness": RISE, "K": 1}
    with ONE_AT_A_TIME:
        library = Simplify()
        library.setMesh(points, faces)
        library.simplify_mesh(target_count=0, preserve_border=True, verbose=False, **options)
        points, faces, _ = library.getMesh()
    faces, kept = faces[: len(faces) - len(held)], faces[len(faces) - len(held) :, 0]
    number = len(points) - len(tips) - len(ends)
    mark = faces[:, 0] >= number
    nth = np.cumsum(mark)[~mark]
    made = Walls(points[:number] * distance, faces[~mark], pairs[nth])
    return made, kept.astype(np.intp)
