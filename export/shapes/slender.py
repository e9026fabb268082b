"""Families of what is much thinner than long: walls, blades, struts, tubes and profiles."""

from __future__ import annotations

import math

import numpy as np
from manifold3d import CrossSection, Manifold
from scipy.interpolate import PchipInterpolator

from export.shapes.basic import PARTS
from export.shapes.draws import (
    draw_outline,
    joined,
    log_uniform,
    polyline,
    swayed,
    unit_sized,
    wound,
)


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


def pipe(rng: np.random.Generator) -> Manifold:
    """Draw a coil or a bent pipe, solid or hollow: a bar laid along a helix."""
    turns, coil, rise = log_uniform(rng, 0.15, 4), rng.uniform(0.15, 0.4), rng.uniform(0.15, 0.4)
    bar = min(coil, rise) * rng.uniform(0.15, 0.45)  # keeps neighbouring windings apart
    outline = draw_outline(rng) if rng.random() < 0.5 else CrossSection.circle(0.5, 24)
    if rng.random() < 0.4:
        outline -= outline.offset(-log_uniform(rng, 0.08, 0.3))
    straight = outline.scale([bar] * 2).extrude(1.0, math.ceil(turns * 36))
    return wound(straight, coil, rise, turns)


def cup(rng: np.random.Generator, wall: float) -> Manifold:
    """Draw a bowl, glass, dish or funnel: a line turned about the z axis, as thick as the wall."""
    count = int(rng.integers(3, 6))
    z, radii = np.linspace(0, rng.uniform(0.05, 1), count), rng.uniform(0.1, 0.5, count)
    heights = np.linspace(0, z[-1], 24)
    line = np.stack([PchipInterpolator(z, radii)(heights), heights], axis=1)
    floor = [[0, 0]] if rng.random() < 0.7 else []
    profile = polyline(np.concatenate([np.reshape(floor, (-1, 2)), line]), wall, 8)
    half = profile ^ CrossSection.square([2, 4]).translate([0, -2])
    return half.revolve(64, float(rng.choice([360, 360, rng.uniform(90, 300)])))


def rolled(rng: np.random.Generator, wall: float) -> Manifold:
    """Draw a sheet rolled to a spiral, folded to a zigzag or waved like corrugated iron."""
    turns, count = rng.uniform(0.5, 3.5), int(rng.integers(2, 9))
    t = np.linspace(0, 1, 128)
    match rng.integers(3):
        case 0:
            radius = 0.08 + (2.5 * wall * turns + rng.uniform(0.05, 0.3)) * t
            x, y = radius * np.cos(2 * np.pi * turns * t), radius * np.sin(2 * np.pi * turns * t)
        case 1:
            x, y = np.arange(count + 1) / count, rng.uniform(0.05, 0.4) * (np.arange(count + 1) % 2)
        case 2:
            x, y = t, log_uniform(rng, 0.02, 0.2) * np.sin(2 * np.pi * count / 2 * t)
    return polyline(np.stack([x, y], axis=1), wall, 8).extrude(log_uniform(rng, 0.1, 1))


def thin(rng: np.random.Generator) -> Manifold:
    """Draw what is thin all over: a sheet, flat, rolled or swayed, or a cup."""
    wall = log_uniform(rng, 0.006, 0.04)
    kinds = (cup, rolled)
    kind = rng.integers(len(kinds) + 1)
    if kind < len(kinds):
        return kinds[kind](rng, wall)
    outline = draw_outline(rng)
    for _ in range(rng.choice([0, 1, 4, 12])):
        hole = draw_outline(rng).scale([log_uniform(rng, 0.05, 0.3)] * 2)
        outline -= hole.translate(list(rng.uniform(-0.4, 0.4, 2)))
    sheet = outline.extrude(wall)
    return swayed(rng, sheet.refine_to_length(0.06), 0.9) if rng.random() < 0.5 else sheet


def section(rng: np.random.Generator) -> Manifold:
    """Draw a long profile of sheet: a hollow section, some closed at one end, or an open one.

    Its wall is a 25th to a quarter of its width, and that is a 30th to half of its length.
    """
    width = log_uniform(rng, 0.03, 0.5)
    wall = width * log_uniform(rng, 0.04, 0.25)
    if rng.random() < 0.4:
        return open_profile(rng, wall / width).scale([width] * 2).extrude(1.0)
    outline = draw_outline(rng) if rng.random() < 0.5 else CrossSection.circle(0.5, 48)
    outline = outline.scale([width, width * rng.choice([1, 1, rng.uniform(0.4, 1)])])
    hole = outline.offset(-wall).extrude(1.0)
    return outline.extrude(1.0) - hole.translate([0, 0, rng.choice([0, 0, wall])])


def open_profile(rng: np.random.Generator, wall: float) -> CrossSection:
    """Draw an L, U, C, Z or hat of strips at right angles, or half a tube, about one unit wide."""
    if rng.random() < 0.3:
        angles = np.linspace(0, np.radians(rng.uniform(90, 330)), 32)
        return polyline(0.5 * np.stack([np.cos(angles), np.sin(angles)], axis=1), wall, 8)
    headings = np.cumsum(rng.choice([90, -90], int(rng.integers(2, 6))))
    turns = np.exp(1j * np.radians(headings)) * rng.uniform(0.25, 1, len(headings))
    corners = np.cumsum(np.concatenate([[0], turns]))
    return polyline(np.stack([corners.real, corners.imag], axis=1), wall, 8)


def truss(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw nodes (n, 3) and pairs of linked nodes (m, 2): the cells of a crystal."""
    steps = np.indices(tuple(rng.integers([1, 1, 1], [5, 4, 4]) + 1)).reshape(3, -1).T
    inner = steps[(steps < steps.max(0)).all(1)] + 0.5
    match rng.integers(3):
        case 0:  # cubic: along the edges of the cells
            nodes, reach = steps.astype(float), 1.0
        case 1:  # body-centred: from the middle of each cell to its corners
            nodes, reach = np.concatenate([steps, inner]), 0.75**0.5
        case 2:  # face-centred: the diagonals of the faces
            nodes, reach = steps[steps.sum(1) % 2 == 0].astype(float), 2**0.5
    gaps = np.linalg.norm(nodes[:, None] - nodes[None], axis=2)
    links = np.argwhere(np.triu(np.abs(gaps - reach) < 0.01))
    return nodes / steps.max() * rng.uniform(0.6, 1, 3), links


def lattice(rng: np.random.Generator) -> Manifold:
    """Draw a truss of rods or square bars, their joints balls, some between two plates."""
    nodes, links = truss(rng)
    ends, many = nodes[links], len(links) > 60
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).mean()
    radius, sides = min(log_uniform(rng, 0.008, 0.06), 0.2 * length), int(rng.choice([4, 6, 12]))
    parts = [strut(start, end, radius, 4 if many else sides) for start, end in ends]
    ball = Manifold.sphere(radius * rng.choice([1, 1.05, 1.8]), 8 if many else 16)
    parts += [ball.translate(list(node)) for node in nodes[np.unique(links)]]
    if rng.random() < 0.25:
        low, size = nodes.min(0), np.ptp(nodes, axis=0)
        plate = Manifold.cube([*size[:2] + radius, radius]).translate(list(low - radius / 2))
        parts += [plate, plate.translate([0, 0, size[2]])]
    return joined(parts)


def strut(start: np.ndarray, end: np.ndarray, radius: float, sides: int) -> Manifold:
    """Return a rod from one point to another."""
    way = end - start
    length = float(np.linalg.norm(way))
    across = np.linalg.svd(way[None])[2][1:]
    axes = np.stack([*across, np.cross(*across)], axis=1)
    axes[:, 2] *= np.sign(axes[:, 2] @ way)
    axes[:, 0] *= np.linalg.det(axes)
    rod = Manifold.cylinder(length, radius, -1, sides)
    return rod.transform(np.column_stack([axes, start]))
