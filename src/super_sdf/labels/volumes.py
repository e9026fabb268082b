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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import CORNERS, Numbers, Vectors, dot, face_normals, length, sums_at
from ..errors import OptionError
from ..grid.sdf_grid import SdfGrid
from ..simplify.walls import Rows, Walls, faults, labels_apart
from ..surface.mesh import Mesh

CELL = 0.5  # spacings of the samples between nodes
MOST = 0.125  # spacings that a surface may move
ROUNDS, TURNS = 12, 6
GOOD, NOTED = 1e-6, 1e-3  # of a volume


def check_has_volume(grid: SdfGrid, offset: float, *, cap: bool) -> None:
    """Raise OptionError unless the samples of a grid say what volume its mesh should have."""
    if offset:
        said = f"is for the surface of the samples, --offset is {offset:g}: give one only"
    elif not grid.field.sides_only:
        said = f"is for masks and labels, the values are {grid.field.kind}: leave it out"
    elif cap:
        return
    else:
        said = "needs a closed mesh: leave out --open"
    raise OptionError(f"--keep-volume {said}")


def volume_notes(volumes: Mapping[str, tuple[float, float]]) -> list[str]:
    """Return a note on meshes whose volume is not that of their samples, both by a name."""
    off = {name: mesh / samples - 1 for name, (mesh, samples) in volumes.items()}
    far = [f"{name} {share:+.1%}" for name, share in off.items() if abs(share) > NOTED]
    return [f"volumes that are off those of the samples: {', '.join(far)}"] * bool(far)


def keep_volume(mesh: Mesh, volume: float, spacing: float) -> Mesh:
    """Return a closed mesh moved along its normals until it has the given volume."""
    moved = keep_volumes(Walls.of(mesh), [volume], spacing)
    return Mesh(moved.vertices, mesh.faces)


def keep_volumes(walls: Walls, volumes: Sequence[float], spacing: float) -> Walls:
    """Return walls moved along their normals until the labels 1, 2, ... have the given volumes.

    No wall moves by more than an eighth of the ``spacing``, so the volume of a speck may stay
    another one.
    """
    middle, most = walls.vertices.mean(0, dtype=np.float64), MOST * spacing
    start = walls.vertices - middle
    lattice = _mean_normals(replace(walls, vertices=start), len(volumes), CELL * spacing)
    for _ in range(TURNS):
        vertices = middle + _solved(walls, start, lattice, volumes, most)
        moved = replace(walls, vertices=vertices.astype(walls.vertices.dtype))
        wrong = faults(moved, CELL * spacing)
        if not len(wrong):
            return moved
        lattice.normals[np.isin(lattice.node, lattice.nodes[wrong])] = 0
    return walls


def _solved(
    walls: Walls, start: Vectors, lattice: _Lattice, volumes: Sequence[float], most: float
) -> Vectors:
    """Return the points, moved so that the labels have their volumes."""
    effects, distances, points = lattice.effects(len(volumes)), np.zeros(len(volumes)), start
    for _ in range(ROUNDS):
        off = np.asarray(volumes) - _volumes(points, walls, len(volumes))
        if (np.abs(off) <= GOOD * np.abs(volumes)).all():
            break
        free = np.abs(distances) < most  # the others have moved as far as they may
        step = np.linalg.lstsq(effects[np.ix_(free, free)], off[free], rcond=None)[0]
        distances[free] = np.clip(distances[free] + step, -most, most)
        points = start + lattice.moves(distances, most)
    return points


def _volumes(points: Vectors, walls: Walls, count: int) -> Numbers:
    """Return the volumes of the labels 1 to ``count``."""
    a, b, c = (points[corner] for corner in walls.faces.T)
    each = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
    one, other = (np.bincount(side, each, count + 1) for side in walls.sides.T)
    return np.asarray((one - other)[1:], np.float64)


class _Lattice(NamedTuple):
    """Mean normals of labels near the nodes of a lattice that are near walls."""

    nodes: Rows  # (n, 8), round each point ...
    weights: Numbers  # (n, 8), ... and their shares in it
    # for pairs of a node and a label that is near it, in the order of nodes
    node: Rows  # (p,)
    label: Rows  # (p,), from 0 on
    slopes: Vectors  # (p, 3), by which the volume grows as the node moves
    normals: Vectors  # (p, 3)

    def moves(self, distances: Numbers, most: float) -> Vectors:
        """Return the moves of points, (n, 3), if labels move by distances, and nodes by no more."""
        moves = self.normals * distances[self.label, None]
        moves = sums_at(self.node, moves, int(self.node[-1]) + 1)
        moves *= np.minimum(1, most / np.maximum(length(moves), 1e-300))[:, None]
        total = np.zeros((len(self.nodes), 3))
        for near, shares in zip(self.nodes.T, self.weights.T):
            total += shares[:, None] * moves[near]
        return total

    def effects(self, count: int) -> NDArray[np.float64]:
        """Return by how much each label's volume grows as each other one's surface moves."""
        effects = np.zeros((count, count))
        for step in range(count):
            first = np.arange(len(self.node) - step)
            first = first[self.node[first] == self.node[first + step]]
            if not len(first):
                break
            for one, other in ((first, first + step), (first + step, first))[: 1 + (step > 0)]:
                both = self.label[one], self.label[other]
                np.add.at(effects, both, dot(self.slopes[one], self.normals[other]))
        return effects


def _mean_normals(walls: Walls, count: int, cell: float) -> _Lattice:
    """Return the mean normals of the labels 1 to ``count`` near walls, whose middle is at 0."""
    places = walls.vertices / cell
    corners = np.floor(places)[:, None] + CORNERS
    weights = np.prod(1 - np.abs(places[:, None] - corners), axis=2)
    corners -= corners.min((0, 1))
    _, ny, nz = (corners.max((0, 1)) + 1).tolist()
    _, nodes = np.unique(corners @ [ny * nz, nz, 1], return_inverse=True)
    nodes = nodes.reshape(-1, 8)
    mesh, point, first, _ = labels_apart(walls)
    label = np.repeat(np.arange(count), np.diff(first))
    slopes = face_normals(mesh.vertices, mesh.faces).repeat(3, 0) / 6
    slopes = sums_at(mesh.faces.ravel().astype(np.int64), slopes, len(point))
    keys, at = np.unique(nodes[point] * count + label[:, None], return_inverse=True)
    at, shares = at.ravel(), weights[point]
    sums = sums_at(at, (shares[..., None] * slopes[:, None]).reshape(-1, 3), len(keys))
    areas = np.bincount(at, (shares * length(slopes)[:, None]).ravel(), len(keys))
    normals = sums / np.maximum(areas, np.finfo(float).tiny)[:, None]
    return _Lattice(nodes, weights, keys // count, keys % count, sums, normals)
