"""Random fields of 2 to 16 samples a side, and whether their meshes are closed manifolds.

    python -m lab fields --count 10000

A fault is an open edge, a vertex of two surfaces, two vertices at one place, two triangles with the
same corners, or a vertex outside the grid.
"""

from __future__ import annotations

import sys
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from super_sdf import Mesh, SdfGrid, load_network, reconstruct
from super_sdf.surface.marching import CAP_HEIGHT

from . import parser_of

MOST_SAMPLES = 300


@dataclass(frozen=True)
class RandomField:
    """A field, and how its surface is asked for."""

    name: str
    values: np.ndarray
    factor: int
    cap: bool


def make_fields(count: int, seed: int = 0) -> Iterator[RandomField]:
    """Yield so many fields; the same for the same seed."""
    for number in range(count):
        rng = np.random.default_rng([seed, zlib.crc32(f"field-{number}".encode())])
        shape = rng.integers(2, 17, 3)
        while shape.prod() > MOST_SAMPLES:
            shape[shape.argmax()] = rng.integers(2, shape.max())
        shape = tuple(map(int, rng.permutation(shape)))
        kind = list(KINDS)[number % len(KINDS)]
        values = KINDS[kind](rng, shape).astype(np.float32)
        values.flat[0], values.flat[-1] = 1, -1  # both sides, whatever the rest
        factor, cap = (2, 4)[number // 2 % 2], bool(number % 2)
        name = f"{number}: {kind} {shape}, factor {factor}{', cap' * cap}"
        yield RandomField(name, values, factor, cap)


def ball(shape: tuple[int, ...], radius: float = 0.3) -> np.ndarray:
    """Return the distances to a ball, its radius as a share of the shortest axis."""
    middle = np.array(shape)[:, None, None, None] / 2 - 0.63
    return np.linalg.norm(np.indices(shape) - middle, axis=0) - radius * min(shape)


def facets(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Return a field of planes that meet in edges and corners, convex and concave.

    Inside it is the largest or the smallest of distances to planes: their slope is 1.
    """
    normals = rng.normal(size=(2, 3, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    middle = (np.array(shape) - 1) / 2 + rng.normal(size=3)
    along = normals @ (np.indices(shape).reshape(3, -1) - middle[:, None])
    first, second = (along - rng.uniform(0, 0.3 * max(shape), (2, 3, 1))).max(1)
    return (np.minimum(first, second) if rng.random() < 0.5 else first).reshape(shape)


KINDS = {
    "normal": lambda rng, shape: rng.normal(size=shape),
    "large": lambda rng, shape: rng.normal(size=shape) * 10,
    "clamped": lambda rng, shape: np.clip(rng.normal(size=shape), -0.4, 0.4),
    "half-integer": lambda rng, shape: rng.integers(-3, 4, shape) / 2,
    "exact zeros": lambda rng, shape: rng.normal(size=shape) * (rng.random(shape) < 0.5),
    "mostly zeros": lambda rng, shape: rng.choice([-1, 0, 0, 0, 0, 1], shape),
    "signs": lambda rng, shape: rng.choice([-1.0, 1.0], shape),
    "clamped ball": lambda rng, shape: np.clip(ball(shape, rng.uniform(0.2, 0.6)), -0.5, 0.5),
    "rounded ball": lambda rng, shape: np.round(ball(shape, rng.uniform(0.2, 0.6)) * 2) / 2,
    "noisy ball": lambda rng, shape: ball(shape) + rng.uniform(-0.5, 0.5, shape),
    "facets": lambda rng, shape: facets(rng, shape),
    "clamped facets": lambda rng, shape: np.clip(facets(rng, shape), -0.5, 0.5),
    "rounded facets": lambda rng, shape: np.round(facets(rng, shape) * 2) / 2,
    "denormal": lambda rng, shape: rng.normal(size=shape) * rng.choice([1, 1e-44], shape),
}


def faults_of_mesh(field: RandomField, mesh: Mesh) -> list[str]:
    """Return what is wrong with a mesh: holes, edges or vertices of two surfaces, no numbers."""
    faults = []
    if not np.isfinite(mesh.vertices).all():
        faults.append("vertices are not finite")
    if len(np.unique(mesh.vertices, axis=0)) < len(mesh.vertices):
        faults.append("vertices at the same position")
    if len(np.unique(np.sort(mesh.faces, axis=1), axis=0)) < len(mesh.faces):
        faults.append("triangles with the same corners")
    beyond = np.maximum(-0.5 - mesh.vertices, mesh.vertices - np.array(field.values.shape) + 0.5)
    if beyond.max() > CAP_HEIGHT / field.factor + 1e-4:
        faults.append(f"vertices are {beyond.max():.3f} samples outside the grid")
    inner, border = open_edges(mesh, field.values.shape)
    if inner or (field.cap and border):
        faults.append(f"{inner} open edges within the grid, {border} at its border")
    elif not border and (mesh.count_fans(mesh.pair_edges()[0])[np.unique(mesh.faces)] != 1).any():
        faults.append("surfaces share a vertex")
    return [f"{field.name}: {fault}" for fault in faults]


def open_edges(mesh: Mesh, shape: tuple[int, ...]) -> tuple[int, int]:
    """Count edges without a partner: within the grid's box, and in its faces.

    The fine lattice ends half a voxel beyond the outer samples; there a surface may run out.
    """
    ends = mesh.vertices[mesh.boundary()]
    in_face = (np.abs(ends + 0.5) < 1e-3) | (np.abs(ends - np.array(shape) + 0.5) < 1e-3)
    at_border = in_face.all(1).any(1)
    return int((~at_border).sum()), int(at_border.sum())


def main() -> int:
    """Mesh the fields by both meshers; print the faults, exit code 1 if there are any."""
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    words = parser.parse_args()
    network, faults = load_network("fast", threads=1), list[str]()
    for field in make_fields(words.count, words.seed):
        grid = SdfGrid.trusted(field.values, 1.0)  # they are no distances, and need not be
        for mesher in ("marching", "sharp"):
            mesh = reconstruct(grid, network, field.factor, cap=field.cap, mesher=mesher)
            found = faults_of_mesh(field, mesh)
            faults += [f"{mesher}, {fault}" for fault in found]
    print("\n".join(faults), file=sys.stderr)
    print(f"{words.count} fields, {len(faults)} faults")
    return int(bool(faults))
