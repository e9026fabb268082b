"""Families of machine parts: plates, gears, screws, ribbed castings, and letters."""

from __future__ import annotations

import math

import numpy as np
from manifold3d import CrossSection, Manifold, OpType

from export.shapes.draws import draw_outline, joined, log_uniform, polar_polygon, polyline, wound


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


def tooth(rng: np.random.Generator, pitch: float, depth: float) -> CrossSection:
    """Draw the section of a thread from its root outward: pointed, flat, round, or a blade."""
    root, top = 0.49 * pitch * rng.uniform(0.6, 1), rng.choice([0.05, 0.12, 0.25]) * pitch
    lean = rng.choice([0, 0, 1]) * (root - top)  # of a buttress thread
    match rng.integers(4):
        case 0:
            return CrossSection.circle(1, 24).scale([depth, root])
        case 1:
            thin = log_uniform(rng, 0.012, 0.1)
            return CrossSection.square([2 * depth, min(thin, root)], True)
    low = [[-depth / 4, -root], [0, -root]]
    return CrossSection(
        [np.array([*low, [depth, lean - top], [depth, lean + top], [0, root], [-depth / 4, root]])]
    )


def screw(rng: np.random.Generator, length: float, radius: float) -> Manifold:
    """Draw a rod with a thread of one to three starts, right- or left-handed, its ends cut flat."""
    starts, pitch = int(rng.choice([1, 1, 1, 2, 3])), length / log_uniform(rng, 2.5, 16)
    depth = min(rng.uniform(0.4, 1) * pitch, rng.uniform(0.1, 0.45) * radius)
    turns = math.ceil(length / pitch / starts) + 2
    bar = tooth(rng, pitch, depth).extrude(1, 36 * turns - 1)
    ridge = wound(bar, radius - depth, starts * pitch, turns).translate([0, 0, -starts * pitch])
    ridges = [ridge.rotate([0, 0, 360 * n / starts]) for n in range(starts)]
    core = Manifold.cylinder(length, radius - depth, circular_segments=36)
    rod = joined([*ridges, core]).trim_by_plane([0, 0, 1], 0).trim_by_plane([0, 0, -1], -length)
    return rod if rng.random() < 0.5 else rod.mirror([1, 0, 0])


def threads(rng: np.random.Generator) -> Manifold:
    """Draw a threaded rod, a bolt or screw with a head, or a nut or block with a threaded bore."""
    radius, length = log_uniform(rng, 0.06, 0.4), log_uniform(rng, 0.2, 1)
    rod = screw(rng, length, radius)
    sides, wide = int(rng.choice([4, 6, 6, 48])), radius * rng.uniform(1.5, 2.2)
    if rng.random() < 0.25:
        return rod
    if rng.random() < 0.5:
        shank = Manifold.cylinder(rng.uniform(0, 0.4) * length + 0.01, radius, -1, 36)
        head = Manifold.cylinder(rng.uniform(0.3, 0.9) * wide, wide, -1, sides).mirror([0, 0, 1])
        return joined([rod, shank, head])
    return Manifold.cylinder(0.9 * length, wide, -1, sides).translate([0, 0, 0.05 * length]) - rod


def fan(count: int, wall: float) -> CrossSection:
    bar = CrossSection.square([2, wall], True)
    return CrossSection.batch_boolean(
        [bar.rotate(180 * n / count) for n in range(count)], OpType.Add
    )


def fins(rng: np.random.Generator, wall: float) -> CrossSection:
    """Draw parallel bars, a grid of bars or a fan, all over the unit square."""
    count = int(rng.integers(1, min(12, 2 + 0.3 / wall)))
    places = (np.arange(count) + 0.5) / count - 0.5
    bars = [CrossSection.square([2, wall], True).translate([0, y]) for y in places]
    if rng.random() < 0.25:
        return fan(count, wall)
    if rng.random() < 0.4:
        bars += [bar.rotate(rng.choice([60, 90])) for bar in bars]
    section = CrossSection.batch_boolean(bars, OpType.Add)
    return section.rotate(float(rng.choice([0, 0, 45])))


def ribs(rng: np.random.Generator) -> Manifold:
    """Draw a plate, tray or shaft stiffened by thin ribs."""
    wall, height = log_uniform(rng, 0.008, 0.06), log_uniform(rng, 0.05, 0.5)
    kind, floor, outline = rng.integers(4), log_uniform(rng, 0.01, 0.1), draw_outline(rng)
    if kind == 0:  # a shaft, its ribs all round
        core = Manifold.cylinder(height * rng.choice([0.8, 1, 1.5]), rng.uniform(0.05, 0.3), -1, 48)
        return core + (fan(int(rng.integers(1, 13)), wall) ^ outline).extrude(height)
    walls = fins(rng, wall) ^ outline
    if kind == 1:  # a tray with webs inside
        walls += outline - outline.offset(-rng.choice([1, 2]) * wall)
    level = rng.choice([0.01, 0.01, height / 2]) - floor  # of the plate: below, or half-way up
    return walls.extrude(height) + outline.extrude(floor).translate([0, 0, level])


# Letters and signs: what is written on parts, or cut out of sheet, by strokes of a pen.

GRID = np.stack(np.meshgrid([0.0, 0.5], [0.0, 0.5, 1.0]), axis=-1).reshape(-1, 2)


def stroke(rng: np.random.Generator, pen: float, segments: int) -> CrossSection:
    """Draw a line between places of a letter's grid, an arc, or a dot."""
    match rng.integers(5):
        case 0 | 1 | 2:
            places = GRID[rng.permutation(len(GRID))[: rng.integers(2, 5)]]
            return polyline(places, pen, segments)
        case 3:
            start, swept = 90 * rng.integers(4), rng.choice([180, 270, 360])
            angles, tall = np.radians(start + np.linspace(0, swept, 16)), rng.choice([0.25, 0.5])
            arc = np.stack([0.25 + 0.25 * np.cos(angles), tall * np.sin(angles)], axis=1)
            return polyline(arc + np.array([0, rng.choice([tall, 1 - tall])]), pen, segments)
    return CrossSection.circle(0.7 * pen, segments).translate(list(GRID[rng.integers(len(GRID))]))


def writing(rng: np.random.Generator) -> CrossSection:
    """Draw lines of letters, slanted or upright, round the origin and about one unit wide."""
    pen, segments = log_uniform(rng, 0.05, 0.25), int(rng.choice([4, 16]))
    shape, slant = (rng.choice([1, 1, 2, 3]), rng.integers(1, 8)), rng.choice([0, 0, 0.25])
    strokes = [
        stroke(rng, pen, segments).translate([(0.62 + pen) * column, (1.15 + pen) * row])
        for row, column in np.ndindex(shape)
        for _ in range(rng.integers(1, 4))
    ]
    page = CrossSection.batch_boolean(strokes, OpType.Add).transform([[1, slant, 0], [0, 1, 0]])
    low, high = np.reshape(page.bounds(), (2, 2))
    return page.translate(list(-(low + high) / 2)).scale([0.9 / (high - low).max()] * 2)


def text(rng: np.random.Generator) -> Manifold:
    """Draw letters that stand alone, or on a plate: raised, engraved or cut through."""
    page, depth, floor = writing(rng), log_uniform(rng, 0.01, 0.25), log_uniform(rng, 0.03, 0.2)
    low, high = np.reshape(page.bounds(), (2, 2))
    margin, kind = log_uniform(rng, 0.02, 0.15), rng.integers(5)
    plate = CrossSection.square(list(high - low + margin), True)
    if rng.random() < 0.3:
        plate = draw_outline(rng).scale(list(1.5 * (high - low))) + plate
    plate = plate.offset(margin, circular_segments=32).extrude(floor)
    match kind:
        case 0:
            return page.extrude(depth)
        case 1 | 2:
            return plate + page.extrude(depth).translate([0, 0, 0.95 * floor])
        case 3:
            return plate - page.extrude(1).translate([0, 0, max(floor - depth, 0.3 * floor)])
    return plate - page.extrude(1).translate([0, 0, -0.1])
