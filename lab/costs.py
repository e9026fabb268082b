"""What a conversion costs: whole processes, start and files included, one after the other."""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import nnls

from super_sdf import Mesh, write_mesh
from super_sdf.convert import convert
from super_sdf.options import Options
from super_sdf.errors import SuperSdfError
from super_sdf.threads import forget_peak, held_memory
from super_sdf.network.decoder import Decoder

from .measuring import network_of
from .processes import median_of, run_python, timed, upsample_words, write_grid, write_torus
from .rows import Row
from .shapes import Shape, spread

if TYPE_CHECKING:
    from .figures import Bench

TIMED = 4  # shapes
LARGE, LIMITS = 512, ("4G", "1500M", "900M")
OPTIONS: dict[str, tuple[str, ...]] = {
    "default": (),
    "fast": ("--quality", "fast"),
    "best": ("--quality", "best"),
    "float32": ("--precision", "float32"),
    "marching": ("--mesher", "marching"),
}
ORDERS = {"scipy": 3, "trilinear": 1}  # of SciPy's zoom
MODELS = ("fast", "noisy", "mask", "base")
MEMORY_FIELDS = ("ball", "gyroid", "wall")
FACTORS = {2: 1, 4: 1, 8: 2, 16: 4}  # and by how much the grids are smaller


def time_command(grid: Path, options: Sequence[str], runs: int) -> Row:
    """Return seconds and peak of the command on a grid that is negative inside."""
    return timed(upsample_words(grid, "--inside", "negative", *options), runs)


def time_warm(grid: Path, network: Decoder, runs: int) -> Row:
    """Return the same from file to file in this process, which has loaded the network."""

    def once() -> tuple[float, float]:
        forget_peak()
        start = time.perf_counter()
        options = Options(inside="negative")
        convert(grid, grid.with_suffix(".ply"), network, options, force=True)
        return time.perf_counter() - start, (held_memory(peak=True) or 0) / 1e6

    return median_of(once, runs)


def time_dense(grid: Path, order: int) -> Row:
    """Return the same of SciPy's zoom to the same fine nodes and scikit-image's marching cubes."""
    return timed(["-m", "lab.costs", str(grid), str(grid.with_suffix(".ply")), str(order)], runs=1)


def convert_densely(source: str, target: str, order: str, factor: int = 4) -> None:
    """Refine a grid with SciPy and mesh it with scikit-image, as a short script would."""
    from scipy.ndimage import zoom
    from skimage.measure import marching_cubes

    values = np.load(source)["values"]
    scale = [(factor * n + 1) / n for n in values.shape]
    fine = zoom(values, scale, order=int(order), mode="nearest", grid_mode=True)
    vertices, faces, _, _ = marching_cubes(fine, 0.0)
    write_mesh(Mesh(vertices, faces.astype(np.int32)), target, force=True)


def report_of(grid: Path, *options: str) -> Row:
    """Convert a grid in a process; return what ``--json`` says, and its seconds and peak."""
    taken = run_python(upsample_words(grid, "--json", *options))
    report: Row = json.loads(taken.printed)
    return {**report, "wall": taken.seconds, "peak": taken.peak}


def speed_rows(bench: Bench) -> list[Row]:
    """Measure whole processes, also beside dense upsampling, a large grid, and the stages."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for size in bench.sizes:
            rows += sized_rows(bench, size, Path(folder))
        rows += large_rows(bench, Path(folder))
    return rows


def sized_rows(bench: Bench, size: int, folder: Path) -> list[Row]:
    """Return the rows of a size."""
    found: dict[str, list[Row]] = {}
    paths = spread(bench.shapes, TIMED)
    for path in paths:
        grid = write_grid(Shape.read(path), size, folder)
        words = {"time": path.stem, "size": size, "runs": bench.runs}
        plans: dict[str, Callable[[], Row]] = {
            name: partial(time_command, grid, [*options, *model_of(bench, name)], bench.runs)
            for name, options in OPTIONS.items()
        }
        network = network_of(bench.network, "auto", 0)
        plans["warm"] = partial(time_warm, grid, network, bench.runs)
        if path == paths[0] and size > bench.small:
            plans |= {name: partial(time_dense, grid, order) for name, order in ORDERS.items()}
        for name, measure in plans.items():
            found.setdefault(name, []).append(bench.timed({**words, "option": name}, measure))
        if path == paths[0]:
            for name, precision in product(MODELS, ("int8", "float32")):
                key = {"network": name, "precision": precision}
                measure = partial(network_row, grid, name, precision, bench)
                row = bench.timed({**words, **key}, measure)
                found[f"network {name} {precision}"] = [row]
    own = found["default"][0]
    return [
        {"size": size, "option": name, **cost_of(name, rows, own)} for name, rows in found.items()
    ]


def model_of(bench: Bench, option: str) -> list[str]:
    """Return the options that choose another network in place of base."""
    return ["--model", bench.network] if bench.network != "base" and option != "fast" else []


def cost_of(option: str, rows: Sequence[Row], own: Row) -> Row:
    """Return the figures of an option over shapes; ``own`` is ours on the first one."""
    if option.startswith("network"):
        return {key: rows[0][key] for key in ("us_per_voxel", "stages", "band_voxels")}
    peak = max(row["peak_mb"] for row in rows)
    if option in ORDERS:
        (row,) = rows
        over = {f"over_{key}": row[key] / own[key] for key in ("seconds", "peak_mb")}
        return {"seconds": row["seconds"], "peak_mb": peak, **over}
    return {"seconds": statistics.mean(row["seconds"] for row in rows), "peak_mb": peak}


def network_row(grid: Path, name: str, precision: str, bench: Bench) -> Row:
    """Return the microseconds of a network per voxel that it sees, and the seconds of all stages.

    The network for noise, or masks, is given as a file, which no grid replaces.
    """
    model = bench.network if name == "base" else name
    options = ("--inside", "negative", "--model", model, "--precision", precision)
    reports = [report_of(grid, *options) for _ in range(bench.runs + 1)][1:]
    medians = {
        stage: statistics.median(report["seconds"][stage] for report in reports)
        for stage in reports[0]["seconds"]
    }
    voxels = reports[0]["band_voxels"]
    rate = 1e6 * medians["network"] / voxels
    return {"us_per_voxel": rate, "stages": medians, "band_voxels": voxels}


def large_rows(bench: Bench, folder: Path) -> list[Row]:
    """Return the rows of a large torus, for several limits of memory."""
    n, rows, grid = LARGE * bench.sizes[-1] // 128, [], folder / "torus.npy"
    for limit in LIMITS:
        row = bench.timed({"torus": n, "limit": limit}, partial(large_row, grid, limit, n, bench))
        rows.append({"size": n, "option": f"torus-{limit}", "limit": limit, **row})
    return rows


def large_row(grid: Path, limit: str, n: int, bench: Bench) -> Row:
    """Return what a large grid takes within a limit."""
    if not grid.exists():
        write_torus(grid, n)
    options = ["--spacing", str(1 / n), "--max-memory", limit, *model_of(bench, "")]
    try:
        report = report_of(grid, *options)
    except SuperSdfError as refusal:
        return {"refused": str(refusal).partition("Error: ")[2]}
    costs = {"seconds": report["wall"], "peak_mb": report["peak"] / 1e6}
    costs["planned_mb"] = report["planned_bytes"] / 1e6
    return {**{key: report[key] for key in ("slabs", "band_voxels", "triangles")}, **costs}


def memory_rows(bench: Bench) -> list[Row]:
    """Fit the peak of processes by bytes per voxel that the network sees, and per decoded one."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for factor, share in FACTORS.items():  # fewer samples for a larger factor
            largest, found = bench.sizes[-1] * 2 // share, []
            for field, size in product(MEMORY_FIELDS, (max(largest // 2, 12), max(largest, 16))):
                key = {"memory": field, "size": size, "factor": factor}
                measure = partial(memory_row, field, size, factor, Path(folder), bench)
                found.append(bench.timed(key, measure))
            rows.append({"factor": factor, **fitted(found)})
    return rows


def memory_row(field: str, size: int, factor: int, folder: Path, bench: Bench) -> Row:
    """Return the voxels of a field, and the peak of the process that converts it."""
    from .bounds import write_field

    grid = write_field(field, size, folder / "grid.npy")
    options = ["--spacing", "1", "--factor", str(factor), *model_of(bench, "")]
    report = report_of(grid, "--max-memory", "16G", *options)
    return {key: report[key] for key in ("band_voxels", "decoded_voxels", "peak", "planned_bytes")}


def fitted(rows: Sequence[Row]) -> Row:
    """Return bytes per seen voxel, per decoded voxel and the rest, by least squares."""
    voxels = np.array([[r["band_voxels"], r["decoded_voxels"], 1e6] for r in rows], float)
    peaks = np.array([row["peak"] for row in rows], float)
    (seen, decoded, rest), _ = nnls(voxels / peaks[:, None], np.ones(len(rows)))
    off = np.abs(voxels @ [seen, decoded, rest] / peaks - 1).max()
    planned = max(row["peak"] / row["planned_bytes"] for row in rows)
    return {"seen": seen, "decoded": decoded, "fixed_mb": rest, "off": off, "of_plan": planned}


if __name__ == "__main__":
    convert_densely(*sys.argv[1:])
