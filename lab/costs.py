"""What a conversion costs: whole processes, start and files included, one after the other."""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from super_sdf import Mesh, write_mesh
from super_sdf.convert import ConvertOptions, convert
from super_sdf.errors import SuperSdfError
from super_sdf.machine.memory import forget_peak, held_memory
from super_sdf.machine.system import described, processor_name
from super_sdf.network.decoder import Decoder
from super_sdf.threads import count_cores
from super_sdf.truth.sampling import sample_solid, unit_layout

from .forms import torus
from .measuring import network_of
from .rows import Row
from .shapes import Shape, spread

if TYPE_CHECKING:
    from .figures import Bench

MAJOR, MINOR = 0.28, 0.11  # radii of the torus of ``write_torus``
FLAGS = ("avx", "avx2", "avx512f", "avx512_vnni", "avx_vnni", "amx_int8")
# Runs Python with its arguments; prints exit code, seconds, and the peak of memory in bytes. That
# peak includes what the parent held when it started the process, so the parent has to be small.
LAUNCHER = """
import os, sys, time
sys.path[:] = filter(None, sys.path)  # nothing from the current folder
start = time.perf_counter()
child = os.spawnv(os.P_NOWAIT, sys.executable, [sys.executable, *sys.argv[1:]])
_, status, usage = os.wait4(child, 0)
seconds, code = time.perf_counter() - start, os.waitstatus_to_exitcode(status)
print()
print(code, seconds, usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024))
"""


class Taken(NamedTuple):
    """What a process took, and what it printed."""

    seconds: float
    peak: int
    code: int
    printed: str
    errors: str

    @property
    def peak_mb(self) -> float:
        """The peak of memory in MB."""
        return self.peak / 1e6


def describe_machine() -> str:
    """Return the processor and the versions that times depend on, in one line."""
    about = machine()
    return (
        f"{about['processor']}, {about['cores']} cores, {about['system']}, Python "
        f"{about['python']}, NumPy {about['numpy']}, onnxruntime {about['onnxruntime']}"
    )


def machine() -> dict[str, Any]:
    """Return the processor, its instructions, and the versions that times depend on."""
    flags = described().get("flags", "").split()
    return {
        "processor": processor_name(),
        "cores": count_cores(),
        "instructions": [flag for flag in FLAGS if flag in flags],
        "system": platform.system(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "onnxruntime": version("onnxruntime"),
    }


def run_python(words: Sequence[str], *, failing: bool = False) -> Taken:
    """Run Python once with these arguments."""
    # an installed package is compiled: a fifth of a second more is not what its users wait for
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    command = [sys.executable, "-c", LAUNCHER, *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    printed, _, last = done.stdout.rstrip("\n").rpartition("\n")
    code, seconds, peak = last.split()
    if int(code) and not failing:
        last_line = done.stderr.strip().rpartition("\n")[2]
        raise SuperSdfError(f"python {' '.join(words)} ended with {code}: {last_line}")
    return Taken(float(seconds), int(peak), int(code), printed.rstrip("\n"), done.stderr.strip())


def upsample_words(grid: Path, *options: str, target: Path | None = None) -> list[str]:
    """Return Python's arguments that convert a grid to a mesh beside it."""
    mesh = target or grid.with_suffix(".ply")
    return ["-m", "super_sdf", "upsample", str(grid), str(mesh), "--force", "--quiet", *options]


def median_of(measure: Callable[[], tuple[float, float]], runs: int) -> dict[str, float]:
    """Return the median of the seconds and the largest peak in MB of runs after a warm-up."""
    measure()  # reads the files into the cache
    seconds, peaks = zip(*(measure() for _ in range(runs)))
    return {"seconds": statistics.median(seconds), "peak_mb": max(peaks)}


def timed(words: Sequence[str], runs: int) -> dict[str, float]:
    """Return the median of the seconds and the largest peak in MB of a process."""
    return median_of(lambda: ((taken := run_python(words)).seconds, taken.peak_mb), runs)


def write_grid(shape: Shape, size: int, folder: Path) -> Path:
    """Write the exact samples of a shape, box diagonal 1 in the unit cube, as ``.npz``."""
    grid = sample_solid(shape.solid, unit_layout(size), band=np.inf)
    path = folder / f"{size}.npz"
    np.savez(path, values=grid.values, spacing=grid.spacing, origin=grid.origin)
    return path


def write_torus(path: Path, n: int) -> Path:
    """Write the distances to a torus of area 1.2 at the voxel centres of the unit cube, .npy."""
    centres = ((np.arange(n) + 0.5) / n - 0.5).astype(np.float32)
    field = np.lib.format.open_memmap(path, "w+", np.float32, (n, n, n))
    for plane, x in zip(field, centres):
        plane[:] = torus(x, centres[:, None], centres, MAJOR, MINOR)
    field.flush()
    return path


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


def time_command(grid: Path, options: Sequence[str], runs: int) -> Row:
    """Return seconds and peak of the command on a grid that is negative inside."""
    return timed(upsample_words(grid, "--inside", "negative", *options), runs)


def time_warm(grid: Path, network: Decoder, runs: int) -> Row:
    """Return the same from file to file in this process, which has loaded the network."""

    def once() -> tuple[float, float]:
        forget_peak()
        start = time.perf_counter()
        options = ConvertOptions(inside="negative")
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
    return {**{key: report[key] for key in ("tiles", "band_voxels", "triangles")}, **costs}


if __name__ == "__main__":
    convert_densely(*sys.argv[1:])
