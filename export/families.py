"""Families of procedural solids of a CAD-like kind, made with manifold3d.

A family is a function ``rng -> Manifold`` that draws one kind of solid, about one unit long and
anywhere in space. Lengths inside a family are in its own unit; angles are in degrees where
manifold3d takes them, else in radians.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise
from operator import mul

import numpy as np
from manifold3d import CrossSection, Manifold, OpType
from scipy.interpolate import PchipInterpolator

Family = Callable[[np.random.Generator], Manifold]


# Draws that the families share.


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
    """Return the union of solids."""
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


def swayed(rng: np.random.Generator, solid: Manifold, strength: float) -> Manifold:
    """Move each point by sine waves of the position.

    With ``strength`` below 1, which bounds the derivative of the shift, no two points can meet.
    """
    waves = rng.normal(size=(3, 3))
    waves *= rng.uniform(2, 7, (3, 1)) / np.linalg.norm(waves, axis=1, keepdims=True)
    shifts = rng.normal(size=(3, 3))
    lengths = np.linalg.norm(shifts, axis=1) * np.linalg.norm(waves, axis=1)
    shifts *= (strength / 3 / lengths)[:, None]
    phases = rng.uniform(0, 2 * np.pi, 3)
    return solid.warp_batch(lambda points: points + np.sin(points @ waves.T + phases) @ shifts)


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


# Families.


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
    """Draw unions and differences of primitives."""
    solid = turned(rng, primitive(rng))
    for _ in range(rng.integers(1, 8)):
        part = turned(rng, primitive(rng)).scale([rng.uniform(0.3, 1)] * 3)
        part = part.translate(list(rng.uniform(-0.4, 0.4, 3)))
        solid = solid + part if rng.random() < 0.6 else solid - part
    return solid


def plate(rng: np.random.Generator) -> Manifold:
    """Draw a plate with holes, slots, pockets, bosses and ribs."""
    outline, thickness = draw_outline(rng), log_uniform(rng, 0.02, 0.25)
    solid = outline.extrude(thickness)
    for _ in range(rng.integers(1, 12)):
        foot = draw_outline(rng).rotate(float(rng.choice([0, 90, rng.uniform(0, 360)])))
        foot = foot.scale([log_uniform(rng, 0.04, 0.4)] * 2)
        foot = foot.translate(list(rng.uniform(-0.4, 0.4, 2)))
        bottom = thickness * rng.choice([-1, rng.uniform(0.1, 0.9)])  # a hole or a pocket
        if rng.random() < 0.6:
            solid -= foot.extrude(3 * thickness).translate([0, 0, bottom])
        else:
            boss = foot.extrude(log_uniform(rng, 0.02, 0.4)) ^ outline.extrude(1)
            solid += boss.translate([0, 0, thickness * rng.uniform(0.1, 0.9)])
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


def gear(rng: np.random.Generator) -> Manifold:
    """Draw a spur or helical gear with a bore, a hub or recess, and holes in its web."""
    teeth, root = int(rng.integers(6, 40)), rng.uniform(0.3, 0.46)
    duty = np.cumsum(rng.dirichlet([4, 2, 3, 2]))
    angles = (np.arange(teeth)[:, None] + duty).ravel() * 2 * np.pi / teeth
    outline = polar_polygon(angles, np.tile([root, 0.5, 0.5, root], teeth))
    height, holes = log_uniform(rng, 0.05, 0.6), int(rng.choice([0, 3, 4, 5, 6, 8]))
    for angle in np.arange(holes) * 2 * np.pi / max(holes, 1):
        place = 0.65 * root * np.array([math.cos(angle), math.sin(angle)])
        outline -= CrossSection.circle(root * min(0.2, 1.2 / holes), 32).translate(list(place))
    twist = rng.choice([0.0, rng.uniform(-60, 60)])
    hub = CrossSection.circle(rng.uniform(0.25, 0.4) * root, 48).extrude(height * 2)
    solid = outline.extrude(height, math.ceil(abs(twist) / 4), twist)
    solid += hub.translate([0, 0, -height * rng.uniform(0, 1)])
    bore = CrossSection.circle(rng.uniform(0.1, 0.2) * root, int(rng.choice([6, 32])))
    return solid - bore.extrude(4 * height).translate([0, 0, -1.5 * height])


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


def shell(rng: np.random.Generator) -> Manifold:
    """Draw a thin-walled part: a container, a bent strip, a cut hollow body or a wavy sheet."""
    wall, height = log_uniform(rng, 0.006, 0.06), log_uniform(rng, 0.15, 1.0)
    match rng.integers(4):
        case 0:
            outline = draw_outline(rng)
            hole = outline.offset(-wall).extrude(height)
            return outline.extrude(height) - hole.translate([0, 0, rng.choice([wall, -wall])])
        case 1:
            steps = np.cumsum(rng.normal(0, 0.3, (int(rng.integers(3, 8)), 2)), axis=0)
            return polyline(steps, wall, 16).extrude(height)
        case 2:
            body = unit_sized(PARTS[rng.integers(len(PARTS))](rng))
            hollow = body - body.scale(list(rng.uniform(0.85, 1 - 2 * wall, 3)))
            return hollow.trim_by_plane(list(rng.normal(size=3)), rng.uniform(-0.2, 0.05))
    sheet = Manifold.cube([1, rng.uniform(0.3, 1), wall], True).refine_to_length(0.04)
    return swayed(rng, sheet, 0.9)


def frame(rng: np.random.Generator) -> Manifold:
    """Draw struts: along the edges of a lattice or of a polyhedron, or from node to node."""
    radius, sides = log_uniform(rng, 0.012, 0.06), int(rng.choice([4, 8, 12]))
    if rng.random() < 0.5:
        counts = rng.integers([2, 2, 1], [4, 4, 3])
        nodes = np.indices(tuple(counts)).reshape(3, -1).T * rng.uniform(0.3, 0.5, 3)
        gaps = np.abs(nodes[:, None] - nodes[None])
        linked = (gaps.max(2) < 0.51) & ((gaps > 0).sum(2) <= rng.choice([1, 1, 2]))
    else:
        nodes = rng.uniform(-0.5, 0.5, (int(rng.integers(4, 10)), 3))
        gaps = np.linalg.norm(nodes[:, None] - nodes[None], axis=2)
        linked = gaps <= np.sort(gaps, axis=1)[:, 3:4]
    knot = Manifold.sphere(radius, sides)
    knots = [knot.translate(list(node)) for node in nodes]
    pairs = np.argwhere(np.triu(linked | linked.T, 1))
    return joined([Manifold.batch_hull([knots[a], knots[b]]) for a, b in pairs])


def pipe(rng: np.random.Generator) -> Manifold:
    """Draw a coil or a bent pipe, solid or hollow: a bar laid along a helix."""
    turns, coil, rise = log_uniform(rng, 0.15, 4), rng.uniform(0.15, 0.4), rng.uniform(0.15, 0.4)
    bar = min(coil, rise) * rng.uniform(0.15, 0.45)  # keeps neighbouring windings apart
    outline = draw_outline(rng) if rng.random() < 0.5 else CrossSection.circle(0.5, 24)
    if rng.random() < 0.4:
        outline -= outline.offset(-log_uniform(rng, 0.08, 0.3))
    straight = outline.scale([bar] * 2).extrude(1.0, math.ceil(turns * 36))

    def wind(points: np.ndarray) -> np.ndarray:
        angle, radius = 2 * np.pi * turns * points[:, 2], coil + points[:, 0]
        height = points[:, 1] + rise * turns * points[:, 2]
        # x points outward, y up and z along the coil: that order is left-handed.
        return np.stack([radius * np.cos(angle), -radius * np.sin(angle), height], axis=1)

    return straight.warp_batch(wind)


def wave_sum(terms: Callable[[int, float], Sequence[float]]) -> Callable[..., float]:
    """Return the field whose value at (x, y, z) is the sum over k of X_k(x) Y_k(y) Z_k(z).

    ``terms(axis, coordinate)`` gives the factors of all k; `level_set` asks for few different
    coordinates, so remembering them makes its many calls cheap.
    """
    factors = cache(terms)
    return lambda x, y, z: sum(map(mul, map(mul, factors(0, x), factors(1, y)), factors(2, z)))


def blobs(rng: np.random.Generator) -> Manifold:
    """Draw blobs, from balls to soft boxes, that blend into one another."""
    centres = rng.uniform(-0.3, 0.3, (3, int(rng.integers(2, 8))))
    widths, power = rng.uniform(0.1, 0.35, centres.shape), int(rng.choice([2, 4, 8]))
    blend = wave_sum(
        lambda axis, x: np.exp(-(((x - centres[axis]) / widths[axis]) ** power)).tolist()
    )

    def field(x: float, y: float, z: float) -> float:
        # Made to run almost linearly through the surface, which is interpolated linearly.
        return 1 - math.pow(max(-math.log(blend(x, y, z) + 1e-99), 0), 1 / power)

    return Manifold.level_set(field, [-0.7] * 3 + [0.7] * 3, rng.uniform(0.04, 0.07))


def gyroid(rng: np.random.Generator) -> Manifold:
    """Draw a body filled with a gyroid: one side of it, or a wall along it."""
    rates, level, walls = rng.uniform(5, 12, 3), rng.uniform(-0.5, 0.5), rng.random() < 0.5

    def terms(axis: int, x: float) -> tuple[float, ...]:
        sin, cos = math.sin(rates[axis] * x), math.cos(rates[axis] * x)
        return ((sin, 1.0, cos), (cos, sin, 1.0), (1.0, cos, sin))[axis]

    wave, body = wave_sum(terms), unit_sized(rounded(rng))

    def field(x: float, y: float, z: float) -> float:
        height = wave(x, y, z) - level
        return 0.4 - abs(height) if walls else height

    # A level set is ragged where its bounds cut it, so they lie outside the body.
    bounds = np.array(body.bounding_box()) + np.repeat([-0.05, 0.05], 3)
    return body ^ Manifold.level_set(field, list(bounds), rng.uniform(0.025, 0.04))


def facets(rng: np.random.Generator) -> Manifold:
    """Draw a convex polyhedron, whole or as CSG with a few others."""
    solid = Manifold()
    for n in range(rng.choice([1, 1, 2, 3, 5])):
        points = rng.normal(size=(int(rng.integers(5, 40)), 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True) ** rng.choice([0.5, 1])
        other = Manifold.hull_points(points * rng.uniform(0.15, 0.5, 3))
        other = other.translate(list(rng.uniform(-0.35, 0.35, 3)))
        solid = solid - other if n and rng.random() < 0.5 else solid + other
    return solid


def repeated(rng: np.random.Generator) -> Manifold:
    """Draw a ring or a grid of one part, on or cut into a base: fins, combs, studs, castles."""
    part = unit_sized(turned(rng, primitive(rng)))
    part = part.scale([log_uniform(rng, 0.1, 0.4), log_uniform(rng, 0.1, 1), rng.uniform(0.1, 0.8)])
    base = unit_sized(draw_outline(rng).extrude(log_uniform(rng, 0.03, 0.5)))
    top, most = base.bounding_box()[5], 2 + math.isqrt(4000 // part.num_tri())
    if rng.random() < 0.4:
        count, radius = int(rng.integers(3, min(2 * most, 17))), rng.uniform(0.1, 0.35)
        arm = part.translate([radius, 0, top])
        copies = [arm.rotate([0, 0, 360 * n / count]) for n in range(count)]
    else:
        counts, gap = rng.integers(1, min(most, 8), 2), rng.uniform(0.5, 0.9) / 7
        places = np.indices(tuple(counts)).reshape(2, -1).T - (counts - 1) / 2
        copies = [part.scale([0.3] * 3).translate([*(p * gap), top]) for p in places]
    return base - joined(copies) if rng.random() < 0.35 else base + joined(copies)


PARTS: tuple[Family, ...] = (rounded, lathe, facets, prism, primitive)
FAMILIES: dict[str, Family] = {
    family.__name__: family
    for family in (
        prism, csg, plate, lathe, gear, rounded, shell, frame, pipe, blobs, gyroid, facets, repeated
    )
}  # fmt: skip
