"""Edges and corners that lean on the samples' spheres.

The foot point of a sample in the cone of normals of an edge, outside a convex one or inside a
concave one, lies on the edge: its sphere says where the edge is, and whether there is one at all.

References
----------
Kobbelt, Botsch, Schwanecke and Seidel, "Feature Sensitive Surface Extraction from Volume Data",
2001, for the point where the planes meet; Sellán, Batty and Stein, "Reach For the Spheres", 2023,
and Carrera et al., "Dual Contouring of Signed Distance Data", 2026, for the spheres.

Positions and lengths are in coarse spacings, from node (0, 0, 0) of the fine lattice, so sample
(i, j, k) is at (i + 1/2, j + 1/2, k + 1/2).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...arrays import BoolArray, IntArray
from ...refine.field import SampleSpheres
from .patches import Numbers, Vectors, dot, length, unit
from .planes import square_falloff, sums

ALONG = 0.6  # distance along an edge at which a sphere counts for a quarter
FARTHEST_ALONG = 1.8
CLOSE_BY = 0.3  # distance along an edge within which no sphere may be pierced
OFF_SPHERE = 0.05  # distance from a sphere at which it counts for half
FARTHEST_SPHERE = 0.3
LARGEST_RADIUS = 1.4  # samples near the band's edge, 1.5, may have been truncated there
LEAST_RADIUS = 0.05  # of spheres: of smaller ones the direction is unknown
PIERCED = 0.02  # by which a sphere outside the cone must be pierced to count
HOLD = 1.0  # of the planes of a patch, in spheres
ITERATIONS = 3
LONGEST_STEP = 0.25
RANK = 0.05  # eigenvalues below this share of the largest leave a direction open
NEAR = 2  # voxels to each side whose samples are looked at
AROUND: NDArray[np.int64] = np.indices((2 * NEAR + 1,) * 3).reshape(3, -1).T.astype(np.int64) - NEAR
IDENTITY = np.eye(3)


@dataclass(frozen=True, eq=False)
class Wedges:
    """Where two or more faces meet, one for each patch."""

    voxel: NDArray[np.int64]  # (f, 3), the voxel of each
    point: Vectors  # (f, 3), on the edge, or the corner
    tangent: Vectors  # (f, 3), direction of the edge
    corner: BoolArray  # (f,), whether three faces or more meet, so that there is no direction
    sides: Vectors  # (f, 2, 3), the two normals that differ most
    # (f,), 1 if the solid fills less than half of the space round the edge, -1 if it fills more
    convex: Numbers
    # (f, 3, 3), mean of the squares of the normals: how the planes hold the point
    stiffness: Vectors

    @property
    def cosine(self) -> Numbers:
        """Cosine of the angle between the two normals, (f,)."""
        return dot(self.sides[:, 0], self.sides[:, 1])


class Nearby(NamedTuple):
    """Pairs of a wedge and a sphere that passes near it, in the order of the wedges."""

    wedge: NDArray[np.int64]  # (n,)
    centre: Vectors  # (n, 3), the sample
    distance: Numbers  # (n,), its signed distance

    def count_of(self, which: BoolArray, count: int) -> IntArray:
        """Return how many of the chosen spheres each of ``count`` wedges has."""
        return np.bincount(self.wedge[which], minlength=count).astype(np.int32)


class Contact(NamedTuple):
    """How spheres stand to the edges that they are near."""

    direction: Vectors  # (n, 3), from the sample to the edge, of unit length
    along: Numbers  # (n,), distance along the edge
    gap: Numbers  # (n,), distance from the sphere to the edge, negative if it is pierced
    # (n,), whether the sphere must touch the edge, by the normals of the two faces
    in_cone: BoolArray

    @property
    def is_close(self) -> BoolArray:
        """Whether the sphere may not be pierced: further on, the edge may have ended or turned."""
        return np.abs(self.along) < CLOSE_BY


def wedges_of(
    voxel: NDArray[np.int64], point: Vectors, normal: Vectors, there: BoolArray
) -> Wedges:
    """Return the wedges of patches, at the points nearest to all planes of each."""
    count = there.sum(1)
    normal = normal * there[..., None]
    stiffness = np.einsum("pei,pej->pij", normal, normal) / count[:, None, None]
    values, vectors = np.linalg.eigh(stiffness)
    middle = (point * there[..., None]).sum(1) / count[:, None]
    height = dot(point - middle[:, None], normal)
    right = (height[..., None] * normal).sum(1) / count[:, None]
    inverse = np.where(values > RANK * values[:, -1:], 1 / np.maximum(values, 1e-9), 0)
    step = np.einsum("pij,pj->pi", vectors, inverse * np.einsum("pij,pi->pj", vectors, right))
    peak = middle + step
    cosine = np.einsum("pei,pfi->pef", normal, normal)
    cosine[~(there[:, :, None] & there[:, None, :])] = 2
    least = cosine.reshape(len(cosine), there.shape[1] ** 2).argmin(1)
    one, other = np.divmod(least, there.shape[1])
    row = np.arange(len(peak))
    sides = np.stack([normal[row, one], normal[row, other]], 1)
    above = dot(point[row, one] - peak, sides[:, 1]) + dot(point[row, other] - peak, sides[:, 0])
    convex = np.where(above < 0, 1.0, -1.0)
    corner = values[:, 0] > RANK * values[:, -1]
    return Wedges(voxel, peak, vectors[:, :, 0], corner, sides, convex, stiffness)


def find_spheres(wedges: Wedges, spheres: SampleSpheres) -> Nearby:
    """Return the spheres that pass within ``FARTHEST_SPHERE`` of each wedge's edge.

    Wedges of a voxel, which follow each other, have the same samples around.
    """
    first = np.append(True, np.any(np.diff(wedges.voxel, axis=0) != 0, axis=1))[: len(wedges.voxel)]
    number = spheres.index.find(wedges.voxel[first][:, None] + AROUND)  # (v, 125)
    distance: Numbers = spheres.distance.astype(np.float64) / 2
    usable = (number >= 0) & (np.abs(np.append(distance, 0)[number]) < LARGEST_RADIUS)
    voxel = np.cumsum(first) - 1
    wedge, place = np.nonzero(usable[voxel])
    number = number[voxel[wedge], place]
    centre, distance = spheres.voxel_ijk[number] + 0.5, distance[number]
    away = length(wedges.point[wedge] - centre)
    close = np.flatnonzero(away < np.hypot(np.abs(distance) + FARTHEST_SPHERE, FARTHEST_ALONG))
    near = Nearby(wedge[close], centre[close], distance[close])
    contact = contact_of(wedges, near)
    kept = (np.abs(contact.gap) < FARTHEST_SPHERE) & (np.abs(contact.along) < FARTHEST_ALONG)
    return Nearby(near.wedge[kept], near.centre[kept], near.distance[kept])


def contact_of(wedges: Wedges, near: Nearby) -> Contact:
    """Return how spheres stand to edges now; none must touch a corner: few samples could."""
    wedge = near.wedge
    away, convex = wedges.point[wedge] - near.centre, wedges.convex[wedge]
    along = np.where(wedges.corner[wedge], 0, dot(away, wedges.tangent[wedge]))
    across = away - along[:, None] * wedges.tangent[wedge]
    direction, radius = unit(across), length(across)
    outward = -direction * convex[:, None]
    first, second = (dot(outward, wedges.sides[wedge, side]) for side in (0, 1))
    cosine = wedges.cosine[wedge]
    in_cone = (first > cosine * second) & (second > cosine * first) & ~wedges.corner[wedge]
    in_cone &= (np.sign(near.distance) == convex) & (radius > LEAST_RADIUS)
    return Contact(direction, along, radius - np.abs(near.distance), in_cone)


def lean(wedges: Wedges, near: Nearby) -> Wedges:
    """Return the wedges with points at which planes and spheres agree best, by least squares."""
    start, count, wedge = wedges.point, len(wedges.point), near.wedge
    hold = wedges.stiffness * HOLD
    tangent = wedges.tangent[:, :, None] * wedges.tangent[:, None, :]
    hold = hold + 1e-3 * IDENTITY + np.where(wedges.corner, 0, 1e3)[:, None, None] * tangent
    for _ in range(ITERATIONS):
        direction, along, gap, in_cone = contact = contact_of(wedges, near)
        counts = in_cone | (contact.is_close & (gap < -PIERCED))
        weight = counts * square_falloff(along / ALONG) / (1 + (gap / OFF_SPHERE) ** 2)
        pull = -sums(wedge, (weight * gap)[:, None] * direction, count)
        rows = [
            sums(wedge, (weight * component)[:, None] * direction, count)
            for component in direction.T
        ]
        back = np.einsum("pij,pj->pi", wedges.stiffness * HOLD, start - wedges.point)
        step = np.linalg.solve(hold + np.stack(rows, 1), (pull + back)[..., None])[..., 0]
        point = wedges.point + np.clip(step, -LONGEST_STEP, LONGEST_STEP)
        wedges = replace(wedges, point=point)
    return wedges
