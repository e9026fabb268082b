"""Letters and signs: what is written on parts, or cut out of sheet, by strokes of a pen."""

from __future__ import annotations

import numpy as np
from manifold3d import CrossSection, Manifold, OpType

from export.shapes.draws import draw_outline, log_uniform, polyline

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


def letter(rng: np.random.Generator, pen: float, segments: int) -> CrossSection:
    """Draw a letter of one stroke to three."""
    strokes = [stroke(rng, pen, segments) for _ in range(rng.integers(1, 4))]
    return CrossSection.batch_boolean(strokes, OpType.Add)


def writing(rng: np.random.Generator) -> CrossSection:
    """Draw lines of letters, slanted or upright, round the origin and about one unit wide."""
    pen, segments = log_uniform(rng, 0.05, 0.25), int(rng.choice([4, 16]))
    shape, slant = (rng.choice([1, 1, 2, 3]), rng.integers(1, 8)), rng.choice([0, 0, 0.25])
    letters = [
        letter(rng, pen, segments).translate([(0.62 + pen) * column, (1.15 + pen) * row])
        for row, column in np.ndindex(shape)
    ]
    page = CrossSection.batch_boolean(letters, OpType.Add).transform([[1, slant, 0], [0, 1, 0]])
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
