"""Surfaces of several labels that share the walls between them; a mesh is that of one label."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import IntArray, dot, face_normals, unit
from ..surface.mesh import Mesh, row_keys
from ..surface.sharp.folds import intersecting, overlapping_boxes
from ..threads import check_count

Rows = NDArray[np.intp]
SHARP = -0.9  # cosine between the normals of a label's triangles: walls all but touch


@dataclass(frozen=True, eq=False, repr=False)
class Walls(Mesh):
    """Triangles between labels, each once: what bounds a label is closed.

    They are counter-clockwise seen from the second of the labels beside them.
    """

    sides: NDArray[np.int16]  # (m, 2), the labels beside each triangle, the higher one first

    @classmethod
    def of(cls, mesh: Mesh) -> Walls:
        """Return a mesh as the walls between label 1, inside, and 0."""
        sides = np.tile(np.array([1, 0], np.int16), (len(mesh.faces), 1))
        return cls(mesh.vertices, mesh.faces, sides)


class Apart(NamedTuple):
    """The triangles of labels, facing outward, each label with vertices of its own."""

    mesh: Mesh
    point: Rows  # of each vertex: its number among those of the walls
    first: list[int]  # where the vertices of each label begin ...
    ends: list[int]  # ... and its triangles


def labels_apart(walls: Walls) -> Apart:
    """Return the triangles of the labels from 1 on, apart from each other."""
    count = int(walls.sides.max(initial=1))
    both, label = np.concatenate([walls.faces, walls.faces[:, ::-1]]), walls.sides.T.ravel()
    order = np.argsort(label, kind="stable")
    ends = np.searchsorted(label[order], np.arange(1, count + 2)).tolist()
    faces, number, first = both[order[ends[0] :]], np.empty(len(walls.vertices), np.int32), [0]
    points = []
    for start, stop in pairwise(ends):
        used = np.zeros(len(walls.vertices), bool)
        own = faces[start - ends[0] : stop - ends[0]]
        used[own] = True
        points.append(np.flatnonzero(used))
        number[points[-1]] = np.arange(first[-1], first[-1] + len(points[-1]))
        first.append(first[-1] + len(points[-1]))
        own[...] = number[own]
    check_count(first[-1], "vertices")
    point = np.concatenate(points)
    return Apart(Mesh(walls.vertices[point], faces), point, first, [end - ends[0] for end in ends])


def meshes_of(walls: Walls) -> list[Mesh]:
    """Return the closed meshes of the labels from 1 on."""
    mesh, _, first, ends = labels_apart(walls)
    return [
        Mesh(mesh.vertices[low:high], mesh.faces[start:stop] - np.int32(low))
        for (low, high), (start, stop) in zip(pairwise(first), pairwise(ends))
    ]


def irregular_places(walls: Walls) -> NDArray[np.float64]:
    """Return where a label has no closed manifold, (n, 6): two ends of an edge, or a point twice.

    These are the edges of each label, in the direction of their triangle, without exactly one
    triangle that passes them in the other direction, and the vertices at which several fans of its
    triangles meet, or that are at the position of another one, or at which two triangles have the
    same three corners.
    """
    apart = labels_apart(walls)
    ends = _irregular(walls, apart, apart.mesh.pair_edges()[0])
    return walls.vertices.astype(np.float64)[ends].reshape(-1, 6)


def _irregular(walls: Walls, apart: Apart, opposite: IntArray) -> Rows:
    """Return the ends of ``irregular_places``, (n, 2), by their numbers."""
    faces, unpaired = apart.mesh.faces, opposite < 0
    points = [apart.point[apart.mesh.count_fans(opposite) > 1]]
    for rows in (walls.vertices.astype(np.float64), np.sort(walls.faces, 1).astype(np.float64)):
        _, which, times = np.unique(row_keys(rows), return_inverse=True, return_counts=True)
        points.append(np.flatnonzero(times[which] > 1))
    points[2] = walls.faces[points[2]].ravel().astype(np.intp)
    sides = faces.ravel()[unpaired], np.roll(faces, -1, axis=1).ravel()[unpaired]
    return np.stack([np.concatenate([apart.point[side], *points]) for side in sides], axis=1)


def faults(walls: Walls, spacing: float) -> Rows:
    """Return the points at which something is wrong with walls, found without other libraries.

    These are ``irregular_places``, and the corners of triangles that intersect near an edge with an
    angle near 0. ``spacing`` is that of the lattice.
    """
    apart = labels_apart(walls)
    faces, opposite = apart.mesh.faces, apart.mesh.pair_edges()[0]
    normals = unit(face_normals(apart.mesh.vertices.astype(np.float64), faces))
    sharp = np.flatnonzero(dot(normals.repeat(3, 0), normals[opposite // 3]) < SHARP)
    suspect = np.zeros(len(walls.vertices), bool)
    for side in (faces, np.roll(faces, -1, axis=1)):
        suspect[apart.point[side.ravel()[sharp]]] = True
    some = walls.faces[suspect[walls.faces].any(1)].astype(np.int64)
    points = (walls.vertices - walls.vertices.mean(0, dtype=np.float64)) / spacing
    one, other = overlapping_boxes(points, some, np.ones(len(points), bool))
    pairs = intersecting(points, some[one], some[other])
    irregular = _irregular(walls, apart, opposite)
    return np.unique(np.concatenate([irregular.ravel(), *(corners.ravel() for corners in pairs)]))
