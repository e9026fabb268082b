"""Surfaces of several labels that share the walls between them; a mesh is that of one label."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import dot, face_normals, unit
from ..surface.mesh import Mesh, row_keys
from ..surface.sharp.folds import intersecting, overlapping_boxes

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


def labels_apart(walls: Walls) -> list[tuple[Mesh, Rows]]:
    """Return the closed mesh of each label from 1 on, and the numbers of its vertices in walls."""
    both, label = np.concatenate([walls.faces, walls.faces[:, ::-1]]), walls.sides.T.ravel()
    order, labels = np.argsort(label, kind="stable"), np.arange(1, label.max(initial=1) + 2)
    number, found = np.empty(len(walls.vertices), np.int32), []
    for faces in np.split(both[order], np.searchsorted(label[order], labels))[1:-1]:
        used = np.zeros(len(walls.vertices), bool)
        used[faces] = True
        point = np.flatnonzero(used)
        number[point] = np.arange(len(point))
        found.append((Mesh(walls.vertices[point], number[faces]), point))
    return found


def irregular(walls: Walls) -> tuple[NDArray[np.float64], Rows, Rows]:
    """Return where a label has no closed manifold, (n, 6): two ends of an edge, or a point twice.

    These are the edges of each label, in the direction of their triangle, without exactly one
    triangle that passes them in the other direction, and the vertices at which several fans of its
    triangles meet, or that are at the position of another one, or at which two triangles have the
    same three corners. Also returned are these points, and the ends of sharp edges.
    """
    odd, sharp = list[Rows](), [np.zeros(0, np.intp)]
    for mesh, point in labels_apart(walls):
        opposite = mesh.pair_edges()[0]
        ends = np.stack([mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()], 1)
        odd += [point[ends[opposite < 0]], point[mesh.count_fans(opposite) > 1, None].repeat(2, 1)]
        normals = unit(face_normals(mesh.vertices.astype(np.float64), mesh.faces))
        is_sharp = dot(normals.repeat(3, 0), normals[opposite // 3]) < SHARP
        sharp.append(point[ends[is_sharp]].ravel())
    doubled = walls.faces[_repeated(np.sort(walls.faces, 1))].ravel()
    same: Rows = np.concatenate([_repeated(walls.vertices), doubled])
    points: Rows = np.concatenate([*odd, same[:, None].repeat(2, 1)]).ravel()
    places: NDArray[np.float64] = walls.vertices[points].astype(np.float64).reshape(-1, 6)
    return places, points, np.concatenate(sharp)


def _repeated(rows: NDArray[Any]) -> Rows:
    """Return the rows that are there several times."""
    keys = row_keys(rows.astype(np.float64))
    _, which, times = np.unique(keys, return_inverse=True, return_counts=True)
    return np.flatnonzero(times[which] > 1)


def faults(walls: Walls, spacing: float) -> Rows:
    """Return the points at which something is wrong with walls, found without other libraries.

    These are ``irregular`` ones, and the corners of triangles that intersect near an edge with an
    angle near 0. ``spacing`` is that of the lattice.
    """
    _, ends, sharp = irregular(walls)
    some = walls.faces[np.isin(walls.faces, sharp).any(1)].astype(np.int64)
    points = (walls.vertices - walls.vertices.mean(0, dtype=np.float64)) / spacing
    one, other = overlapping_boxes(points, some, np.ones(len(points), bool))
    pairs = intersecting(points, some[one], some[other])
    return np.unique(np.concatenate([ends, *(corners.ravel() for corners in pairs)]))
