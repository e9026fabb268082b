"""Errors of sampled grids, and time and memory of a large one.

    python -m benchmarks.sampling MESH --size 512

Samples a box, and a sphere and a torus with enough triangles that they deviate from the surface by
less than 1e-6, and prints the largest difference from the closed form over all samples. Then runs
``super-sdf sample MESH -n SIZE`` and prints its time and peak of memory.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from super_sdf import Mesh
from super_sdf.evaluation.timing import describe_machine, run_command
from super_sdf.truth.mesh_files import read_mesh
from super_sdf.truth.sampling import grid_points, sample_grid, unit_layout
from super_sdf.truth.solid import Solid

RADIUS = 0.4  # of the sphere
RING, TUBE = 0.27, 0.18  # radii of the torus
HALF = np.array([0.37, 0.29, 0.23])  # of the box
STRAY = 0.8e-6
SIZE = 64


def wrapped(points: np.ndarray) -> Mesh:
    """Return the mesh of points (u, v, 3) on a surface that is periodic along u and v."""
    corner = np.arange(points.shape[0] * points.shape[1]).reshape(points.shape[:2])
    right, up = np.roll(corner, -1, 0), np.roll(corner, -1, 1)
    faces = np.stack([corner, right, np.roll(right, -1, 1), corner, np.roll(right, -1, 1), up], -1)
    return Mesh(points.reshape(-1, 3), faces.reshape(-1, 3).astype(np.int32))


def steps_for(radius: float) -> int:
    """Return the number of chords of a circle that deviate by half of the tolerance."""
    return int(np.ceil(np.pi / np.arccos(1 - STRAY / 2 / radius)))


def torus() -> Mesh:
    """Return a torus around the z axis."""
    u = np.linspace(0, 2 * np.pi, steps_for(RING + TUBE), endpoint=False)[:, None]
    v = np.linspace(0, 2 * np.pi, steps_for(TUBE), endpoint=False)[None]
    ring = RING + TUBE * np.cos(v)
    return wrapped(np.stack([ring * np.cos(u), ring * np.sin(u), TUBE * np.sin(v) + 0 * u], -1))


def sphere() -> Mesh:
    """Return a sphere, its vertices as far outside as its faces are inside."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=9, radius=RADIUS + STRAY / 4)
    return Mesh(np.array(ball.vertices), np.array(ball.faces, np.int32))


def box() -> Mesh:
    """Return a box around the origin."""
    import trimesh

    made = trimesh.creation.box(extents=2 * HALF)
    return Mesh(np.array(made.vertices), np.array(made.faces, np.int32))


def sphere_distance(points: np.ndarray) -> np.ndarray:
    """Return the closed form."""
    return np.linalg.norm(points, axis=1) - RADIUS


def torus_distance(points: np.ndarray) -> np.ndarray:
    """Return the closed form."""
    return np.hypot(np.linalg.norm(points[:, :2], axis=1) - RING, points[:, 2]) - TUBE


def box_distance(points: np.ndarray) -> np.ndarray:
    """Return the closed form."""
    beyond = np.abs(points) - HALF
    return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(1), 0)


SOLIDS: dict[str, tuple[Callable[[], Mesh], Callable[[np.ndarray], np.ndarray]]] = {
    "box": (box, box_distance),
    "sphere": (sphere, sphere_distance),
    "torus": (torus, torus_distance),
}


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("mesh", type=Path)
    parser.add_argument("--size", type=int, default=512)
    arguments = parser.parse_args()
    print(f"{describe_machine()}\n\n| solid | triangles | largest error, {SIZE}^3 samples |")
    print("| --- | ---: | ---: |")
    layout = unit_layout(SIZE)
    for name, (make, closed_form) in SOLIDS.items():
        mesh = make()
        error = sample_grid(Solid(mesh), layout).ravel() - closed_form(grid_points(layout))
        print(f"| {name} | {len(mesh.faces):,} | {np.abs(error).max():.1e} |", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        words = [
            "sample",
            str(arguments.mesh),
            f"{folder}/grid.npz",
            "-n",
            str(arguments.size),
            "--quiet",
        ]
        seconds, peak = run_command(words)
    faces, size = len(read_mesh(arguments.mesh).faces), f"{arguments.size}^3"
    print(f"\n{arguments.mesh.stem}, {faces:,} faces, {size}: {seconds:.1f} s, {peak:.0f} MB")


if __name__ == "__main__":
    main()
