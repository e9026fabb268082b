"""What the families of solids draw from: sizes, outlines, and ways to place and bend a solid.

Lengths are in the unit of the family that draws; angles are in degrees where manifold3d takes
them, else in radians.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from manifold3d import CrossSection, Manifold, OpType


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a positive number, any two octaves between ``low`` and ``high`` equally likely."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def draw_segments(rng: np.random.Generator) -> int:
    """Draw the number of segments of a full circle, mostly fine, sometimes faceted."""
    return int(rng.choice([6, 8, 12, 24, 24, 32, 32, 32, 48, 48, 48, 64, 64, 64, 96, 96]))


def turned(rng: np.random.Generator, solid: Manifold) -> Manifold:
    """Turn a solid about its origin, mostly by right angles as parts in machines are."""
    if rng.random() < 0.7:
        return solid.rotate([90.0 * n for n in rng.integers(4, size=3)])
    return solid.rotate(list(rng.uniform(-180, 180, 3)))


def joined(solids: Sequence[Manifold]) -> Manifold:
    return Manifold.batch_boolean(solids, OpType.Add)


def unit_sized(solid: Manifold) -> Manifold:
    """Centre a solid on its bounding box and scale the diagonal of that to 1."""
    if solid.is_empty():
        return solid
    low, high = np.reshape(solid.bounding_box(), (2, 3))
    centred = solid.translate(list(-(low + high) / 2))
    return centred.scale([1 / float(np.linalg.norm(high - low))] * 3)


def twisted(solid: Manifold, rate: float) -> Manifold:
    """Twist a solid about the z axis by ``rate`` radians a unit, its faces first cut fine.

    `Manifold.extrude` twists whole side faces, whose diagonals then cut through thin walls.
    """

    def turn(points: np.ndarray) -> np.ndarray:
        turns = np.exp(1j * rate * points[:, 2]) * (points[:, 0] + 1j * points[:, 1])
        return np.stack([turns.real, turns.imag, points[:, 2]], axis=1)

    return solid.refine_to_length(0.05).warp_batch(turn)


def draw_sway(rng: np.random.Generator, strength: float) -> Callable[[np.ndarray], np.ndarray]:
    """Draw a map of points (n, 3) of about unit size that adds sine waves of the position.

    With ``strength`` below 1, which bounds the derivative of the shift, no two points can meet.
    """
    waves = rng.normal(size=(3, 3))
    waves *= rng.uniform(2, 7, (3, 1)) / np.linalg.norm(waves, axis=1, keepdims=True)
    shifts = rng.normal(size=(3, 3))
    lengths = np.linalg.norm(shifts, axis=1) * np.linalg.norm(waves, axis=1)
    shifts *= (strength / 3 / lengths)[:, None]
    phases = rng.uniform(0, 2 * np.pi, 3)
    return lambda points: points + np.sin(points @ waves.T + phases) @ shifts


def swayed(rng: np.random.Generator, solid: Manifold, strength: float) -> Manifold:
    return solid.warp_batch(draw_sway(rng, strength))


def wound(bar: Manifold, coil: float, rise: float, turns: float) -> Manifold:
    """Lay a bar, from z = 0 to 1 and cut fine, along a helix of radius ``coil`` about the z axis.

    A turn climbs by ``rise``; x of the bar points outward and y up.
    """

    def wind(points: np.ndarray) -> np.ndarray:
        angle, radius = 2 * np.pi * turns * points[:, 2], coil + points[:, 0]
        height = points[:, 1] + rise * turns * points[:, 2]
        # x points outward, y up and z along the coil: that order is left-handed.
        return np.stack([radius * np.cos(angle), -radius * np.sin(angle), height], axis=1)

    return bar.warp_batch(wind)


def polar_polygon(angles: np.ndarray, radii: np.ndarray) -> CrossSection:
    """Return the polygon of increasing ``angles`` (n,) and ``radii`` (n,), seen from its inside."""
    return CrossSection([np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)])


def polyline(points: np.ndarray, width: float, segments: int) -> CrossSection:
    """Return the band of a ``width`` along 2D ``points`` (n, 2), with round ends and joints."""
    discs = [CrossSection.circle(width / 2, segments).translate(list(p)) for p in points]
    links = [CrossSection.batch_hull(pair) for pair in pairwise(discs)]
    return CrossSection.batch_boolean(links, OpType.Add)


# Plane outlines, about one unit across and round the origin.


def sharp_outline(rng: np.random.Generator) -> CrossSection:
    """Draw a rectangle, disc, slot, union of bars, irregular polygon, star or wavy curve."""
    segments, count, around = draw_segments(rng), int(rng.integers(3, 13)), 2 * np.pi
    match rng.integers(9):
        case 0 | 1:
            return CrossSection.square(list(rng.uniform(0.15, 1, 2)), True)
        case 2 | 3:
            return CrossSection.circle(0.5, segments).rotate(rng.uniform(0, 90))
        case 4:
            bend = np.array([[-0.4, rng.uniform(-0.3, 0)], [0, 0], [0.4, rng.uniform(-0.3, 0.3)]])
            return polyline(bend, log_uniform(rng, 0.1, 0.5), segments)
        case 5:
            return bars(rng)
        case 6:
            angles = (np.arange(count) + rng.uniform(-0.4, 0.4, count)) * around / count
            return polar_polygon(angles, rng.uniform(0.2, 0.6, count))
        case 7:
            angles = np.arange(2 * count) * around / (2 * count)
            return polar_polygon(angles, np.tile([0.5, rng.uniform(0.15, 0.45)], count))
    angles = np.arange(96) * around / 96
    orders, phases, heights = rng.integers(2, 8, 3), rng.uniform(0, 6, 3), rng.uniform(0, 0.6, 3)
    waves = np.cos(np.outer(angles, orders) + phases) @ (heights / orders)
    return polar_polygon(angles, 0.4 * np.exp(waves))


def bars(rng: np.random.Generator) -> CrossSection:
    """Draw an L, a T, a cross or the like: a union of rectangles that share the origin."""
    parts = []
    for _ in range(rng.integers(2, 5)):
        size = np.array([rng.uniform(0.4, 1), log_uniform(rng, 0.05, 0.4)])[rng.permutation(2)]
        corner = -size * rng.choice([0.1, 0.5, 0.9], 2)
        parts.append(CrossSection.square(list(size)).translate(list(corner)))
    return CrossSection.batch_boolean(parts, OpType.Add)


def draw_outline(rng: np.random.Generator) -> CrossSection:
    """Draw an outline, the outer corners of half of them rounded or chamfered."""
    outline = sharp_outline(rng)
    if rng.random() < 0.5:
        radius, segments = log_uniform(rng, 0.01, 0.1), int(rng.choice([4, 32, 48]))
        opened = outline.offset(-radius).offset(radius, circular_segments=segments)
        return outline if opened.is_empty() else opened
    return outline
