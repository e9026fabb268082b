"""Where faces meet, and the samples' spheres that say where exactly.

The planes of a patch meet in a line or in a point: a wedge. The foot point of a sample in the cone
of normals of an edge, outside a convex one or inside a concave one, lies on the edge: ``lean``
moves the wedge's point so that planes and spheres agree.

Reference: Sellán, Batty and Stein, "Reach For the Spheres", 2023.

Positions and lengths are in coarse spacings, from node (0, 0, 0) of the fine lattice, so sample
(i, j, k) is at (i + 1/2, j + 1/2, k + 1/2). Vectors are in columns.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from ...arrays import BoolArray, Index, IntArray, Numbers, Vectors, inner
from ...refine.bounds import SampleSpheres
from .planes import square_falloff

ALONG = 0.6  # distance along an edge at which a sphere counts for a quarter
FARTHEST_ALONG = 1.8
CLOSE_BY = 0.3  # distance along an edge within which no sphere may be pierced: see ``Contact``
OFF_SPHERE = 0.05  # distance from a sphere at which it counts for half
FARTHEST_SPHERE = 0.3
LARGEST_RADIUS = 1.4  # samples near the band's edge, 1.5, may have been truncated there
LEAST_RADIUS = 0.05  # of spheres: of smaller ones the direction is unknown
PIERCED = 0.02  # by which a sphere outside the cone must be pierced to count
TOUCHING = 0.04  # from a sphere at which it is touched ...
TOUCHED_ALONG = 1.0  # ... if it is within this distance along the edge
ITERATIONS = 3
LONGEST_STEP = 0.25
RANK = 0.05  # eigenvalues below this share of the largest leave a direction open
NEAR = 2  # voxels to each side whose samples are looked at


class Wedges(NamedTuple):
    """Where two or more faces meet, one for each of some patches."""

    point: Vectors  # (3, f), on the edge, or the corner
    tangent: Vectors  # (3, f), direction of the edge; 0 at a corner, where three faces or more meet
    sides: Vectors  # (2, 3, f), the two normals that differ most
    cosine: Numbers  # (f,), of the angle between these
    # (f,), 1 if the solid fills less than half of the space round the edge, -1 if it fills more
    convex: Numbers
    # (f, 3, 3), mean of the squares of the normals: how the planes hold the point
    stiffness: Vectors


class Nearby(NamedTuple):
    """Pairs of a wedge and a sphere that passes near it, in the order of the wedges.

    Columns of wedges stand here once for each pair, vectors as (3, n).
    """

    wedge: Index  # (n,)
    centre: Vectors  # the sample
    radius: Numbers
    tangent: Vectors
    outward: Vectors  # (2, 3, n), the sides of the wedge, turned to where the spheres are
    cosine: Numbers
    may_touch: BoolArray  # whether it is an edge, and the sample on the side where the cone is


class Contact(NamedTuple):
    """How spheres stand to the edges that they are near."""

    direction: Vectors  # (3, n), from the sample to the edge, of unit length
    along: Numbers  # (n,), distance along the edge
    gap: Numbers  # (n,), distance from the sphere to the edge, negative if it is pierced
    in_cone: BoolArray  # (n,), whether it must touch the edge, by the normals of the two faces
    # (n,), whether it may not be pierced: further on, the edge may have ended or turned
    is_close: BoolArray


def wedges_of(point: Vectors, normal: Vectors, there: BoolArray) -> Wedges:
    """Return the wedges of patches, at the points nearest to all planes of each.

    A plane is given by a point and a normal, (3, S, f) each; ``there``, (S, f), says which are.
    Normals of the others must be 0.
    """
    count = there.sum(0)
    stiffness = np.stack([(normal[i] * normal).sum(1) for i in range(3)]) / count
    values, vectors = np.linalg.eigh(np.moveaxis(stiffness, 2, 0))
    middle = (point * there).sum(1) / count
    height = inner(point - middle[:, None], normal)
    right = (height * normal).sum(1) / count
    inverse = np.where(values > RANK * values[:, -1:], 1 / np.maximum(values, 1e-9), 0)
    step = np.einsum("pij,pj->pi", vectors, inverse * np.einsum("pij,ip->pj", vectors, right))
    peak = middle + step.T
    pairs = list(combinations(range(len(there)), 2))
    cosines = [
        np.where(there[i] & there[j], inner(normal[:, i], normal[:, j]), 2) for i, j in pairs
    ]
    one, other = np.array(pairs)[np.argmin(cosines, axis=0)].T
    row = np.arange(len(count))
    first, second = normal[:, one, row], normal[:, other, row]
    above = inner(point[:, one, row] - peak, second) + inner(point[:, other, row] - peak, first)
    convex = np.where(above < 0, 1.0, -1.0)
    corner = values[:, 0] > RANK * values[:, -1]
    tangent = np.where(corner, 0, vectors[:, :, 0].T)
    sides = np.stack([first, second])
    return Wedges(peak, tangent, sides, inner(first, second), convex, np.moveaxis(stiffness, 2, 0))


def find_spheres(wedges: Wedges, voxel: IntArray, spheres: SampleSpheres) -> Nearby:
    """Return the spheres that pass within ``FARTHEST_SPHERE`` of each wedge's edge.

    Wedges of a ``voxel``, (f, 3), follow each other, and have the same samples around.
    """
    first = np.append(True, np.any(np.diff(voxel, axis=0) != 0, axis=1))[: len(voxel)]
    number = samples_around(voxel[first], spheres)
    radius = np.abs(spheres.distance) / 2
    usable, of_wedge = (number >= 0) & (radius < LARGEST_RADIUS)[number], np.cumsum(first) - 1
    steps = np.indices((2 * NEAR + 1,) * 3).reshape(3, -1) - float(NEAR)
    start = wedges.point - voxel.T - 0.5
    along = inner(start, wedges.tangent)[:, None] - wedges.tangent.T @ steps
    across = inner(start, start)[:, None] - 2 * start.T @ steps + inner(steps, steps) - along**2
    off = np.sqrt(np.maximum(across, 0))
    off -= np.where(usable, radius[number], np.inf).take(of_wedge, 0)
    kept = (np.abs(off) < FARTHEST_SPHERE) & (np.abs(along) < FARTHEST_ALONG)
    wedge, place = np.nonzero(kept)
    number = number[of_wedge[wedge], place]
    centre = np.stack(np.unravel_index(spheres.number[number], spheres.shape)) + 0.5
    tangent, convex = wedges.tangent.take(wedge, 1), wedges.convex[wedge]
    may_touch = (np.sign(spheres.distance[number]) == convex) & tangent.any(0)
    outward = -convex * wedges.sides.take(wedge, 2)
    columns = centre, radius[number].astype(np.float64), tangent, outward, wedges.cosine[wedge]
    return Nearby(wedge, *columns, may_touch)


def samples_around(voxel: IntArray, spheres: SampleSpheres) -> Index:
    """Return the numbers of the exact samples within ``NEAR`` of voxels (v, 3), -1 for none.

    A line of them along the last axis is searched for at once: (v, 125).
    """
    keys, (nx, ny, nz) = spheres.number, spheres.shape
    di, dj = np.indices((2 * NEAR + 1,) * 2).reshape(2, -1) - NEAR
    i, j, k = voxel[:, 0, None] + di, voxel[:, 1, None] + dj, voxel[:, 2, None]
    line = (i * ny + j) * nz
    start = np.searchsorted(keys, line + np.maximum(k - NEAR, 0))
    number = start[..., None] + np.arange(2 * NEAR + 1)
    there = ((i >= 0) & (i < nx) & (j >= 0) & (j < ny))[..., None] & (number < len(keys))
    place = keys.take(number, mode="clip") - (line + k - NEAR)[..., None]
    there &= place <= (np.minimum(nz - 1 - k, NEAR) + NEAR)[..., None]
    found = np.flatnonzero(there)
    around = np.full(number.size, -1)
    around[found - found % (2 * NEAR + 1) + place.ravel()[found]] = number.ravel()[found]
    return around.reshape(len(voxel), -1)


def contact_of(point: Vectors, near: Nearby) -> Contact:
    """Return how spheres stand to edges at points (3, f); none must touch a corner."""
    away = point.take(near.wedge, 1) - near.centre
    along = inner(away, near.tangent)
    across = away - along * near.tangent
    apart = np.sqrt(inner(across, across))
    direction = across / np.maximum(apart, 1e-12)
    first, second = inner(direction, near.outward[0]), inner(direction, near.outward[1])
    in_cone = (first > near.cosine * second) & (second > near.cosine * first)
    in_cone &= near.may_touch & (apart > LEAST_RADIUS)
    return Contact(direction, along, apart - near.radius, in_cone, np.abs(along) < CLOSE_BY)


def lean(wedges: Wedges, near: Nearby) -> Vectors:
    """Return the points, (3, f), at which planes and spheres agree best, by least squares."""
    point, count, wedge = wedges.point, wedges.point.shape[1], near.wedge
    tangent = wedges.tangent.T
    hold = wedges.stiffness + 1e-3 * np.eye(3) + 1e3 * tangent[:, :, None] * tangent[:, None, :]
    for _ in range(ITERATIONS):
        direction, along, gap, in_cone, is_close = contact_of(point, near)
        counts = in_cone | (is_close & (gap < -PIERCED))
        weight = counts * square_falloff(along / ALONG) / (1 + (gap / OFF_SPHERE) ** 2)
        pull = np.einsum("pij,jp->pi", wedges.stiffness, wedges.point - point)
        stiff = hold.copy()
        for i in range(3):
            pull[:, i] -= np.bincount(wedge, weight * gap * direction[i], count)
            for j in range(i + 1):
                total = np.bincount(wedge, weight * direction[i] * direction[j], count)
                stiff[:, i, j] += total
                if i != j:
                    stiff[:, j, i] += total
        step = np.linalg.solve(stiff, pull[..., None])[..., 0].T
        point = point + np.clip(step, -LONGEST_STEP, LONGEST_STEP)
    return point
