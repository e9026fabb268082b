"""Families of smooth bodies, all of them level sets: blends, grown limbs, skins, figures.

A figure has a relief, as sculptures, scans and toys have: ridges, scales and spikes down to a
hundredth of its size. Points are (..., 3), fields of distances (n, n, n), both float32.
"""

from __future__ import annotations

import math

import numpy as np
from manifold3d import Manifold, Mesh64
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from export.shapes.draws import log_uniform

FLATNESS = 3e-4  # of the unit; how far fewer faces may depart from a level set


def marched(values: np.ndarray, low: float, step: float) -> Manifold:
    """Return the solid where ``values`` (n, n, n), on a grid from ``low``, are below 0."""
    if values.min() >= 0:
        return Manifold()
    closed = np.pad(values, 1, constant_values=step)
    vertices, faces, _, _ = marching_cubes(closed, 0.0)
    corners = (vertices.astype(np.float64) - 1) * step + low
    mesh = Mesh64(np.ascontiguousarray(corners), np.ascontiguousarray(faces, dtype=np.uint64))
    return Manifold(mesh).simplify(FLATNESS)


def grid(half: float, step: float) -> np.ndarray:
    """Return the points (n, n, n, 3) of a grid over the cube from ``-half`` to ``half``."""
    axis = np.arange(-half, half, step, dtype=np.float32)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)


def roughness(rng: np.random.Generator, points: np.ndarray, finest: float) -> np.ndarray:
    """Draw a sum of waves at points (..., 3), the finer the lower, mostly between -1 and 1."""
    count, fall = int(rng.integers(4, 25)), rng.uniform(0.3, 1.3)
    rates = np.exp(rng.uniform(math.log(3), math.log(finest), count))
    waves = rng.normal(size=(count, 3))
    waves *= (rates / np.linalg.norm(waves, axis=1))[:, None]
    heights, total = rates**-fall, np.zeros(points.shape[:-1], points.dtype)
    phases, ridged = rng.uniform(0, 2 * np.pi, count), rng.random() < 0.3
    for wave, height, phase in zip(waves, heights / np.linalg.norm(heights), phases):
        sine = np.sin(points @ wave.astype(points.dtype) + points.dtype.type(phase))
        total += points.dtype.type(height) * (1 - 2 * np.abs(sine) if ridged else sine)
    return total


def limbs(rng: np.random.Generator) -> np.ndarray:
    """Draw rods (n, 2, 4) of a creature or a plant: for each end a place and a radius."""
    rods: list[np.ndarray] = []
    starts = [np.array([0, 0, 0, log_uniform(rng, 0.03, 0.16)])]
    while starts and len(rods) < 28:
        end, way = starts.pop(0), rng.normal(size=3)
        for _ in range(rng.integers(2, 6)):
            start, way = end, way / np.linalg.norm(way) + rng.normal(0, 0.4, 3)
            step = way / np.linalg.norm(way) * start[3] * rng.uniform(1.5, 4)
            end = np.append(start[:3] + step, max(start[3] * rng.uniform(0.7, 1.1), 0.015))
            rods.append(np.stack([start, end]))
            if rng.random() < 0.8:  # a branch
                starts.append(np.append(end[:3], max(end[3] * rng.uniform(0.4, 0.8), 0.015)))
        knob = [1, 1, 1, rng.choice([1, rng.uniform(1.2, 2)])]
        rods.append(np.stack([end * knob, end * knob + [0, 0, 1e-3, 0]]))
    trunk = np.array(rods)
    return np.concatenate([trunk, trunk * [-1, 1, 1, 1]]) if rng.random() < 0.6 else trunk


def grown(rng: np.random.Generator, points: np.ndarray) -> np.ndarray:
    """Draw limbs that grow from a trunk and blend into it: about the distance at grid points."""
    rods, blend = limbs(rng), log_uniform(rng, 0.008, 0.03)
    places = rods[..., :3].reshape(-1, 3)
    rods[..., :3] -= (places.min(0) + places.max(0)) / 2
    rods *= 0.5 / (np.abs(rods[..., :3]) + rods[..., 3:]).max()
    near = np.zeros(points.shape[:3], np.float32)
    for rod in rods.astype(np.float32):
        box = near_rod(points, rod, 6 * blend)
        near[box] += np.exp(-rod_distance(points[box], rod) / np.float32(blend))
    return -blend * np.log(near + np.float32(1e-30))


def creature(rng: np.random.Generator) -> Manifold:
    """Draw limbs that grow from a trunk and blend into it, their skin smooth or rough."""
    step = 0.016
    points = grid(0.5 + 4 * step, step)
    values = grown(rng, points)
    if rng.random() < 0.5:
        values += log_uniform(rng, 0.002, 0.012) * roughness(rng, points, 50)
    return marched(values, points[0, 0, 0, 0], step)


def near_rod(points: np.ndarray, rod: np.ndarray, beyond: float) -> tuple[slice, ...]:
    """Return the box of grid points that lie no farther than ``beyond`` from a rod (2, 4)."""
    reach, axis = rod[:, 3].max() + beyond, points[:, 0, 0, 0]
    low, high = rod[:, :3].min(0) - reach, rod[:, :3].max(0) + reach
    return tuple(slice(*np.searchsorted(axis, ends)) for ends in zip(low, high))


def rod_distance(points: np.ndarray, rod: np.ndarray) -> np.ndarray:
    """Return the distance to a rod (2, 4) of two round ends, roughly where these differ much."""
    way, offset = rod[1, :3] - rod[0, :3], points - rod[0, :3]
    along = np.clip(offset @ way / (way @ way), 0, 1)
    radius = rod[0, 3] + along * (rod[1, 3] - rod[0, 3])
    return np.linalg.norm(offset - along[..., None] * way, axis=-1) - radius


def draw_distance(rng: np.random.Generator, points: np.ndarray) -> np.ndarray:
    """Draw a soft box or cylinder, a ring or an ellipsoid: its distance at points (..., 3)."""
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0] if rng.random() < 0.5 else np.eye(3)
    local = (points - rng.uniform(-0.25, 0.25, 3).astype(np.float32)) @ axes.astype(np.float32)
    half = np.exp(rng.uniform(math.log(0.05), math.log(0.32), 3)).astype(np.float32)
    soft = half.min() * np.float32(rng.uniform(0.4, 0.9))
    across = np.linalg.norm(local[..., :2], axis=-1)
    match rng.integers(4):
        case 0:
            return outside(np.abs(local) - half + soft) - soft
        case 1:
            ends = np.abs(local[..., 2]) - half[1]
            return outside(np.stack([across - half[0], ends], axis=-1) + soft) - soft
        case 2:
            return np.hypot(across - half.max(), local[..., 2]) - half.min()
    reach = np.linalg.norm(local / half, axis=-1)
    return reach * (reach - 1) / (np.linalg.norm(local / half**2, axis=-1) + np.float32(1e-6))


def outside(beyond: np.ndarray) -> np.ndarray:
    """Return the distance of what is ``beyond`` (..., k) the sides of a box or cylinder."""
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(-1), 0)


def blended(rng: np.random.Generator, points: np.ndarray, widest: float) -> np.ndarray:
    """Draw bodies blended into, or scooped out of, one another: about the distance at points.

    The seams are 0.01 to ``widest`` wide.
    """
    blend, values = np.float32(log_uniform(rng, 0.01, widest)), draw_distance(rng, points)
    for _ in range(rng.integers(1, 6)):
        other = draw_distance(rng, points)
        sign = 1 if rng.random() < 0.7 else -1
        gap = np.maximum(blend - np.abs(sign * values - other), 0)
        values = sign * (np.minimum(sign * values, other) - gap**2 / (4 * blend))
    return values


def blends(rng: np.random.Generator) -> Manifold:
    """Draw bodies that flow into, or are scooped out of, one another with rounded seams."""
    return marched(blended(rng, grid(0.75, 0.018), 0.15), -0.75, 0.018)


STEP = 0.0105  # of the grid that a figure, about one unit long, is drawn on
SKIN = 0.09  # how far from the surface of the body reliefs reach
COARSE, FINE = 8, 110  # radians a unit: the finest waves of what varies slowly, and of a skin


def sculpture(rng: np.random.Generator) -> Manifold:
    """Draw a figure with folds, scales, grooves and thorns."""
    points = grid(0.58, STEP)
    values = blended(rng, points, 0.1) if rng.random() < 0.35 else grown(rng, points)
    skin = np.abs(values) < SKIN
    for _ in range(rng.integers(2, 5)):
        depth = log_uniform(rng, 0.008, 0.04) * rng.choice([-1, 1])
        values[skin] += np.float32(depth) * relief(rng, points[skin])
    if rng.random() < 0.4:
        put_spikes(rng, points, values)
    return marched(values, points[0, 0, 0, 0], STEP)


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
        low, high = np.maximum(place - 2, 0), np.minimum(place + 3, values.shape)
        around = values[tuple(slice(*ends) for ends in zip(low, high))]
        slope = np.array([along.mean() for along in np.gradient(around)])
        way = slope / (np.linalg.norm(slope) + 1e-9) + lean
        way *= length * rng.uniform(0.5, 1.2) / (np.linalg.norm(way) + 1e-9)
        start, tip = points[tuple(place)], radius * rng.choice([0.15, 0.6])
        rod = np.array([[*start, radius], [*(start + way), tip]], np.float32)
        box = near_rod(points, rod, 0.05)
        values[box] = np.minimum(values[box], rod_distance(points[box], rod))
