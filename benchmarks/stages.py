"""Time and memory of each stage, from small grids to large ones.

    python -m benchmarks.stages MESH.ply --sizes 32 64 128 256 512 --out report/

Samples the mesh at each size (box diagonal 1 in the unit cube) and converts the grid in this
process, warm: the median of several runs. Two operations of the network are counted per weight and
voxel; the peak of the machine is measured in the same run, by a float32 matrix product in NumPy.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, ScalarFormatter

from super_sdf import convert, load_network, pipeline
from super_sdf.evaluation.timing import describe_machine, run_command
from super_sdf.files import spool
from super_sdf.machine.memory import forget_peak, held_memory
from super_sdf.network.network import Network
from super_sdf.slabs import preparing
from super_sdf.steps.survey import Band
from super_sdf.topology import OpenEdges

# The function of each stage, in the module where it is looked up.
STAGES = {
    "read": [(convert, "read_grid_with")],
    "band": [(preparing, "survey")],
    "gather": [(Band, "network_inputs")],
    "network": [(Network, "__call__")],
    "number": [(pipeline, "share_parts")],
    "average": [(pipeline, "average_shared")],
    "fit": [
        (pipeline, "spheres_of_band"),
        (pipeline, "fit_to_spheres"),
        (pipeline, "pin_to_skipped"),
    ],
    "bounds": [(pipeline, "keep_within_bounds")],
    "isosurface": [(pipeline, "extract_pieces")],
    "edges": [(OpenEdges, "add")],
    "write": [(spool, "write_in_chunks")],
}
AFTER = ("number", "average", "fit", "bounds", "isosurface", "edges", "write")


class Probe:
    """Measures seconds and peak memory of each stage within a ``with`` block."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self.peak = dict.fromkeys(STAGES, 0)

    def watch(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function with time and memory measured."""

        def watched(*args: Any, **options: Any) -> Any:
            forget_peak()
            start = time.perf_counter()
            result = function(*args, **options)
            self.seconds[stage] += time.perf_counter() - start
            self.peak[stage] = max(self.peak[stage], held_memory(peak=True) or 0)
            return result

        return watched

    def run(self, work: Callable[[], Any]) -> Any:
        """Run a function under the probe."""
        patches = [
            mock.patch.object(place, name, self.watch(stage, getattr(place, name)))
            for stage, places in STAGES.items()
            for place, name in places
        ]
        for patch in patches:
            patch.start()
        try:
            return work()
        finally:
            mock.patch.stopall()


def matrix_product_peak(side: int = 2048, runs: int = 10) -> float:
    """Return the operations per second of a float32 matrix product, the best of several runs."""
    a, b = np.random.default_rng(0).random((2, side, side), np.float32)
    best = np.inf
    for _ in range(runs):
        start = time.perf_counter()
        a @ b
        best = min(best, time.perf_counter() - start)
    return 2 * side**3 / best


def sample(mesh: Path, size: int, folder: Path) -> Path:
    """Sample a mesh; return an .npy file."""
    archive, grid = folder / "grid.npz", folder / f"{size}.npy"
    words = ["sample", str(mesh), str(archive), "-n", str(size), "--frame", "unit"]
    run_command([*words, "--force", "--quiet"])
    np.save(grid, np.load(archive)["values"].astype(np.float32))
    archive.unlink()
    return grid


def measure(grid: Path, network: Network, factor: int, runs: int) -> dict[str, Any]:
    """Return seconds and peak memory of the stages, and counts."""
    options = convert.ConvertOptions(factor, (1 / int(grid.stem),), (0.0,), "negative")

    def work() -> convert.Conversion:
        return convert.convert(grid, grid.with_suffix(".ply"), network, options, force=True)

    work()
    probes = [Probe() for _ in range(runs)]
    start = time.perf_counter()
    done = [probe.run(work) for probe in probes][-1]
    total = (time.perf_counter() - start) / runs
    seconds = {s: statistics.median(probe.seconds[s] for probe in probes) for s in STAGES}
    peak = {s: max(probe.peak[s] for probe in probes) for s in STAGES}
    return {"total": total, "seconds": seconds, "peak": peak, **done.counts}


def tables(rows: dict[int, dict[str, Any]], network: Network, peak: float) -> str:
    """Return the tables in Markdown."""
    head = " | ".join(f"{size}^3" for size in rows)
    lines = [f"| seconds | {head} |", "| --- |" + " ---: |" * len(rows)]
    for stage in STAGES:
        cells = (
            f"{r['seconds'][stage]:.3f} ({r['peak'][stage] / 1e6:,.0f} MB)" for r in rows.values()
        )
        lines.append(f"| {stage} | {' | '.join(cells)} |")
    for name, cell in summary(network, peak).items():
        lines.append(f"| {name} | {' | '.join(cell(row) for row in rows.values())} |")
    return "\n".join(lines)


def summary(network: Network, peak: float) -> dict[str, Callable[[dict[str, Any]], str]]:
    """Return the other rows of the table: for each, a function from a size's figures to a cell."""
    operations = 2 * network.card["parameters"]

    def rate(row: dict[str, Any]) -> float:
        return float(operations * row["band_voxels"] / row["seconds"]["network"])

    def after(row: dict[str, Any]) -> float:
        return sum(row["seconds"][stage] for stage in AFTER)

    return {
        "all": lambda row: f"{row['total']:.3f}",
        "after the network": lambda row: f"{after(row) / row['total']:.0%}",
        "band voxels": lambda row: f"{row['band_voxels']:,}",
        "triangles": lambda row: f"{row['triangles']:,}",
        "peak bytes per voxel": lambda row: (
            f"{max(row['peak'].values()) / row['band_voxels']:,.0f}"
        ),
        "network: us per voxel": lambda row: (
            f"{1e6 * row['seconds']['network'] / row['band_voxels']:.1f}"
        ),
        "network: GFLOP/s": lambda row: f"{rate(row) / 1e9:.0f}",
        "of the matrix product's": lambda row: f"{rate(row) / peak:.0%}",
    }


def draw(rows: dict[int, dict[str, Any]]) -> Figure:
    """Plot seconds and memory of the stages against the size of the grid."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    seconds, memory = figure.subplots(1, 2)
    sizes = list(rows)
    for stage in STAGES:
        seconds.plot(sizes, [rows[n]["seconds"][stage] for n in sizes], "o-", label=stage)
        memory.plot(sizes, [rows[n]["peak"][stage] / 1e6 for n in sizes], "o-", label=stage)
    slope = [rows[sizes[-1]]["total"] * (n / sizes[-1]) ** 2 for n in sizes]
    seconds.plot(sizes, slope, "k:", label="as the surface, n^2")
    seconds.set(title="seconds of each stage", ylabel="s")
    memory.set(title="peak memory of the process in each stage", ylabel="MB")
    for axes in (seconds, memory):
        axes.set(xscale="log", yscale="log", xlabel="samples along an axis")
        axes.set_xticks(sizes, [str(n) for n in sizes])
        axes.minorticks_off()
    memory.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    memory.yaxis.set_major_formatter(ScalarFormatter())
    seconds.legend(fontsize=8, ncols=2)
    return figure


def main() -> None:
    """Print the machine and the table, and draw the plot."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("mesh", type=Path)
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 64, 128, 256, 512])
    parser.add_argument("--factor", type=int, default=4)
    parser.add_argument("--model", default="base")
    parser.add_argument("--precision", default="auto")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--out", type=Path, help="folder for the plot")
    arguments = parser.parse_args()
    network = load_network(arguments.model, precision=arguments.precision)
    peak, rows = matrix_product_peak(), {}
    with tempfile.TemporaryDirectory() as name:
        for size in arguments.sizes:
            grid = sample(arguments.mesh, size, Path(name))
            rows[size] = measure(grid, network, arguments.factor, arguments.runs)
    what = f"{arguments.mesh.stem}, factor {arguments.factor}, {arguments.model}"
    print(f"{describe_machine()}; {what};")
    print(f"float32 matrix product: {peak / 1e9:.0f} GFLOP/s\n\n{tables(rows, network, peak)}")
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        draw(rows).savefig(arguments.out / "stages.png", dpi=110)


if __name__ == "__main__":
    main()
