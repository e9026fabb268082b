"""Grids that are coarser along one axis: what resampling costs, on shapes whose truth is known.

    python -m benchmarks.anisotropic FOLDER
    python -m benchmarks.anisotropic FOLDER --count 10 -n 32 --ratios 1.5 5 --methods ours coarse

FOLDER holds meshes. Each is scaled to a box diagonal of 1 and sampled exactly with n samples along
one axis and more along the others, each axis being the coarse one in turn. "isotropic" is the grid
with n samples along all axes; the others start from the anisotropic grid:

    ours      the grid as it is
    linear    resampled to the finest spacing before, linearly
    spline    resampled to the finest spacing before, with SciPy's cubic spline
    coarse    resampled to the coarsest spacing before, with SciPy's cubic spline

The error is the mean of the distances from mesh to truth and back, in spacings of the coarse axis.
"ratio" compares it with that of the isotropic grid, shape by shape. The last line says how far
off the spacing is that ``make_grid`` estimates if it is not given. ``--methods`` without a name
measures that alone. Needs the extra eval.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from super_sdf import SdfGrid, load_network, make_grid, reconstruct
from super_sdf.evaluation.metrics import F1_DISTANCE, distance_or_dot, normalise, sample_surface
from super_sdf.truth.mesh_files import read_mesh
from super_sdf.truth.solid import Solid

POINTS = 50_000  # sampled on each surface
CHUNK = 1 << 18  # samples at a time
ORDER = {"linear": 1, "spline": 3, "coarse": 3}


def sample(solid: Solid, shape: tuple[int, ...]) -> SdfGrid:
    """Sample a cube of side 1 at the centres of its voxels, which need not be cubes."""
    spacing = 1 / np.array(shape)
    points = (np.indices(shape).reshape(3, -1).T + 0.5) * spacing - 0.5
    chunks = [points[start : start + CHUNK] for start in range(0, len(points), CHUNK)]
    values = np.concatenate([solid.signed_distance(chunk) for chunk in chunks])
    values = values.reshape(shape).astype(np.float32)
    return SdfGrid.trusted(values, spacing, spacing / 2 - 0.5)


def resampled(grid: SdfGrid, h: float, order: int) -> SdfGrid:
    """Return a grid resampled to one spacing with SciPy, as one would by hand."""
    step = h / np.array(grid.spacing)
    shape = np.rint((np.array(grid.shape) - 1) / step).astype(int) + 1
    values = ndimage.affine_transform(
        grid.values, step, output_shape=tuple(shape), order=order, mode="nearest"
    )
    return SdfGrid.trusted(values, h, grid.origin)


def prepared(grid: SdfGrid, method: str) -> SdfGrid:
    """Return the grid that a method gives to ``reconstruct``."""
    if method == "ours":
        return grid
    h = max(grid.spacing) if method == "coarse" else min(grid.spacing)
    return resampled(grid, h, ORDER[method])


def estimate_error(grid: SdfGrid) -> float:
    """Return the largest error of the estimated spacing, over that of its axis."""
    estimated = make_grid(grid.values).spacing
    return float(np.abs(np.array(estimated) / grid.spacing - 1).max())


def error(mesh: Any, solid: Solid, points: NDArray[np.float64]) -> tuple[float, float]:
    """Return the mean distance between a mesh and the truth, and F1."""
    there = distance_or_dot(Solid(mesh), points)
    back = distance_or_dot(solid, sample_surface(mesh, (0, 1), POINTS).points)
    shares = [np.mean(far < F1_DISTANCE) for far in (there, back)]
    return float(there.mean() + back.mean()) / 2, 2 / sum(1 / max(s, 1e-9) for s in shares)


def main() -> None:
    """Measure all shapes and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--names", nargs="*", help="shapes, by file name without suffix")
    parser.add_argument("--count", type=int, default=10, help="shapes, spread evenly over all")
    parser.add_argument("-n", type=int, default=32, help="samples along the coarse axis")
    parser.add_argument("--ratios", type=float, nargs="*", default=[1.5, 5.0])
    parser.add_argument("--methods", nargs="*", default=["ours", *ORDER])
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args()
    paths = sorted(options.folder.glob("*.ply"))
    paths = [path for path in paths if not options.names or path.stem in options.names]
    chosen = np.unique(np.linspace(0, len(paths) - 1, options.count).astype(int))
    network, n = load_network(threads=options.threads), options.n
    found: dict[tuple[float, str], list[tuple[float, float, float]]] = defaultdict(list)
    estimates: list[float] = []
    for path in (paths[i] for i in chosen):
        solid = Solid(normalise(read_mesh(path)))
        points = sample_surface(solid.mesh, (0, 0), POINTS).points
        base = 1.0, 1.0
        if options.methods:
            base = error(reconstruct(sample(solid, (n, n, n)), network), solid, points)
        for ratio in options.ratios:
            found[ratio, "isotropic"].append((*base, 1.0))
            for axis in range(3):
                shape = tuple(n if axis == other else round(n * ratio) for other in range(3))
                grid = sample(solid, shape)
                estimates.append(estimate_error(grid))
                for method in options.methods:
                    mesh = reconstruct(prepared(grid, method), network)
                    mean, f1 = error(mesh, solid, points)
                    found[ratio, method].append((mean, f1, mean / base[0]))
            print(path.stem, ratio, *(f"{m} {found[ratio, m][-1][2]:.2f}" for m in options.methods))
    print(f"\n| {len(chosen)} shapes, {n} samples | error | F1 | ratio, worst |")
    print("| --- | ---: | ---: | ---: |")
    for (ratio, method), rows in found.items():
        mean, f1, _ = np.mean(rows, axis=0)
        worst = max(row[2] for row in rows)
        print(f"| 1:1:{ratio:g}, {method} | {mean * n:.4f} | {f1:.3f} | {worst:.2f} |")
    print(f"\nspacing estimated within {max(estimates):.1%} on {len(estimates)} grids")


if __name__ == "__main__":
    main()
