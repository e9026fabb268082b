"""Plain bodies, from a box to a turned part: families that others build on."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from manifold3d import CrossSection, Manifold
from scipy.interpolate import PchipInterpolator

from export.shapes.draws import draw_outline, draw_segments, joined, log_uniform, turned, twisted


def prism(rng: np.random.Generator) -> Manifold:
    """Draw an extrusion, half of them with holes, some twisted or tapered."""
    outline = draw_outline(rng)
    for _ in range(rng.choice([0, 0, 1, 2, 4])):
        hole = draw_outline(rng).scale([log_uniform(rng, 0.1, 0.5)] * 2)
        outline -= hole.translate(list(rng.uniform(-0.25, 0.25, 2)))
    height, taper = log_uniform(rng, 0.1, 2), rng.choice([1, 1, rng.uniform(0.1, 1.2)])
    solid = outline.extrude(height, scale_top=[taper, taper])
    return twisted(solid, rng.uniform(-2, 2)) if rng.random() < 0.3 else solid


def primitive(rng: np.random.Generator) -> Manifold:
    """Draw a box, cylinder, cone, ball, ring or prism, centred, of random proportions."""
    width, depth, height = (float(size) for size in np.exp(rng.uniform(-1.5, 0.2, 3)))
    segments = draw_segments(rng)
    match rng.integers(7):
        case 0 | 1:
            return Manifold.cube([width, depth, height], True)
        case 2:
            return Manifold.cylinder(height, width / 2, width / 2, segments, True)
        case 3:
            return Manifold.cylinder(height, width / 2, rng.choice([0, depth / 2]), segments, True)
        case 4:
            return Manifold.sphere(width / 2, segments)
        case 5:
            ring = CrossSection.circle(width / 5, segments).translate([width / 2, 0])
            return ring.revolve(segments)
    return prism(rng).translate([0, 0, -height / 2])


def csg(rng: np.random.Generator) -> Manifold:
    solid = turned(rng, primitive(rng))
    for _ in range(rng.integers(1, 8)):
        part = turned(rng, primitive(rng)).scale([rng.uniform(0.3, 1)] * 3)
        part = part.translate(list(rng.uniform(-0.4, 0.4, 3)))
        solid = solid + part if rng.random() < 0.6 else solid - part
    return solid


def lathe(rng: np.random.Generator) -> Manifold:
    """Draw a revolved profile: a stepped shaft, a cone or a vase, some bored, some cut open."""
    count = int(rng.integers(2, 9))
    z, radii = np.cumsum(rng.uniform(0.04, 0.3, count)), rng.uniform(0.08, 0.5, count)
    match rng.integers(3):
        case 0:
            z, radii = np.repeat(np.append(z, z[-1] + 0.1), 2)[1:-1], np.repeat(radii, 2)
        case 1:
            fine = np.linspace(z[0], z[-1], 40)
            z, radii = fine, PchipInterpolator(z, radii)(fine)
    ends = [[0, z[0]], *np.stack([radii, z], axis=1), [0, z[-1]]]
    profile = CrossSection([np.array(ends)])
    if rng.random() < 0.4:
        bore = CrossSection.square([rng.uniform(0.02, 0.9) * radii.min(), 9])
        profile -= bore.translate([0, rng.choice([-1, rng.uniform(z[0], z[-1])])])
    angle = 360.0 if rng.random() < 0.8 else rng.uniform(60, 330)
    return profile.revolve(draw_segments(rng), angle)


def rounded(rng: np.random.Generator) -> Manifold:
    """Draw convex bodies with round or chamfered edges, one or a few in a row."""
    spread = rng.uniform(-0.5, 0.5, (int(rng.integers(2, 9)), 3))
    radius = log_uniform(rng, 0.03, 0.3)
    ball = Manifold.sphere(radius, int(rng.choice([8, 16, 24, 32])))
    match rng.integers(5):
        case 0:
            return Manifold.batch_hull([ball.translate(list(p)) for p in spread])
        case 1:
            balls = [ball.scale([rng.uniform(0.3, 1.3)] * 3).translate(list(p)) for p in spread]
            return joined([Manifold.batch_hull(pair) for pair in pairwise(balls)])
        case 2:
            return Manifold.cube(list(rng.uniform(0.1, 1, 3))).minkowski_sum(ball)
        case 3:
            size = rng.uniform(0.3, 1, 3)
            boxes = [size - radius * np.eye(3)[k] for k in range(3)]
            return Manifold.batch_hull([Manifold.cube(list(box), True) for box in boxes])
    return Manifold.batch_hull([turned(rng, primitive(rng)).translate(list(p)) for p in spread[:3]])


PARTS = (rounded, lathe, prism, primitive)
