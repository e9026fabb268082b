"""Solids in closed form, as functions of x, y and z, negative inside.

The formulas are the usual ones (https://iquilezles.org/articles/distfunctions): exact distances,
bounds of them, and smooth combinations. By default they lie in the unit cube around the origin.
"""

from __future__ import annotations

import numpy as np


def ball(x, y, z, at: float, radius: float) -> np.ndarray:
    """Return the distance to a ball on the x axis."""
    return np.sqrt((x - at) ** 2 + y**2 + z**2) - radius


def torus(x, y, z, major: float = 0.3, minor: float = 0.12) -> np.ndarray:
    """Return the distance to a torus round the z axis."""
    return np.hypot(np.hypot(x, y) - major, z) - minor


def ellipsoid(x, y, z, *axes: float) -> np.ndarray:
    """Return the usual bound of the distance to an ellipsoid."""
    one = np.sqrt(sum((u / a) ** 2 for u, a in zip((x, y, z), axes)))
    two = np.sqrt(sum((u / a**2) ** 2 for u, a in zip((x, y, z), axes)))
    return one * (one - 1) / np.maximum(two, 1e-9)


def box(x, y, z, *sides: float) -> np.ndarray:
    """Return the distance to a box of these half sides."""
    off = np.stack([np.abs(u) - side for u, side in zip((x, y, z), sides)])
    return np.sqrt((np.maximum(off, 0) ** 2).sum(0)) + np.minimum(off.max(0), 0)


def smooth_union(one: np.ndarray, other: np.ndarray, width: float) -> np.ndarray:
    """Return the polynomial smooth minimum."""
    blend = np.maximum(width - np.abs(one - other), 0) / width
    return np.minimum(one, other) - blend**2 * width / 4


def quadric(x, y, z) -> np.ndarray:
    """Return the polynomial of an ellipsoid."""
    return (x / 0.4) ** 2 + (y / 0.25) ** 2 + (z / 0.2) ** 2 - 1


def gyroid(x, y, z, turn: float = 15) -> np.ndarray:
    """Return a gyroid of ``turn`` radians a side, within a ball."""
    a, b, c = turn * x, turn * y, turn * z
    wave = np.sin(a) * np.cos(b) + np.sin(b) * np.cos(c) + np.sin(c) * np.cos(a)
    return np.maximum(wave, turn * ball(x, y, z, 0, 0.4))


def blobs(x, y, z) -> np.ndarray:
    """Return .6 less the sum of some Gaussians, as of metaballs."""
    places = ((-0.15, 0.0, 0.0), (0.15, 0.05, 0.0), (0.0, -0.15, 0.1))
    return 0.6 - sum(
        np.exp(-((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2) / 0.02) for a, b, c in places
    )
