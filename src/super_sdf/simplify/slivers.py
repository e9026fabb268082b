"""Triangles with hardly any angle: edges of a simplified mesh are turned or collapsed there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arrays import IntArray
from ..surface.mesh import Mesh
from ..truth.solid import Points

THIN = 0.5  # degrees
BETTER = 1.2  # by which the smallest angle must grow
STEADY = 0.5  # least cosine between normals before and after
ROUNDS = 4


def without_slivers(mesh: Mesh, held: NDArray[np.bool_], distance: float) -> Mesh:
    """Return a mesh with fewer triangles that have an angle under half a degree.

    A triangle lower than ``distance`` over its longest side gets that edge turned; one with a side
    shorter than that gets the side collapsed: so the surface moves by less. Whichever leaves the
    larger angle is done, if any does. The triangles ``held``, (m,), stay, in their order.
    """
    points, faces, held = mesh.vertices.astype(np.float64), mesh.faces.copy(), held.copy()
    for _ in range(ROUNDS):
        thin = np.flatnonzero((smallest_angles(points[faces]) < THIN) & ~held)
        gone = np.zeros(len(faces), bool)
        for face in thin:
            best, change = BETTER * smallest_angles(points[faces[face]][None])[0], None
            for rows, new in () if gone[face] else changes(points, faces, face, distance):
                if held[rows].any() or gone[rows].any() or not len(new):
                    continue
                before = smallest_angles(points[faces[rows]]).min()
                after = smallest_angles(points[new]).min()
                if after > max(best, BETTER * before) and is_steady(points, faces[rows], new):
                    best, change = after, (rows, new)
            if change:
                rows, new = change
                faces[rows[: len(new)]], gone[rows[len(new) :]] = new, True
        faces, held = faces[~gone], held[~gone]
        if not len(thin):
            break
    used = np.zeros(len(points), bool)
    used[faces] = True
    return Mesh(mesh.vertices[used], (np.cumsum(used, dtype=np.int32) - 1)[faces])


def changes(
    points: Points, faces: IntArray, face: int, distance: float
) -> list[tuple[NDArray[np.intp], IntArray]]:
    """Return what may be done about a triangle: rows of faces, and what takes the first of them."""
    corners = faces[face]
    sides = np.linalg.norm(points[corners] - points[np.roll(corners, -1)], axis=1)
    a, b, c = np.roll(corners, -sides.argmax())
    area = np.linalg.norm(np.cross(points[b] - points[a], points[c] - points[a]))
    found = []
    has_a, has_b, has_c = ((faces == corner).any(1) for corner in (a, b, c))
    if area < distance * sides.max() and np.count_nonzero(has_a & has_b) == 2:
        other = np.flatnonzero(has_a & has_b & ~has_c)
        if len(other):
            d = np.setdiff1d(faces[other[0]], (a, b))[0]
            if not (has_c & (faces == d).any(1)).any():
                turned = np.array([[c, a, d], [d, b, c]], faces.dtype)
                found.append((np.array([face, other[0]]), turned))
    if sides.min() < distance:
        p, q = np.roll(corners, -sides.argmin())[:2]
        for start, end in ((p, q), (q, p)):
            star, others = (faces == start).any(1), (faces == end).any(1)
            ring = np.intersect1d(faces[star], faces[others])
            lost = np.flatnonzero(star & others)
            if len(ring) == 4 and len(lost) == 2:  # both ends and two more: stays a manifold
                rows = np.flatnonzero(star & ~others)
                moved = np.where(faces[rows] == start, end, faces[rows])
                found.append((np.concatenate([rows, lost]), moved))
    return found


def is_steady(points: Points, before: IntArray, after: IntArray) -> bool:
    """Return whether new triangles face as the larger ones do that they replace."""
    old, new = (
        np.cross(points[f[:, 1]] - points[f[:, 0]], points[f[:, 2]] - points[f[:, 0]])
        for f in (before, after)
    )
    if len(before) == len(after) == 2:  # a turned edge: both as the larger one
        old = np.tile(old[(old**2).sum(1).argmax()], (2, 1))
    else:
        old = old[: len(new)]
    sizes = np.linalg.norm(old, axis=1) * np.linalg.norm(new, axis=1)
    return bool(((old * new).sum(1) > STEADY * sizes).all())


def smallest_angles(corners: Points) -> NDArray[np.float64]:
    """Return the smallest angle of each triangle, (m,), in degrees; corners are (m, 3, 3)."""
    found = []
    for turn in range(3):
        at, one, other = np.roll(corners, turn, axis=1).transpose(1, 0, 2)
        sine = np.linalg.norm(np.cross(one - at, other - at), axis=1)
        found.append(np.arctan2(sine, ((one - at) * (other - at)).sum(1)))
    return np.degrees(np.min(found, axis=0))
