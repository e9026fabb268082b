"""Time and memory of whole processes.

    python -m lab speed MESHES --sizes 32 64 128 --shapes 10 [-- --precision int8]
    python -m lab speed MESHES --sizes 64 128 --shapes 1 --dense
    python -m lab speed MESHES --sizes 32 64 128 --shapes 1 --stages
    python -m lab speed --analytic 512 1024 --max-memory 4G 900M [-- --quality fast]

Prints for each size the mean over shapes of the median time, the slowest shape, and the highest
peak; start and files are included, and options after ``--`` are passed to the command. ``--dense``
adds SciPy's zoom and marching cubes, ``--stages`` the seconds that ``--json`` tells. An analytic
grid is a torus; the mesh must be the same file for every limit: compare its digests.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from itertools import product
from pathlib import Path

from super_sdf.errors import SuperSdfError

from . import parser_of
from .costs import ORDERS, report_of, time_command, time_dense
from .meshes import digest
from .processes import describe_machine, write_grid, write_torus
from .shapes import Shape, find_meshes, spread
from .tables import markdown


def torus_row(n: int, limit: str, folder: Path, options: list[str]) -> list[str]:
    """Convert a torus within a limit; return a row of the table."""
    grid, target = folder / f"{n}.npy", folder / f"{n}.ply"
    if not grid.exists():
        write_torus(grid, n)
    try:
        report = report_of(grid, "--spacing", str(1 / n), "--max-memory", limit, *options)
    except SuperSdfError as refusal:
        return [f"{n}^3", limit, f"refused: {refusal}", *["-"] * 6]
    peak, planned = report["peak"], report["planned_bytes"]
    counts = [str(report["slabs"]), f"{report['band_voxels']:,}", f"{report['triangles']:,}"]
    costs = [f"{report['wall']:.1f}", f"{peak / 1e6:,.0f}", f"{planned / peak - 1:+.0%}"]
    return [f"{n}^3", limit, *counts, *costs, digest(target)[:8]]


def main() -> None:
    """Print the machine and Markdown tables."""
    end = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    words, options = sys.argv[1:end], sys.argv[end + 1 :]
    parser = parser_of(__doc__)
    parser.add_argument("meshes", type=Path, nargs="*", help="files or folders")
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 64, 128])
    parser.add_argument("--shapes", type=int, default=10, help="spread over the list")
    parser.add_argument("--runs", type=int, default=5, help="of each, after one for the cache")
    parser.add_argument("--dense", action="store_true", help="also SciPy's zoom")
    parser.add_argument("--stages", action="store_true", help="also the seconds of the stages")
    parser.add_argument("--analytic", type=int, nargs="*", default=[], help="sizes of a torus")
    parser.add_argument("--max-memory", nargs="+", default=["4G"], help="limits to try")
    given = parser.parse_args(words)
    print(f"{describe_machine()}; median of {given.runs}\n", flush=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if given.analytic:
            titles = ["grid", "limit", "slabs", "band voxels", "triangles", "s", "peak MB",
                      "plan off by", "file"]  # fmt: skip
            pairs = product(given.analytic, given.max_memory)
            print(markdown(titles, (torus_row(n, limit, folder, options) for n, limit in pairs)))
        if given.meshes:
            print_speed(given, options, folder)


def print_speed(given: argparse.Namespace, options: list[str], folder: Path) -> None:
    """Print the table of shapes, and of the stages."""
    paths, rows = spread(find_meshes(given.meshes), given.shapes), []
    stages: dict[str, dict[int, float]] = {}
    for size in given.sizes:
        found: dict[str, list[dict[str, float]]] = {}
        for path in paths:
            grid = write_grid(Shape.read(path), size, folder)
            ours = " ".join(["super-sdf", *options])
            found.setdefault(ours, []).append(time_command(grid, options, given.runs))
            for name, order in ORDERS.items() if given.dense else ():
                row = time_dense(grid, order)
                found.setdefault(f"SciPy zoom, {name}", []).append(row)
            if given.stages:
                report = report_of(grid, "--inside", "negative", *options)
                for stage, seconds in report["seconds"].items():
                    mean = stages.setdefault(stage, {})
                    mean[size] = mean.get(size, 0.0) + seconds / len(paths)
        for name, measured in found.items():
            seconds, peak = [r["seconds"] for r in measured], max(r["peak_mb"] for r in measured)
            figures = [f"{statistics.mean(seconds):.3f}", f"{max(seconds):.3f}", f"{peak:.0f}"]
            rows.append([f"{size}^3, {name}", *figures])
    print(markdown(["grid", "mean s", "slowest s", "peak MB"], rows))
    if stages:
        cells = ([stage, *(f"{by[n]:.3f}" for n in given.sizes)] for stage, by in stages.items())
        print(f"\n{markdown(['seconds', *(f'{n}^3' for n in given.sizes)], cells)}")
