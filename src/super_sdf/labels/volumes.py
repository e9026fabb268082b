"""Meshes whose volumes are those of their samples.

The smooth surface of a convex body is a little smaller than its samples, each taken as a box. So
each label's surface moves by one distance along its normals; a wall by the difference of two.

Points move by a continuous function of space, the mean of the normals near each node of a lattice
and linear between nodes: so shared walls stay shared, and no triangles come to intersect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import CORNERS, Vectors, dot, face_normals, length, sums_at
from ..errors import OptionError
from ..grid.sdf_grid import SdfGrid
from ..surface.mesh import Mesh

CELL = 0.5  # spacings of the samples between nodes
MOST = 0.125  # spacings that a surface may move
ROUNDS = 8
GOOD, NOTED = 1e-6, 1e-3  # of a volume
Rows = NDArray[np.intp]


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


def keep_volumes(meshes: Sequence[Mesh], volumes: Sequence[float], spacing: float) -> list[Mesh]:
    """Return closed meshes moved along their normals until they have the given volumes.

    Meshes have the same vertices where they touch; triangles stay as they are. No surface moves by
    more than an eighth of the ``spacing``, so the volume of a speck may stay another one.
    """
    vertices = np.concatenate([mesh.vertices for mesh in meshes]) + 0  # -0 is 0
    bits = np.ascontiguousarray(vertices).view(f"V{3 * vertices.itemsize}").ravel()
    _, first, place = np.unique(bits, return_index=True, return_inverse=True)
    rows = np.split(place, np.cumsum([len(mesh.vertices) for mesh in meshes])[:-1])
    middle = vertices.mean(0, dtype=np.float64)
    start = points = vertices[first] - middle  # (n, 3), each vertex once
    normals = _mean_normals(start / (CELL * spacing), meshes, rows)
    distances = np.zeros(len(meshes))
    for _ in range(ROUNDS):
        slopes = [_slopes(points[own], mesh.faces) for own, mesh in zip(rows, meshes)]
        off = volumes - np.array([dot(s, points[own]).sum() / 3 for s, own in zip(slopes, rows)])
        if (np.abs(off) <= GOOD * np.abs(volumes)).all():
            break
        effects = np.zeros((len(meshes), len(meshes)))  # on each volume, of each surface
        for nth, (some, vectors) in enumerate(normals):
            moves = np.zeros_like(start)
            moves[some] = vectors
            effects[:, nth] = [dot(s, moves[own]).sum() for s, own in zip(slopes, rows)]
        free = np.abs(distances) < MOST * spacing  # the others have moved as far as they may
        step = np.linalg.lstsq(effects[np.ix_(free, free)], off[free], rcond=None)[0]
        distances[free] = np.clip(distances[free] + step, -MOST * spacing, MOST * spacing)
        points = start.copy()
        for distance, (some, vectors) in zip(distances, normals):
            points[some] += distance * vectors
    points = (middle + points).astype(meshes[0].vertices.dtype)
    return [Mesh(points[own], mesh.faces) for own, mesh in zip(rows, meshes)]


def _slopes(points: Vectors, faces: NDArray[Any]) -> Vectors:
    """Return by how much a volume grows as its vertices move, (n, 3)."""
    return sums_at(faces.ravel(), face_normals(points, faces).repeat(3, 0), len(points)) / 6


def _mean_normals(
    places: Vectors, meshes: Sequence[Mesh], rows: Sequence[Rows]
) -> list[tuple[Rows, Vectors]]:
    """Return the mean normals of each mesh at some rows of places, in cells of the lattice."""
    corners = np.floor(places)[:, None] + CORNERS
    weights = np.prod(1 - np.abs(places[:, None] - corners), axis=2)  # (n, 8)
    _, nodes = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    nodes, count = nodes.reshape(-1, 8), int(nodes.max()) + 1
    found = []
    for mesh, own in zip(meshes, rows):
        slopes = _slopes(places[own], mesh.faces)
        parts, at = weights[own], nodes[own].ravel()
        sums = sums_at(at, (parts[..., None] * slopes[:, None]).reshape(-1, 3), count)
        areas = np.bincount(at, (parts * length(slopes)[:, None]).ravel(), count)
        means = sums / np.maximum(areas, np.finfo(float).tiny)[:, None]
        some = np.flatnonzero((areas > 0)[nodes].any(1))
        found.append((some, (weights[some, :, None] * means[nodes[some]]).sum(1)))
    return found
