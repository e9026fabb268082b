"""What CAD parts are made with: drills, counterbores, fillets."""

from __future__ import annotations

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold

SEGMENTS = 192  # of a circle: facets meet at 2 degrees, which tells little from a smooth surface
OVERLAP = 0.01  # a tool starts that far outside the part


def disc(radius: float, x: float = 0.0, y: float = 0.0) -> CrossSection:
    """Return a disc round a point."""
    return CrossSection.circle(radius, SEGMENTS).translate([x, y])


def drill(radius: float, depth: float, sink: float = 0.0) -> Manifold:
    """Return a drill that enters at the origin, downward; its mouth is widened by ``sink``."""
    tool = Manifold.cylinder(depth + OVERLAP, radius, -1, SEGMENTS).translate([0, 0, -depth])
    if not sink:
        return tool
    wide = radius + sink + OVERLAP
    cone = Manifold.cylinder(sink + OVERLAP, radius, wide, SEGMENTS)
    return tool + cone.translate([0, 0, -sink])


def counterbore(radius: float, depth: float) -> Manifold:
    """Return a drill with a flat recess for a screw head, twice as wide."""
    return drill(radius, depth) + drill(2 * radius, 1.5 * radius)


def through(radius: float, length: float, sink: float) -> Manifold:
    """Return a drill along z through a part of a length, centred; both mouths are countersunk."""
    half = drill(radius, 0.6 * length, sink).translate([0, 0, length / 2])
    return half + half.mirror([0, 0, 1])


def upright(solid: Manifold) -> Manifold:
    """Return a solid drawn in the xy plane so that its y points up, centred along its depth."""
    low, high = np.reshape(solid.bounding_box(), (2, 3))[:, 2]
    return solid.translate([0, 0, -(low + high) / 2]).rotate([90, 0, 0])


def filled(outline: CrossSection, radius: float) -> CrossSection:
    """Return an outline with fillets in its inner corners; the outer ones stay as they are."""
    grown = outline.offset(radius, JoinType.Miter)
    return grown.offset(-radius, circular_segments=SEGMENTS)
