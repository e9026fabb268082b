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

from ..arrays import CORNERS, Index, Vectors, face_normals, length, sums_at
from ..errors import OptionError
from ..grid.sdf_grid import SdfGrid
from ..simplify.walls import Walls, faults, labels_apart
from ..surface.mesh import row_keys

CELL = 0.5  # spacings of the samples between nodes
MOST = 0.125  # spacings that a surface may move
ROUNDS, TURNS = 30, 6
GOOD, NOTED, FAR = 1e-6, 1e-3, 0.1  # of a volume; the last if it need not be kept


def check_has_volume(grid: SdfGrid, offset: float, *, cap: bool) -> None:
    """Raise OptionError unless the samples of a grid say what volume its mesh should have."""
    if offset or not cap or not grid.field.sides_only:
        said = "--keep-volume is for closed meshes of masks and labels"
        way_out = "leave it out, or --offset and --open"
        raise OptionError(f"{said}, the values are {grid.field.kind}: {way_out}")


def volume_notes(volumes: Mapping[str, tuple[float, float]], least: float = NOTED) -> list[str]:
    """Return a note on meshes whose volume is not that of their samples, both by a name."""
    off = {name: x for name, (mesh, own) in volumes.items() if abs(x := mesh / own - 1) > least}
    way_out = " (see --keep-volume)" * (least == FAR and any(abs(x) < 0.5 for x in off.values()))
    far = [f"{name} {share:+.1%}" for name, share in off.items()]
    return [f"volumes that are off those of the samples: {', '.join(far)}{way_out}"] * bool(far)


def keep_volumes(walls: Walls, volumes: Sequence[float], spacing: float) -> Walls:
    """Return walls moved along their normals until the labels 1, 2, ... have the given volumes.

    No wall moves by more than an eighth of the ``spacing``, so the volume of a speck may stay
    another one.
    """
    movement = _Movement(walls, spacing)
    for _ in range(TURNS):
        moved = replace(walls, vertices=movement.solved(volumes).astype(walls.vertices.dtype))
        wrong = faults(moved, CELL * spacing)
        if not len(wrong):
            return moved
        movement.normals[np.isin(movement.node, movement.nodes[wrong])] = 0
    return walls


class _Movement:
    """Labels that move along their mean normals at the nodes of a lattice that are near walls."""

    def __init__(self, walls: Walls, spacing: float) -> None:
        self.walls, self.most = walls, MOST * spacing
        self.middle = walls.vertices.mean(0, dtype=np.float64)
        self.points = walls.vertices - self.middle
        places = self.points / (CELL * spacing)
        corners = np.floor(places)[:, None] + CORNERS
        # the nodes round each point, (n, 8), and their shares in it
        nodes = np.unique(row_keys(corners.reshape(-1, 3)), return_inverse=True)[1].reshape(-1, 8)
        shares = np.prod(1 - np.abs(places[:, None] - corners), axis=2)
        self.nodes, self.shares, found = nodes, shares, list[tuple[Index, Index, Vectors]]()
        for label, (mesh, own) in enumerate(labels_apart(walls)):
            each = face_normals(self.points[own], mesh.faces).repeat(3, 0) / 6
            # by how much the volume grows as vertices move, (m, 3), and the lengths of that
            slopes = sums_at(mesh.faces.ravel().astype(np.int64), each, len(own))
            slopes = np.insert(slopes, 3, length(slopes), axis=1)
            near, at = np.unique(nodes[own], return_inverse=True)
            each = (shares[own, :, None] * slopes[:, None]).reshape(-1, 4)
            sums = sums_at(at.ravel(), each, len(near))
            normals = sums[:, :3] / np.maximum(sums[:, 3:], np.finfo(float).tiny)
            found.append((near, np.full(len(near), label), normals))
        # of pairs of a node and a label that is near it, (p,), and the mean normals, (p, 3)
        self.node, self.label, self.normals = map(np.concatenate, zip(*found))

    def solved(self, volumes: Sequence[float]) -> Vectors:
        """Return the vertices, moved so that the labels have their volumes; no node farther."""
        faces, sides, points = self.walls.faces, self.walls.sides.T, self.points
        distances, between = np.zeros(len(volumes)), np.zeros((len(volumes) + 1,) * 2)
        np.add.at(between, tuple(sides), length(face_normals(points, faces)) / 2)
        between += between.T  # areas of the walls of two labels
        effects = np.diag(between.sum(1)) - between  # of moves on the volumes of others
        for _ in range(ROUNDS):
            each = np.linalg.det(points[faces]) / 6
            inside, outside = (np.bincount(side, each, len(between)) for side in sides)
            off = np.asarray(volumes) - (inside - outside)[1:]
            if (np.abs(off) <= GOOD * np.abs(volumes)).all():
                break
            free = np.abs(distances) < self.most  # the others have moved as far as they may
            rows = np.ix_(*[np.flatnonzero(free) + 1] * 2)
            step = np.linalg.lstsq(effects[rows], off[free], rcond=None)[0]
            distances[free] = np.clip(distances[free] + step, -self.most, self.most)
            each = self.normals * distances[self.label, None]
            moves = sums_at(self.node, each, self.nodes.max() + 1)
            moves *= np.minimum(1, self.most / np.maximum(length(moves), 1e-300))[:, None]
            points = self.points + np.einsum("ij,ijk->ik", self.shares, moves[self.nodes])
        return np.asarray(self.middle + points)
