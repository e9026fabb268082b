"""Figures with a relief, as in sculptures, scans and toys; few of the meshes at hand are such.

A figure is a level set: limbs or blended bodies, with sheets, reliefs and spikes down to a
hundredth of its size. Points are (..., 3), fields of distances (n, n, n), both float32.
"""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold
from scipy.spatial import cKDTree

from export.shapes.draws import log_uniform
from export.shapes.organic import (
    blended,
    draw_distance,
    grid,
    grown,
    marched,
    near_rod,
    rod_distance,
    roughness,
)

STEP = 0.0105  # of the grid that a figure, about one unit long, is drawn on
SKIN = 0.09  # how far from the surface of the body reliefs reach
COARSE, FINE = 8, 110  # radians a unit: the finest waves of what varies slowly, and of a skin


def sculpture(rng: np.random.Generator) -> Manifold:
    """Draw a figure with folds, scales, grooves and thorns."""
    points = grid(0.58, STEP)
    values = blended(rng, points, 0.1) if rng.random() < 0.35 else grown(rng, points)
    for _ in range(rng.integers(0, 3)):
        values = np.minimum(values, sheet(rng, points))
    skin = np.abs(values) < SKIN
    for _ in range(rng.integers(2, 5)):
        depth = log_uniform(rng, 0.008, 0.04) * rng.choice([-1, 1])
        values[skin] += np.float32(depth) * relief(rng, points[skin])
    if rng.random() < 0.4:
        put_spikes(rng, points, values)
    return marched(values, points[0, 0, 0, 0], STEP)


def sheet(rng: np.random.Generator, points: np.ndarray) -> np.ndarray:
    """Draw a wing, an ear or a fold of cloth: a wavy thin wall that a body cuts out."""
    middle = draw_distance(rng, points) + 0.05 * roughness(rng, points, COARSE)
    wall = np.abs(middle) - np.float32(log_uniform(rng, 0.008, 0.025))
    return np.maximum(wall, draw_distance(rng, points))


def relief(rng: np.random.Generator, points: np.ndarray) -> np.ndarray:
    """Draw a relief at points, 0 to 1: soft or with steep sides, everywhere or in parts."""
    draw = (bumps, skin_waves, wrinkles, wrinkles)[rng.integers(4)]
    heights = draw(rng, points)
    if rng.random() < 0.5:
        heights = np.clip(0.5 + log_uniform(rng, 2, 8) * (heights - rng.uniform(0.3, 0.7)), 0, 1)
    if rng.random() < 0.5:
        heights = heights * np.clip(0.5 + 3 * roughness(rng, points, COARSE), 0, 1)
    return heights.astype(np.float32)


def bumps(rng: np.random.Generator, points: np.ndarray) -> np.ndarray:
    """Draw warts or scales: cones round places strewn at random."""
    places = rng.uniform(-0.6, 0.6, (int(log_uniform(rng, 60, 3000)), 3))
    return np.clip(1 - cKDTree(places).query(points)[0] / (0.6 * len(places) ** (-1 / 3)), 0, 1)


def skin_waves(rng: np.random.Generator, points: np.ndarray) -> np.ndarray:
    """Draw an uneven skin: waves of every direction."""
    return 0.5 + 0.5 * roughness(rng, points, FINE)


def wrinkles(rng: np.random.Generator, points: np.ndarray) -> np.ndarray:
    """Draw folds, strands or scales: one set of ridges along bent layers, or two that cross."""
    heights = np.ones(points.shape[:-1], np.float32)
    for _ in range(rng.integers(1, 3)):
        wave = rng.normal(size=3)
        wave *= log_uniform(rng, 15, FINE) / np.linalg.norm(wave)
        bend = np.float32(log_uniform(rng, 0.2, 4)) * roughness(rng, points, COARSE)
        sine = np.sin(points @ wave.astype(np.float32) + bend)
        heights *= np.abs(sine) if rng.random() < 0.6 else 0.5 + 0.5 * sine
    return heights


def put_spikes(rng: np.random.Generator, points: np.ndarray, values: np.ndarray) -> None:
    """Put thorns, horns or hairs, all leaning one way, on the surface of a field, in place."""
    surface = np.argwhere(np.abs(values) < 0.8 * STEP)
    if not len(surface):
        return
    length, radius = log_uniform(rng, 0.03, 0.25), log_uniform(rng, 0.006, 0.03)
    lean = rng.normal(size=3) * rng.uniform(0, 1)
    for place in surface[rng.integers(len(surface), size=int(log_uniform(rng, 2, 60)))]:
        way = unit(unit(slope_at(values, place)) + lean) * length * rng.uniform(0.5, 1.2)
        start, tip = points[tuple(place)], radius * rng.choice([0.15, 0.6])
        rod = np.array([[*start, radius], [*(start + way), tip]], np.float32)
        box = near_rod(points, rod, 0.05)
        values[box] = np.minimum(values[box], rod_distance(points[box], rod))


def slope_at(values: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return the mean gradient, per step of the grid, within two steps of a place."""
    low, high = np.maximum(place - 2, 0), np.minimum(place + 3, values.shape)
    around = values[tuple(slice(*ends) for ends in zip(low, high))]
    return np.array([along.mean() for along in np.gradient(around)])


def unit(vector: np.ndarray) -> np.ndarray:
    """Return a vector scaled to length 1; 0 stays 0."""
    return vector / (np.linalg.norm(vector) + 1e-9)
