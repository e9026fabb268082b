"""CAD parts with details down to a fiftieth of the diagonal: under a voxel of a 32^3 grid."""

from __future__ import annotations

import numpy as np
from manifold3d import CrossSection, Manifold

from export.part_tools import OVERLAP, SEGMENTS, counterbore, disc, drill, filled, through, upright
from export.shapes.draws import joined
from export.shapes.edges import CHAMFER, ROUND, slab, smooth


def housing(rng: np.random.Generator) -> Manifold:
    """Draw a bearing housing: a foot, an eye on a waist with fillets, ribs, counterbored holes."""
    height, eye = rng.uniform(0.32, 0.42), rng.uniform(0.18, 0.23)
    depth, foot = rng.uniform(0.24, 0.34), rng.uniform(0.09, 0.13)
    waist = CrossSection.square([1.3 * eye, height]).translate([-0.65 * eye, 0])
    base = CrossSection.square([1, foot]).translate([-0.5, 0])
    fillet = rng.uniform(0.04, 0.08)
    side = filled(base + waist + disc(eye, 0, height), fillet)
    solid = upright(slab(side, depth, CHAMFER, rng.uniform(0.015, 0.03), 1))
    rib = CrossSection([np.array([[-0.46, 0.0], [0.46, 0.0], [0.0, height]])]).extrude(0.07)
    solid += upright(rib)
    bore = upright(through(rng.uniform(0.5, 0.65) * eye, depth, 0.02))
    hole = counterbore(rng.uniform(0.03, 0.04), 2 * foot).translate([0.37, 0, foot])
    rest = disc(0.085, 0.37).extrude(1).translate([0, 0, foot])  # room for the screw head
    tools = joined([hole, rest])
    return solid - bore.translate([0, 0, height]) - tools - tools.mirror([1, 0, 0])


def block(rng: np.random.Generator) -> Manifold:
    """Draw a hydraulic block: a chamfered cuboid with drillings that meet inside, and a pocket."""
    size = np.array([1.0, *rng.uniform(0.4, 0.7, 2)])
    solid = slab(CrossSection.square(list(size[:2]), True), size[2], CHAMFER, 0.035, 1)
    solid = solid.translate([0, 0, -size[2] / 2])
    bore, sink = rng.uniform(0.05, 0.08), rng.uniform(0.02, 0.035)
    solid -= through(bore, 1, sink).rotate([0, 90, 0])
    places = np.array([-0.33, 0, 0.33]) + rng.uniform(-0.04, 0.04, 3)
    for x, wide in zip(places, rng.uniform(0.8, 1.3, 3)):
        tool = drill(wide * bore, size[2] / 2, sink) + drill(1.7 * wide * bore, 0.06)
        solid -= tool.translate([x, 0, size[2] / 2])
    solid -= drill(0.8 * bore, size[1] / 2, sink).translate([0, 0, size[1] / 2]).rotate([90, 0, 0])
    outline = smooth(CrossSection.square([0.5, 0.6 * size[2]], True), 0.05, SEGMENTS)
    pocket = outline.extrude(1).rotate([-90, 0, 0])
    return solid - pocket.translate([0, 0.5 * size[1] - rng.uniform(0.06, 0.1), 0])


def rod(rng: np.random.Generator) -> Manifold:
    """Draw a connecting rod: two eyes, a web with pockets on both sides, drilled and treated."""
    large, small, depth = rng.uniform(0.2, 0.25), rng.uniform(0.11, 0.15), rng.uniform(0.14, 0.2)
    beam = CrossSection.batch_hull([disc(0.55 * large, 0.2), disc(0.6 * small, 0.8)])
    eyes = disc(large) + disc(small, 0.9)
    outline = filled(beam + eyes, 0.06)
    edge = CHAMFER if rng.random() < 0.5 else ROUND
    solid = slab(outline, depth, edge, rng.uniform(0.015, 0.03), 1).translate([0, 0, -depth / 2])
    hollow = smooth(beam.offset(-0.035) - eyes.offset(0.05), 0.015, SEGMENTS)
    pocket = hollow.extrude(1).translate([0, 0, rng.uniform(0.2, 0.3) * depth])
    bores = through(0.5 * small, depth, 0.02).translate([0.9, 0, 0])
    bores += through(0.62 * large, depth, 0.02)
    oil = drill(0.025, large).rotate([0, -90, 0]).translate([-large, 0, 0])
    return solid - pocket - pocket.mirror([0, 0, 1]) - bores - oil


def clevis(rng: np.random.Generator) -> Manifold:
    """Draw a fork end: a rounded fork with a slot and a cross hole, on a shank drilled along."""
    wide, length = rng.uniform(0.32, 0.42), rng.uniform(0.5, 0.6)
    side = disc(wide / 2, 0, length) + CrossSection.square([wide, length]).translate([-wide / 2, 0])
    solid = upright(slab(side, wide, CHAMFER, rng.uniform(0.02, 0.035), 1))
    gap, floor = rng.uniform(0.35, 0.45) * wide, rng.uniform(0.15, 0.22)
    slot = CrossSection.square([gap, 1]).translate([-gap / 2, floor + gap / 2])
    slot = slot + disc(gap / 2, 0, floor + gap / 2)
    solid -= upright(slot.extrude(2)).rotate([0, 0, 90])
    solid -= upright(through(rng.uniform(0.24, 0.3) * wide, wide, 0.02)).translate([0, 0, length])
    radius, reach = rng.uniform(0.3, 0.38) * wide, rng.uniform(0.3, 0.4)
    shank = slab(disc(radius), reach + OVERLAP, CHAMFER, 0.03, 0).mirror([0, 0, 1])
    solid += shank.translate([0, 0, OVERLAP])
    hole = drill(0.5 * radius, 0.8 * reach, 0.02).mirror([0, 0, 1])
    flat = CrossSection.square([1, 0.12], True).extrude(1).rotate([90, 0, 0])
    flats = flat.translate([0, -0.8 * radius, -0.6 * reach])
    return solid - hole.translate([0, 0, -reach]) - flats - flats.mirror([0, 1, 0])


def groove(rng: np.random.Generator, deep: float) -> CrossSection:
    """Draw the section of a groove below y = 0: a dovetail, a V or a T."""
    half = rng.uniform(0.07, 0.12)
    match rng.integers(3):
        case 0:
            right = [[half, OVERLAP], [half, 0], [1.7 * half, -deep]]
        case 1:
            right = [[1.3 * deep, 0.3 * deep], [0.03, -deep], [0.03, -1.2 * deep]]
        case _:
            right = [[0.7 * half, OVERLAP], [0.7 * half, -deep / 2]]
            right += [[1.7 * half, -deep / 2], [1.7 * half, -deep]]
    left = [[-x, y] for x, y in reversed(right)]
    return CrossSection([np.array(left + right)[::-1]])


def slide(rng: np.random.Generator) -> Manifold:
    """Draw a machine slide: a groove along a chamfered body, counterbored holes, steps, ribs."""
    wide, height = rng.uniform(0.5, 0.65), rng.uniform(0.24, 0.34)
    section = CrossSection.square([wide, height]).translate([-wide / 2, 0])
    flange = CrossSection.square([wide + 0.24, 0.1]).translate([-wide / 2 - 0.12, 0])
    step = rng.uniform(0.02, 0.04)
    body = filled(section + flange, step)
    body -= groove(rng, rng.uniform(0.1, 0.15)).translate([0, height])
    solid = upright(slab(body, 1, CHAMFER, rng.uniform(0.015, 0.03), 1))
    for y in (-0.33, 0, 0.33):
        hole = counterbore(0.028, 0.3).translate([0.37 * wide, y, height])
        rib = CrossSection([np.array([[0, 0], [0.11, 0], [0, 0.12]])]).extrude(0.07)
        solid += upright(rib).translate([wide / 2 - 1e-3, y + 0.16, 0.1 - 1e-3]) ^ box(wide, height)
        solid -= hole + hole.mirror([1, 0, 0])
    pocket = smooth(CrossSection.square([0.5 * wide, 0.7], True), 0.06, SEGMENTS)
    return solid - pocket.extrude(rng.uniform(0.05, 0.08) + OVERLAP).translate([0, 0, -OVERLAP])


def box(wide: float, height: float) -> Manifold:
    """Return the space in which the ribs of a slide may lie, away from its chamfered ends."""
    return Manifold.cube([wide + 0.3, 0.9, 2 * height], True)


def enclosure(rng: np.random.Generator) -> Manifold:
    """Draw half of a case: a deep pocket with ribs, drilled posts, a lip and a window."""
    wide, height, wall = rng.uniform(0.6, 0.8), rng.uniform(0.25, 0.35), rng.uniform(0.05, 0.065)
    corner = rng.uniform(0.08, 0.14)
    outline = smooth(CrossSection.square([1, wide], True), corner, SEGMENTS)
    solid = slab(outline, height, ROUND if rng.random() < 0.5 else CHAMFER, 0.03, 1)
    inner = outline.offset(-wall, circular_segments=SEGMENTS)
    solid -= inner.extrude(1).translate([0, 0, 1.2 * wall])
    places = [[x, y] for x in (-0.38, 0.38) for y in (-wide / 2 + 0.12, wide / 2 - 0.12)]
    posts = joined([disc(0.075, *place).extrude(0.85 * height) for place in places])
    gaps = rng.uniform(0.15, 0.25) * np.array([-1, 0, 1])
    bars = [CrossSection.square([0.05, wide], True).translate([x, 0]) for x in gaps]
    ribs = joined([(bar ^ outline.offset(-wall / 2)).extrude(0.4 * height) for bar in bars])
    solid += posts + ribs
    hole = drill(0.035, 0.6 * height, 0.015)
    drills = joined([hole.translate([*place, 0.85 * height]) for place in places])
    window = disc(0.09).extrude(1).rotate([0, 90, 0]).translate([0, 0, 0.6 * height])
    return solid - drills - window


KINDS = (housing, block, rod, clevis, slide, enclosure)
