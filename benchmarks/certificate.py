"""How well the residuals of ``super-sdf check`` predict the true error of a mesh.

    python -m benchmarks.certificate MESHES --sizes 32 64

Samples every shape at every size, converts it with the network ``base``, certifies the mesh, and
measures the true distances. All lengths are in coarse voxels. The last lines are Spearman's rank
correlations:

shapes
    Over shapes: mean absolute residual against the mean distance of vertices to the reference,
    and against the mean distance both ways, which also sees what is missing.
vertices
    Over the vertices of a shape, median over shapes: absolute residual of the coloured mesh
    against distance to the reference.
found
    Median over shapes of the share of the vertices among the worst twentieth by true distance that
    are also among the worst twentieth by residual (chance: 0.05).

In brackets: the tenth and the ninetieth percentile over shapes.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from super_sdf.certificate.check import Certificate, check_files
from super_sdf.convert import ConvertOptions, convert
from super_sdf.evaluation.cases import RESULT_POINTS, Setting, Shape
from super_sdf.evaluation.metrics import compare_distances, distance_or_dot, sample_surface
from super_sdf.evaluation.scope import find_meshes
from super_sdf.evaluation.timing import grid_file
from super_sdf.network.network import Network, load_network
from super_sdf.truth.solid import Solid

WORST = 0.05
HEADER = (
    "shape", "samples", "mean residual", "p99", "largest", "mean error", "both ways", "max error",
    "vertices", "found",
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """The figures of one shape, in voxels; see the module for the last two."""

    name: str
    samples: int
    mean: float
    p99: float
    largest: float
    error: float
    both_ways: float
    max_error: float
    vertices: float
    found: float

    def cells(self) -> list[str]:
        """Return the row of the table."""
        numbers = [self.mean, self.p99, self.largest, self.error, self.both_ways, self.max_error]
        ranks = [f"{x:.2f}" for x in (self.vertices, self.found)]
        return [self.name, f"{self.samples:,}", *(f"{x:.4f}" for x in numbers), *ranks]


def certify(shape: Shape, size: int, network: Network) -> Certificate:
    """Sample a shape, convert the grid, and certify the mesh."""
    with grid_file(shape, Setting(size, 4)) as grid:
        target = grid.with_suffix(".ply")
        convert(grid, target, network, ConvertOptions(inside="negative"), force=True)
        return check_files(target, grid, ConvertOptions(inside="negative"), intersections=False)


def measure(shape: Shape, size: int, network: Network) -> Row:
    """Return the figures of a shape at a size."""
    found = certify(shape, size, network)
    mesh, touching = found.mesh, found.touching
    true = shape.solid.distance(mesh.vertices)
    said = np.abs(found.residuals_at(mesh.vertices))
    known = np.isfinite(said)
    drawn = sample_surface(mesh, shape.seed(RESULT_POINTS))
    there = distance_or_dot(Solid(mesh), shape.drawn.points)
    surfaces = compare_distances(there, distance_or_dot(shape.solid, drawn.points))
    summary = touching.summary()
    figures = [summary[name] for name in ("mean", "p99", "largest")]
    errors = [float(true.mean()), surfaces["p2s"], surfaces["max"]]
    errors = [error * size for error in errors if error is not None]
    agreement = spearmanr(said[known], true[known]).statistic, overlap(said[known], true[known])
    return Row(shape.name, len(touching.values), *figures, *errors, *map(float, agreement))


def overlap(said: np.ndarray, true: np.ndarray) -> float:
    """Return the share of the vertices worst in truth that are also the worst by residual."""
    worst = [values >= np.quantile(values, 1 - WORST) for values in (said, true)]
    return float((worst[0] & worst[1]).sum() / worst[1].sum())


def rows_of(paths: list[Path], size: int) -> Iterator[Row]:
    """Yield the figures of every shape, and print them."""
    network = load_network(device="cpu")
    for path in paths:
        row = measure(Shape.read(path), size, network)
        print(" | ".join(row.cells()), flush=True)
        yield row


def correlations(rows: list[Row]) -> list[str]:
    """Return the rank correlations in lines."""
    mean = [row.mean for row in rows]
    one = spearmanr(mean, [row.error for row in rows]).statistic
    both = spearmanr(mean, [row.both_ways for row in rows]).statistic
    largest = spearmanr([r.largest for r in rows], [r.max_error for r in rows]).statistic
    vertices = np.quantile([row.vertices for row in rows], [0.1, 0.5, 0.9])
    found = np.quantile([row.found for row in rows], [0.1, 0.5, 0.9])
    ratio = np.quantile([row.both_ways / row.mean for row in rows], [0.1, 0.5, 0.9])
    above = sum(row.max_error < row.largest for row in rows)
    return [
        f"shapes: {one:.2f} to the reference, {both:.2f} both ways; largest against largest "
        f"{largest:.2f}",
        "vertices: {:.2f} ({:.2f} to {:.2f})".format(*vertices[[1, 0, 2]]),
        "found: {:.2f} ({:.2f} to {:.2f})".format(*found[[1, 0, 2]]),
        "mean error both ways over mean residual: {:.1f} ({:.1f} to {:.1f})".format(
            *ratio[[1, 0, 2]]
        ),
        f"shapes whose largest residual is above their largest error: {above}",
    ]


def main() -> None:
    """Print a table and the correlations for each size."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("meshes", nargs="+", type=Path, help="closed meshes, or folders of them")
    parser.add_argument("--sizes", nargs="+", type=int, default=[32])
    options = parser.parse_args()
    for size in options.sizes:
        print(f"{size}^3: " + " | ".join(HEADER))
        print("\n".join(correlations(list(rows_of(find_meshes(options.meshes), size)))))


if __name__ == "__main__":
    main()
