"""Families of parts whose edges are treated: rounded and filleted, or chamfered.

The edges of a slab run along its outline, so they are made from copies of that outline, each moved
in or out by a step: a quarter circle of steps is a round edge, a single one a chamfer.
"""

from __future__ import annotations

import numpy as np
from manifold3d import CrossSection, Manifold
from scipy.spatial import cKDTree

from export.shapes.draws import bars, draw_outline, log_uniform, sharp_outline

QUARTER = np.linspace(0, np.pi / 2, 7)
ROUND = np.stack([1 - np.cos(QUARTER), np.sin(QUARTER)], axis=1)  # inset and rise, from the wall on
SIMPLIFIED = 3e-4  # by which the outline of a slab is simplified
CHAMFER = np.array([[0.0, 0.0], [1.0, 1.0]])


def miters(ring: np.ndarray) -> np.ndarray:
    """Return for each corner (n, 2) of a ring the shift that moves both its sides out by 1."""
    sides = np.roll(ring, -1, axis=0) - ring
    normals = np.stack([sides[:, 1], -sides[:, 0]], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    before = np.roll(normals, 1, axis=0)
    return (before + normals) / np.maximum(1 + (before * normals).sum(1, keepdims=True), 0.1)


def area(ring: np.ndarray) -> float:
    after = np.roll(ring, -1, axis=0)
    return float((ring[:, 0] * after[:, 1] - ring[:, 1] * after[:, 0]).sum() / 2)


def can_move(outline: CrossSection, inset: float) -> bool:
    """Say whether the sides of an outline can move in that far: none turns, no two rings meet."""
    rings = outline.to_polygons()
    moved = [ring - inset * miters(ring) for ring in rings]
    for old, new in zip(rings, moved):
        sides, now = (np.roll(ring, -1, axis=0) - ring for ring in (old, new))
        if ((sides * now).sum(1) <= 0.02 * (sides**2).sum(1)).any():
            return False
    return abs(CrossSection(moved).area() - sum(map(area, moved))) < 1e-6


def lofted(outline: CrossSection, levels: np.ndarray) -> Manifold:
    """Join copies of an outline at ``levels`` (n, 2): how far each is moved in, and its height."""
    rings = outline.to_polygons()
    corners, shifts = cKDTree(np.concatenate(rings)), np.concatenate([miters(r) for r in rings])

    def move(points: np.ndarray) -> np.ndarray:
        inset, height = levels[np.rint(points[:, 2]).astype(int)].T
        shift = shifts[corners.query(points[:, :2])[1]]
        return np.column_stack([points[:, :2] - inset[:, None] * shift, height])

    return outline.extrude(len(levels) - 1, len(levels) - 2).warp_batch(move)


def slab(
    outline: CrossSection, height: float, edge: np.ndarray, size: float, foot: int, steep: float = 1
) -> Manifold:
    """Extrude an outline, its upper edge treated, by ``size`` or less where that is too much.

    Its lower edge is treated alike with a ``foot`` of 1, sharp with 0, and with -1 flared, as where
    a boss stands on a plate: then it reaches a little below 0.
    """
    if outline.is_empty():
        return Manifold()
    outline, size = outline.simplify(SIMPLIFIED), min(size, 0.45 * height / steep)
    while size > 1e-3 and not (can_move(outline, size) and can_move(outline, min(foot, 0) * size)):
        size *= 0.7
    if size <= 1e-3:
        return outline.extrude(height)
    scale, sunk = [size, size * steep], np.array([[-size, -0.01]])[: foot < 0]
    lower = (edge[::-1] * [foot, -1] + [0, 1]) * scale
    upper = (edge - [0, 1]) * scale + [0, height]
    return lofted(outline, np.concatenate([sunk, lower, upper]))


def smooth(outline: CrossSection, radius: float, segments: int = 48) -> CrossSection:
    """Round the outer and the inner corners of an outline, where there is room for it."""
    opened = outline.offset(-radius).offset(radius, circular_segments=segments)
    opened = outline if opened.is_empty() else opened
    return opened.offset(radius).offset(-radius, circular_segments=segments)


def pierced(rng: np.random.Generator, outline: CrossSection) -> CrossSection:
    for _ in range(rng.choice([0, 1, 2, 4])):
        hole = draw_outline(rng).scale([log_uniform(rng, 0.1, 0.4)] * 2)
        outline -= hole.translate(list(rng.uniform(-0.3, 0.3, 2)))
    return outline


def studded(rng: np.random.Generator, edge: np.ndarray, size: float) -> Manifold:
    """Draw a plate with bosses and pockets, all their edges treated, the inner ones too."""
    outline, height = smooth(draw_outline(rng), size), log_uniform(rng, 0.06, 0.3)
    solid = slab(outline, height, edge, min(size, 0.3 * height), 1)
    for _ in range(rng.integers(1, 6)):
        foot = smooth(draw_outline(rng).scale([log_uniform(rng, 0.1, 0.4)] * 2), size / 2)
        inside = foot.translate(list(rng.uniform(-0.35, 0.35, 2))) ^ outline.offset(-2 * size)
        foot = inside.offset(-size / 2).offset(size / 2)  # no slivers where the rim cuts it
        if rng.random() < 0.5:
            boss = slab(foot, log_uniform(rng, 0.03, 0.5), edge, size, -1)
            solid += boss.translate([0, 0, height])
        else:
            boss = slab(foot, height * rng.choice([0.3, 0.6, 2]), edge, size, -1)
            solid -= boss.mirror([0, 0, 1]).translate([0, 0, height])
    return solid


def crossed(rng: np.random.Generator, radius: float, segments: int) -> Manifold:
    """Draw a bracket: the common part of two extrusions at a right angle, their corners treated."""
    sides = [smooth(bars(rng).offset(0.02), radius, segments).extrude(2) for _ in range(2)]
    first, second = (side.translate([0, 0, -1]) for side in sides)
    return first ^ second.rotate([90, 0, 0])


def filleted(rng: np.random.Generator) -> Manifold:
    """Draw a part whose edges are round, outside and inside: slab, plate, bracket."""
    radius = log_uniform(rng, 0.012, 0.25)
    match rng.integers(4):
        case 0 | 1:
            outline = smooth(pierced(rng, sharp_outline(rng)), radius)
            return slab(outline, log_uniform(rng, 0.05, 1), ROUND, radius, int(rng.integers(2)))
        case 2:
            return studded(rng, ROUND, min(radius, 0.06))
    return crossed(rng, radius, 48)


def cut_block(rng: np.random.Generator) -> Manifold:
    """Draw a box, half of its edges and some of its corners cut off by planes."""
    half, share = rng.uniform(0.15, 0.5, 3), log_uniform(rng, 0.03, 0.5)
    solid = Manifold.cube(list(2 * half), True)
    signs = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
    for sign in signs[np.abs(signs).sum(1) >= 2]:
        if rng.random() < (0.5 if (sign == 0).any() else 0.2):
            normal = sign * rng.choice([1, rng.uniform(0.4, 1)], 3)
            reach = np.abs(normal) @ half - share * half.min()
            solid = solid.trim_by_plane(list(-normal), -reach / np.linalg.norm(normal))
    return solid


def chamfered(rng: np.random.Generator) -> Manifold:
    """Draw a part whose edges are cut off: slab, block, plate or bracket."""
    size = log_uniform(rng, 0.012, 0.2)
    match rng.integers(4):
        case 0:
            outline, steep = pierced(rng, draw_outline(rng)), rng.choice([0.5, 1, 1, 2])
            height = log_uniform(rng, 0.05, 1)
            return slab(outline, height, CHAMFER, size, int(rng.integers(2)), steep)
        case 1:
            return cut_block(rng)
        case 2:
            return studded(rng, CHAMFER, min(size, 0.06))
    return crossed(rng, size, 4)
