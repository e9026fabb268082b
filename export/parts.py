"""Procedural CAD parts to measure edges on: chamfers, fillets, drillings, ribs and pockets.

    python -m export.parts OUT [--count 24] [--seed 0]
    python -m lab figures --shapes FOLDER --parts OUT --only edges

Writes closed meshes, PLY, with a box diagonal of 1. Part n is of kind n modulo 6, its measures
drawn from a generator seeded by (seed, n): the same seed gives the same files. None of the kinds is
one of ``shapes``, which trains the network.

The smallest features are a tenth of the diagonal. In a grid of 32^3 the diagonal of a part that is
turned at random takes 22 to 30 voxels, so these are 2.5 voxels. Lengths are in tenths of the
diagonal, about: 1 is the least width of chamfers, ribs, pockets and most walls (0.65 of those
beside the pocket of a rod), the least arc of fillets and diameter of drillings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold

from export.arguments import Parser, at_least
from export.shapes.draws import joined, unit_sized
from export.shapes.edges import CHAMFER, SIMPLIFIED, can_move, slab, smooth
from export.shapes.solid import mesh_of
from super_sdf import Mesh, write_mesh

TOLERANCE = 2e-6  # of the diagonal: shorter edges are removed
SEGMENTS = 192  # of a circle: facets meet at 2 degrees, which tells little from a smooth surface
OVERLAP = 0.01  # a tool starts that far outside the part
FINER = 10  # ``slab`` simplifies outlines: a tenth of that is left when they are drawn this larger
QUARTER = np.linspace(0, np.pi / 2, SEGMENTS // 8 + 1)
ROUND = np.stack([1 - np.cos(QUARTER), np.sin(QUARTER)], axis=1)  # as in ``edges``, but smoother

Kind = Callable[[np.random.Generator], Manifold]


def disc(radius: float, x: float = 0.0, y: float = 0.0) -> CrossSection:
    return CrossSection.circle(radius, SEGMENTS).translate([x, y])


def rectangle(wide: float, long: float, x: float = 0.0, y: float = 0.0) -> CrossSection:
    return CrossSection.square([wide, long], True).translate([x, y])


def drill(radius: float, depth: float) -> Manifold:
    """Return a drill that enters at the origin, downward."""
    return Manifold.cylinder(depth + OVERLAP, radius, -1, SEGMENTS).translate([0, 0, -depth])


def through(radius: float, length: float) -> Manifold:
    """Return a drill along z through a part of a length, centred."""
    half = drill(radius, 0.6 * length).translate([0, 0, length / 2])
    return half + half.mirror([0, 0, 1])


def upright(solid: Manifold) -> Manifold:
    """Return a solid drawn in the xy plane so that its y points up, centred along its depth."""
    low, high = np.reshape(solid.bounding_box(), (2, 3))[:, 2]
    return solid.translate([0, 0, -(low + high) / 2]).rotate([90, 0, 0])


def filled(outline: CrossSection, radius: float) -> CrossSection:
    """Return an outline with fillets in its inner corners; the outer ones stay as they are."""
    grown = outline.offset(radius, JoinType.Miter)
    return grown.offset(-radius, circular_segments=SEGMENTS)


def treated(rng: np.random.Generator, outline: CrossSection, height: float) -> Manifold:
    """Extrude an outline; its upper edge, often the lower one, too, is chamfered or rounded."""
    edge = CHAMFER if rng.random() < 0.7 else ROUND
    return fine_slab(outline, height, edge, rng.uniform(0.7, 0.85), int(rng.integers(2)))


def fine_slab(
    outline: CrossSection, height: float, edge: np.ndarray, size: float, foot: int
) -> Manifold:
    """Extrude an outline as ``slab`` does, its curves simplified less.

    ValueError if the edge does not fit: ``slab`` would make it smaller than a grid resolves.
    """
    wide = outline.scale([FINER, FINER]).simplify(SIMPLIFIED)
    if not can_move(wide, FINER * size):
        raise ValueError(f"an edge of {size:.3g} does not fit the outline")
    drawn = slab(wide, FINER * height, edge, FINER * size, foot)
    return drawn.scale([1 / FINER] * 3)


def housing(rng: np.random.Generator) -> Manifold:
    """Draw a bearing housing: a drilled foot, and an eye on a waist with fillets."""
    eye, height, foot = rng.uniform(1.8, 2.1), rng.uniform(3, 3.8), rng.uniform(1.1, 1.4)
    half = eye + rng.uniform(2.9, 3.2)
    waist = rectangle(2 * eye, height, 0, height / 2)
    side = filled(rectangle(2 * half, foot, 0, foot / 2) + waist + disc(eye, 0, height), 0.7)
    solid = upright(side.extrude(rng.uniform(2.6, 3.4)))
    bore = upright(through(rng.uniform(0.7, eye - 1), 5)).translate([0, 0, height])
    holes = [drill(0.6, 3).translate([x, 0, foot]) for x in (1.5 - half, half - 1.5)]
    return solid - bore - joined(holes)


def block(rng: np.random.Generator) -> Manifold:
    """Draw a hydraulic block: a treated cuboid with drillings that meet inside, and a pocket."""
    size = np.array([9.0, *rng.uniform(3.8, 4.6, 2)])
    solid = treated(rng, rectangle(*size[:2]), size[2])
    solid = solid.translate([0, 0, -size[2] / 2])
    bore, wide = rng.uniform(0.6, 0.8), rng.uniform(0.9, 1.1)
    solid -= drill(bore, rng.uniform(4, 7)).rotate([0, 90, 0]).translate([4.5, 0, 0])
    mouth = drill(wide, rng.uniform(1, 3)).translate([rng.uniform(1.5, 2), 0, size[2] / 2])
    outline = smooth(rectangle(rng.uniform(2.4, 3.6), size[2] - 2.4, -1.5), 0.65, SEGMENTS)
    pocket = outline.extrude(9).rotate([-90, 0, 0])
    return solid - mouth - pocket.translate([0, 0.5 * size[1] - rng.uniform(1, 1.3), 0])


def rod(rng: np.random.Generator) -> Manifold:
    """Draw a connecting rod: two drilled eyes, a beam with fillets, one pocket."""
    large, small, deep = rng.uniform(2.1, 2.5), rng.uniform(1.6, 1.8), rng.uniform(2.2, 2.8)
    long = rng.uniform(6.4, 7.2)
    beam = CrossSection.batch_hull([disc(0.85 * large, 0.3), disc(0.85 * small, long - 0.3)])
    solid = treated(rng, filled(beam + disc(large) + disc(small, long), 1), deep)
    low, high = large + 0.2, long - small - 0.2
    hollow = smooth(rectangle(high - low, 1.4, (low + high) / 2), 0.4, SEGMENTS)
    pocket = hollow.extrude(9).translate([0, 0, deep - rng.uniform(1, 1.2)])
    bores = drill(rng.uniform(0.6, 0.7), 9).translate([long, 0, 5])
    bores += drill(rng.uniform(1, 0.55 * large), 9).translate([0, 0, 5])
    return solid - pocket - bores


def clevis(rng: np.random.Generator) -> Manifold:
    """Draw a fork end: a fork with a slot and a cross hole, on a shank drilled along."""
    wide, long = rng.uniform(3.8, 4.4), rng.uniform(4.2, 4.8)
    side = disc(wide / 2, 0, long) + rectangle(wide, long, 0, long / 2)
    solid = upright(treated(rng, side, wide))
    gap, floor = wide - rng.uniform(2.4, 2.6), rng.uniform(1.3, 1.6)
    slot = rectangle(gap, 9, 0, floor + 4.5)
    solid -= upright(slot.extrude(9)).rotate([0, 0, 90])
    solid -= upright(through(rng.uniform(0.6, 0.8), 5)).translate([0, 0, long])
    radius, reach = rng.uniform(1.5, 1.7), rng.uniform(3, 4)
    shank = fine_slab(disc(radius), reach + OVERLAP, CHAMFER, 0.5, 0).mirror([0, 0, 1])
    solid += shank.translate([0, 0, OVERLAP])
    return solid - drill(0.6, 0.7 * reach).mirror([0, 0, 1]).translate([0, 0, -reach])


def groove(rng: np.random.Generator, deep: float) -> CrossSection:
    """Draw the section of a groove below y = 0: a dovetail, a V or a rectangle."""
    half = rng.uniform(0.6, 0.7)
    match rng.integers(3):
        case 0:
            right = [[half, OVERLAP], [half, 0], [1.5 * half, -deep]]
        case 1:
            right = [[1.1 * deep, OVERLAP], [0, -1.1 * deep]]
        case _:
            right = [[1.2 * half, OVERLAP], [1.2 * half, -deep]]
    left = [[-x, y] for x, y in reversed(right) if x]
    return CrossSection([np.array(left + right)[::-1]])


def slide(rng: np.random.Generator) -> Manifold:
    """Draw a machine slide: a groove along a body with a flange and a fillet, ribs, holes."""
    wide, height = rng.uniform(4.2, 4.8), rng.uniform(2.6, 3.2)
    section = rectangle(wide, height, 0, height / 2)
    section += rectangle(wide / 2 + 2.4, 1.1, wide / 4 + 1.2, 0.55)
    body = filled(section, rng.uniform(0.65, 0.8))
    body -= groove(rng, rng.uniform(1.1, 1.3)).translate([0, height])
    solid = upright(body.extrude(9))
    corners = [[0, 0], [1.6, 0], [0, height - 1.5]]
    rib = upright(CrossSection([np.array(corners)]).extrude(rng.uniform(1, 1.2)))
    solid += rib.translate([wide / 2 - OVERLAP, 0, 1.1 - OVERLAP])
    holes = [drill(0.6, 3).translate([wide / 2 + 1.2, y, 1.1]) for y in (-2.4, 2.4)]
    return solid - joined(holes)


def enclosure(rng: np.random.Generator) -> Manifold:
    """Draw half of a case: a deep pocket with a rib, treated outside, a window and a drilling."""
    wide, height, wall = rng.uniform(4.6, 5.4), rng.uniform(2.6, 3.2), rng.uniform(1.1, 1.25)
    outline = smooth(rectangle(9, wide), rng.uniform(1.3, 1.6), SEGMENTS)
    edge = CHAMFER if rng.random() < 0.6 else ROUND
    solid = fine_slab(outline, height, edge, 0.5, 0).mirror([0, 0, 1]).translate([0, 0, height])
    inner = outline.offset(-wall, circular_segments=SEGMENTS)
    solid -= inner.extrude(9).translate([0, 0, 1.1])
    rib = rectangle(rng.uniform(1, 1.1), wide - wall, rng.uniform(0, 0.8))
    solid += rib.extrude(rng.uniform(1.5, 1.7)).translate([0, 0, 0.5])
    window = drill(rng.uniform(0.6, 0.7), 2).rotate([0, 90, 0]).translate([4.5, 0, 1.8])
    return solid - window - drill(0.6, 9).translate([-2, 0, 5])


KINDS: tuple[Kind, ...] = (housing, block, rod, clevis, slide, enclosure)


def draw_part(number: int, seed: int = 0) -> tuple[str, Mesh]:
    """Return the name and the mesh of a part, its box centred and of diagonal 1."""
    kind, rng = KINDS[number % len(KINDS)], np.random.default_rng((seed, number))
    solid = None
    while solid is None:
        with suppress(ValueError):  # an edge does not fit: other measures are drawn
            solid = unit_sized(kind(rng))
    solid = unit_sized(solid.simplify(TOLERANCE))
    return f"part-{number:02d}-{kind.__name__}", mesh_of(solid)


def main(words: Sequence[str] | None = None) -> None:
    """Write the parts."""
    parser = Parser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path, help="folder")
    parser.add_argument("--count", type=at_least(1), default=24, help="number of parts")
    parser.add_argument("--seed", type=at_least(0), default=0, help="seed of all measures")
    options = parser.parse_args(words)
    options.out.mkdir(parents=True, exist_ok=True)
    for number in range(options.count):
        name, mesh = draw_part(number, options.seed)
        write_mesh(mesh, options.out / f"{name}.ply")
    print(f"{options.count} parts in {options.out}")


if __name__ == "__main__":
    main()
