"""Smooth bodies as fields, with exact distances: what a network for masks learns curvature from.

Lengths are in voxels. A field maps points (n, 3) to values (n,), negative inside, and gradients
(n, 3); the distance to its zero is found by following the gradient to the foot point.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from export.shapes.draws import log_uniform

Field = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]

RADII = 5.0, 150.0  # voxels
TILTS = 0.5, 15.0  # degrees between a plane and one of the lattice
SLICED = 0.3  # share of bodies in thick slices, if any are
STEPS = 12  # to a foot point: points are much nearer to it than the radius of curvature


def length(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vectors, axis=1)


def tilted(rng: np.random.Generator, degrees: float) -> Field:
    """Return a plane that is tilted against one of the lattice's."""
    normal = np.array([[1, 0, 0], [1, 1, 0], [1, 1, 1]][rng.integers(3)], float)
    normal /= np.linalg.norm(normal)
    aside, angle = np.cross(normal, rng.normal(size=3)), np.radians(degrees)
    normal = np.cos(angle) * normal + np.sin(angle) * aside / np.linalg.norm(aside)
    return lambda points: (points @ normal, np.tile(normal, (len(points), 1)))


def ellipsoid(axes: np.ndarray) -> Field:
    def field(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        size = np.maximum(length(points / axes), 1e-9)
        return axes.min() * (size - 1), axes.min() * points / axes**2 / size[:, None]

    return field


def around(core_of: Callable[[np.ndarray], np.ndarray], radius: float) -> Field:
    """Return all that is within ``radius`` of a core, given by its nearest points."""

    def field(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        way = points - core_of(points)
        apart = length(way)
        return apart - radius, way / np.maximum(apart, 1e-9)[:, None]

    return field


def rounded_box(half: np.ndarray, radius: float) -> Field:
    """Return a box with round edges, a bar with round ends, or a ball."""
    return around(lambda points: np.clip(points, -half, half), radius)


def torus(ring: float, radius: float) -> Field:
    def core(points: np.ndarray) -> np.ndarray:
        level = points * [1, 1, 0]
        return ring * level / np.maximum(length(level), 1e-9)[:, None]

    return around(core, radius)


def union(centres: np.ndarray, radii: np.ndarray, blend: float) -> Field:
    """Return balls that blend into one another."""

    def field(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        way = points[:, None] - centres
        apart = np.maximum(np.linalg.norm(way, axis=2), 1e-9)
        to_each = (apart - radii) / blend
        least = to_each.min(1, keepdims=True)
        weights = np.exp(least - to_each)
        total = weights.sum(1)
        gradient = ((weights / total[:, None] / apart)[:, :, None] * way).sum(1)
        return blend * (least[:, 0] - np.log(total)), gradient

    return field


def draw_body(rng: np.random.Generator) -> Field:
    """Draw a smooth body round the origin, its axes those of the lattice unless it is a plane."""
    radius, kind = log_uniform(rng, *RADII), rng.integers(8)
    match kind:
        case 0:
            return tilted(rng, log_uniform(rng, *TILTS))
        case 1:
            return ellipsoid(np.full(3, radius))
        case 2:
            return ellipsoid(radius * np.exp(rng.uniform(0, 0.7, 3)))
        case 3:
            return rounded_box(np.array([0, 0, radius * rng.uniform(0, 4)]), radius)
        case 4:
            return rounded_box(radius * rng.uniform(0, 3, 3), radius)
        case 5:
            return torus(radius * rng.uniform(1.5, 5), radius)
    count = int(rng.integers(2, 6))
    centres, radii = 1.3 * rng.normal(size=(count, 3)), rng.uniform(1, 2.5, count)
    return union(radius * centres, radius * radii, radius * rng.uniform(0.3, 0.8))


def mapped(field: Field, matrix: np.ndarray) -> Field:
    """Return the field of a body of which ``matrix`` maps points to those of the given one."""

    def field_there(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values, gradients = field(points @ matrix.T)
        return values, gradients @ matrix

    return field_there


def draw_smooth(rng: np.random.Generator, thickest: float) -> Field:
    """Draw a smooth body round the origin, half of them turned, some in slices up to so thick."""
    field = draw_body(rng)
    if rng.random() < 0.5:
        field = mapped(field, Rotation.random(rng=rng).as_matrix())
    if thickest > 1 and rng.random() < SLICED:
        field = mapped(field, np.diag(rng.permutation([1, 1, log_uniform(rng, 1, thickest)])))
    return field


def foot_points(field: Field, points: np.ndarray) -> np.ndarray:
    """Return the nearest points, (n, 3), of the zero of a field.

    For points nearer to it than its radius of curvature.
    """
    foot = points
    for step in range(STEPS):
        values, gradients = field(foot)
        square = np.maximum((gradients**2).sum(1), 1e-12)[:, None]
        foot = foot - np.clip(values[:, None] / square, -1e3, 1e3) * gradients
        if step < STEPS - 2:  # the last two only return to the zero
            aside = points - foot
            foot = foot + aside - (aside * gradients).sum(1, keepdims=True) / square * gradients
    return foot


def settle(field: Field, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance of points, (n,), to the zero of a field, and how far it may be off."""
    foot = foot_points(field, points)
    values, gradients = field(foot)
    steep = np.maximum(length(gradients), 1e-6)
    normal, way = gradients / steep[:, None], points - foot
    aside = length(way - (way * normal).sum(1, keepdims=True) * normal)
    side = np.where(field(points)[0] < 0, -1, 1)
    return side * length(way), aside + np.abs(values) / steep
