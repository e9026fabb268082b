"""Fields that are no distances, or barely: random, clamped, flat, thin, one-sided."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from . import random_fields
from .case import Case, ball, batch, npy, rng_of, upsample

Field = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]


def _spotted(value: float, share: float) -> Field:
    def make(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        values = ball(shape)
        values[rng.random(shape) < share] = value
        return values

    return make


def _plane(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    normal = rng.integers(-2, 3, 3) if rng.random() < 0.7 else rng.normal(size=3)
    middle = np.array(shape)[:, None, None, None] // 2
    length = max(float(np.linalg.norm(normal)), 1e-9)
    return np.tensordot(normal, np.indices(shape) - middle, 1) / length


KINDS: dict[str, Field] = {
    **random_fields.KINDS,
    "constant": lambda rng, shape: np.full(shape, rng.choice([0.0, -0.0, 1.0, -1.0, 1e-30])),
    "positive": lambda rng, shape: np.abs(ball(shape)) + 0.1,
    "unsigned": lambda rng, shape: np.abs(ball(shape)),
    "not-below-0": lambda rng, shape: np.maximum(ball(shape), 0),
    "uneven": lambda rng, shape: np.clip(ball(shape), -rng.choice([0.1, 0.5, 1]), 1),
    "occupancy": lambda rng, shape: np.where(ball(shape) < 0, -1.0, 1.0),
    "plane": _plane,
    "thin": lambda rng, shape: np.abs(_plane(rng, shape)) - rng.choice([0.01, 0.2, 0.5]),
    "box": lambda rng, shape: (
        np.abs(np.indices(shape) - np.array(shape)[:, None, None, None] // 2).max(0) - 3.0
    ),
    "nan": _spotted(np.nan, 0.01),
    "inf": _spotted(np.inf, 0.01),
    "minus-inf": _spotted(-np.inf, 0.3),
    "minus-zeros": _spotted(-0.0, 0.3),
    "far": _spotted(1e4, 0.2),
    "one-sample": lambda rng, shape: np.where(
        np.indices(shape).sum(0) == sum(shape) // 2, -0.3, 1.0
    ),
    "cut": lambda rng, shape: ball(shape, 0.8),
    "squared": lambda rng, shape: ball(shape) * np.abs(ball(shape)),
    "gyroid": lambda rng, shape: np.sin(np.indices(shape)).sum(0) * 0.6,
    "anisotropic": lambda rng, shape: (
        np.linalg.norm((np.indices(shape).T - 5.3) * [1, 1, 3], axis=3).T - 3
    ),
}
SHAPES = [(12, 12, 12), (8, 8, 8), (5, 9, 14), (2, 2, 2), (3, 3, 3), (2, 7, 9)]
OPTIONS = [
    (),
    ("--spacing", "1", "--inside", "negative"),
    ("--spacing", "1", "--cap", "--factor", "2"),
    ("--spacing", "1", "--inside", "positive", "--cap"),
    ("--factor", "8", "--max-memory", "300M"),
    ("--offset", "0.25", "--precision", "float32", "--json"),
    ("--offset", "-0.3", "--cap", "--spacing", "1"),
]


def cases(seed: int) -> Iterator[Case]:
    """Yield the cases of this theme."""
    for kind, make in KINDS.items():
        for number, shape in enumerate(SHAPES):
            for k, options in enumerate(OPTIONS):
                if (number + k) % 2 and number:
                    continue  # half of the pairs will do; all options with the first shape
                name = f"fields/{kind}-{number}-{k}"
                values = make(rng_of(name, seed), shape)
                dtype = np.float64 if k % 2 else np.float32
                suffix = ("ply", "ply", "stl", "obj", "ply", "off", "glb")[k]
                files = {"in.npy": npy(values.astype(dtype))}
                yield upsample(name, files, *options, target=f"out.{suffix}")
        name = f"fields/{kind}"
        files = {"in.npy": npy(make(rng_of(name, seed), SHAPES[0]).astype(np.float32))}
        yield batch(f"{name}-batch", files)
        words = ("upsample", "in.npy", "out.ply", "--precision", "int8", "--spacing", "1")
        yield Case(f"{name}-int8", words, files, ("out.ply",))
