"""What ``--simplify`` leaves of the triangles, and what it costs in quality.

    python -m benchmarks.simplified MESHES --sizes 32 --meshers marching sharp --error 0.02

Samples every shape at every size, refines it 4 times with the network ``base``, meshes it, and
simplifies the mesh within the error, in voxels. F1, NC and EFv are those of ``evaluate``. A row is
printed for each shape; the last lines are means over the shapes, before and after.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from super_sdf.certificate.search import self_intersections
from super_sdf.certificate.surface import examine_surface
from super_sdf.evaluation.cases import Case, Setting, Shape
from super_sdf.evaluation.measuring import measure_surface
from super_sdf.evaluation.scope import find_meshes
from super_sdf.mesh import Mesh
from super_sdf.network.network import Network, load_network
from super_sdf.pipeline import reconstruct
from super_sdf.simplification.simplify import simplify_mesh

MEASURES = ("f1", "nc", "efv", "p2s", "slivers")


@dataclass(frozen=True)
class Row:
    """The figures of a shape before and after; None where a shape has no sharp edges.

    ``share`` is that of the triangles left, ``deviation`` the larger one of the largest distances
    both ways in voxels, ``crossing`` the pairs of triangles that intersect.
    """

    name: str
    triangles: int
    share: float
    deviation: float
    seconds: float
    sound: bool
    crossing: tuple[int, int]
    before: dict[str, float | None]
    after: dict[str, float | None]

    def cells(self) -> list[str]:
        """Return the row of the table."""
        pairs = [f"{text(self.before[k])} {text(self.after[k])}" for k in MEASURES]
        figures = [f"{self.share:.3f}", f"{self.deviation:.4f}", f"{self.seconds:.1f}"]
        crossing = "{} {}".format(*self.crossing)
        return [self.name, f"{self.triangles:,}", *figures, str(self.sound), crossing, *pairs]


def text(figure: float | None) -> str:
    """Return a figure with five digits, a dash for None."""
    return "-" if figure is None else f"{figure:.5f}"


def measure(shape: Shape, size: int, mesher: str, error: float, network: Network) -> Row:
    """Return the figures of a shape at a size."""
    case = Case(shape, Setting(size, 4))
    mesh = reconstruct(case.grid, network, 4, cap=True, mesher=mesher)
    start = time.perf_counter()
    found = simplify_mesh(mesh, error=error * case.spacing)
    seconds, off = time.perf_counter() - start, found.deviation.over(case.spacing)
    surfaces = [examine_surface(m, self_intersections(m)) for m in (mesh, found.mesh)]
    before, after = (figures_of(shape, m, case.spacing) for m in (mesh, found.mesh))
    return Row(
        shape.name, len(mesh.faces), len(found.mesh.faces) / len(mesh.faces),
        max(off.largest, off.largest_back), seconds,
        surfaces[1].closed and surfaces[1].oriented and surfaces[1].manifold,
        (surfaces[0].self_intersections or 0, surfaces[1].self_intersections or 0),
        before, after,
    )  # fmt: skip


def figures_of(shape: Shape, mesh: Mesh, spacing: float) -> dict[str, float | None]:
    """Return the figures of a mesh."""
    figures = measure_surface(shape, mesh, spacing)
    return {name: figures[name] for name in MEASURES}


def means(rows: list[Row]) -> list[str]:
    """Return the means over shapes in lines."""
    shares = np.array([row.share for row in rows])
    lines = [
        f"triangles left: {shares.mean():.3f} in the mean over shapes, {np.median(shares):.3f} "
        f"median, {shares.min():.3f} to {shares.max():.3f}; of all triangles "
        f"{sum(r.share * r.triangles for r in rows) / sum(r.triangles for r in rows):.3f}",
        f"closed, oriented, manifold: {sum(row.sound for row in rows)} of {len(rows)}",
        f"largest deviation: {max(row.deviation for row in rows):.4f} voxels",
        f"intersecting pairs: {sum(row.crossing[0] for row in rows)} before, "
        f"{sum(row.crossing[1] for row in rows)} after",
        f"seconds: {np.mean([row.seconds for row in rows]):.1f} in the mean",
    ]
    for name in MEASURES:
        pairs = [
            (row.before[name], row.after[name]) for row in rows if row.before[name] is not None
        ]
        if pairs:
            before, after = np.mean(np.array(pairs, float), axis=0)
            lines.append(f"{name}: {before:.5f} before, {after:.5f} after ({len(pairs)} shapes)")
    return lines


def main() -> None:
    """Print a table and the means for each size and mesher."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("meshes", nargs="+", type=Path, help="closed meshes, or folders of them")
    parser.add_argument("--sizes", nargs="+", type=int, default=[32])
    parser.add_argument("--meshers", nargs="+", default=["marching", "sharp"])
    parser.add_argument("--error", type=float, default=0.02, help="in voxels")
    parser.add_argument("--turned", type=int, help="seed by which the shapes are turned")
    options = parser.parse_args()
    network, paths = load_network(device="cpu"), find_meshes(options.meshes)
    for size in options.sizes:
        for mesher in options.meshers:
            print(f"{size}^3, {mesher}: shape | triangles | share | deviation | seconds | sound | "
                  f"crossing | {' | '.join(MEASURES)}")  # fmt: skip
            rows = []
            for path in paths:
                shape = Shape.read(path, options.turned)
                rows.append(measure(shape, size, mesher, options.error, network))
                print(" | ".join(rows[-1].cells()), flush=True)
            print("\n".join(means(rows)), flush=True)


if __name__ == "__main__":
    main()
