"""Meshes whose volumes are those of their samples.

The smooth surface of a convex body is a little smaller than its samples, each taken as a box. So
each label's surface moves by one distance along its normals; a wall by the difference of two.

Points move by a continuous function of space: at each node of a lattice the sum of the labels'
moves along their mean normals near it, linear between nodes. No node moves by more than a quarter
of a cell, so moves differ by less than points are apart: walls that are apart stay so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..arrays import CORNERS, IntArray, Numbers, Vectors, dot, face_normals, length, sums_at
from ..errors import OptionError
from ..grid.sdf_grid import SdfGrid
from ..simplify.walls import Walls, faults, labels_apart
from ..surface.mesh import Mesh

CELL = 0.5  # spacings of the samples between nodes
MOST = 0.125  # spacings that a surface may move
ROUNDS, TURNS = 30, 6
GOOD, NOTED = 1e-6, 1e-3  # of a volume


def check_has_volume(grid: SdfGrid, offset: float, *, cap: bool) -> None:
    """Raise OptionError unless the samples of a grid say what volume its mesh should have."""
    if offset or not cap or not grid.field.sides_only:
        raise OptionError(
            f"--keep-volume is for closed meshes of masks and labels, the values are "
            f"{grid.field.kind}: leave it out, or --offset and --open"
        )


def volume_notes(volumes: Mapping[str, tuple[float, float]]) -> list[str]:
    """Return a note on meshes whose volume is not that of their samples, both by a name."""
    off = {name: mesh / samples - 1 for name, (mesh, samples) in volumes.items()}
    far = [f"{name} {share:+.1%}" for name, share in off.items() if abs(share) > NOTED]
    return [f"volumes that are off those of the samples: {', '.join(far)}"] * bool(far)


def keep_volume(mesh: Mesh, volume: float, spacing: float) -> Mesh:
    """Return a closed mesh moved along its normals until it has the given volume."""
    return Mesh(keep_volumes(Walls.of(mesh), [volume], spacing).vertices, mesh.faces)


def keep_volumes(walls: Walls, volumes: Sequence[float], spacing: float) -> Walls:
    """Return walls moved along their normals until the labels 1, 2, ... have the given volumes.

    No wall moves by more than an eighth of the ``spacing``, so the volume of a speck may stay
    another one.
    """
    middle = walls.vertices.mean(0, dtype=np.float64)
    movement = _Movement(walls, walls.vertices - middle, spacing)
    for _ in range(TURNS):
        vertices = (middle + movement.solved(volumes)).astype(walls.vertices.dtype)
        moved = replace(walls, vertices=vertices)
        wrong = faults(moved, CELL * spacing)
        if not len(wrong):
            return moved
        movement.normals[np.isin(movement.node, movement.nodes[wrong])] = 0
    return walls


class _Movement:
    """Labels that move along their mean normals at the nodes of a lattice that are near walls."""

    def __init__(self, walls: Walls, points: Vectors, spacing: float) -> None:
        self.walls, self.points, self.most = walls, points, MOST * spacing
        places = points / (CELL * spacing)
        corners = np.floor(places)[:, None] + CORNERS
        # the nodes round each point, (n, 8), and their shares in it
        self.weights = np.prod(1 - np.abs(places[:, None] - corners), axis=2)
        corners -= corners.min((0, 1))
        _, ny, nz = (corners.max((0, 1)) + 1).tolist()
        keys, nodes = np.unique(corners @ [ny * nz, nz, 1], return_inverse=True)
        self.count, self.nodes = len(keys), nodes.reshape(-1, 8)
        apart = labels_apart(walls)
        slopes = np.concatenate([_slopes(points[own], mesh.faces) for mesh, own in apart])
        point, labels = np.concatenate([own for _, own in apart]), len(apart)
        label = np.repeat(np.arange(labels), [len(own) for _, own in apart])
        pairs = self.nodes[point] * labels + label[:, None]
        pairs, at = np.unique(pairs, return_inverse=True)
        at, shares = at.ravel(), self.weights[point]
        sums = sums_at(at, (shares[..., None] * slopes[:, None]).reshape(-1, 3), len(pairs))
        areas = np.bincount(at, (shares * length(slopes)[:, None]).ravel(), len(pairs))
        # of pairs of a node and a label that is near it, (p,), and the mean normals, (p, 3)
        self.node, self.label = np.divmod(pairs, labels)
        self.normals = sums / np.maximum(areas, np.finfo(float).tiny)[:, None]

    def moved(self, distances: Numbers) -> Vectors:
        """Return the points, (n, 3), if labels move by distances, but no node beyond the limit."""
        moves = sums_at(self.node, self.normals * distances[self.label, None], self.count)
        moves *= np.minimum(1, self.most / np.maximum(length(moves), 1e-300))[:, None]
        points = self.points.copy()
        for near, shares in zip(self.nodes.T, self.weights.T):
            points += shares[:, None] * moves[near]
        return points

    def solved(self, volumes: Sequence[float]) -> Vectors:
        """Return the points, (n, 3), moved so that the labels have their volumes."""
        count, faces, sides = len(volumes), self.walls.faces, self.walls.sides.T
        areas = length(face_normals(self.points, faces)) / 2
        effects = np.zeros((count + 1, count + 1))  # of moves of labels on the volumes of others
        for one, other in ((0, 1), (1, 0)):
            np.add.at(effects, (sides[one], sides[one]), areas)
            np.add.at(effects, (sides[one], sides[other]), -areas)
        distances, points = np.zeros(count), self.points
        for _ in range(ROUNDS):
            a, b, c = (points[corner] for corner in faces.T)
            each = dot(a, np.cross(b, c)) / 6
            inside, outside = (np.bincount(side, each, count + 1) for side in sides)
            off = np.asarray(volumes) - (inside - outside)[1:]
            if (np.abs(off) <= GOOD * np.abs(volumes)).all():
                break
            free = np.abs(distances) < self.most  # the others have moved as far as they may
            rows = np.ix_(*[np.flatnonzero(free) + 1] * 2)
            step = np.linalg.lstsq(effects[rows], off[free], rcond=None)[0]
            distances[free] = np.clip(distances[free] + step, -self.most, self.most)
            points = self.moved(distances)
        return points


def _slopes(points: Vectors, faces: IntArray) -> Vectors:
    """Return by how much the volume of a closed mesh grows as its vertices move, (n, 3)."""
    each = face_normals(points, faces).repeat(3, 0) / 6
    return sums_at(faces.ravel().astype(np.int64), each, len(points))
