"""How long the command takes and how much memory: whole processes, start included.

    python -m benchmarks.speed --meshes DIR --sizes 32 64 128 --shapes 10 --runs 5

Samples every shape at every size, runs ``super-sdf upsample`` on it several times, and prints for
each size the mean over shapes of the median time, the slowest shape, and the highest peak of
memory.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import onnxruntime

from export.sampling import load_mesh, sample_grid, unit_grid


def write_grid(mesh_path: Path, n: int, target: Path) -> None:
    """Sample a mesh, its bounding box diagonal 1, on the protocol's grid of n^3."""
    shape, spacing, origin = unit_grid(n)
    values = sample_grid(load_mesh(str(mesh_path)), shape, spacing, origin)
    np.savez(target, values=values.astype(np.float32), spacing=spacing, origin=origin)


def run_once(grid: Path, options: list[str]) -> tuple[float, float]:
    """Run the command; return seconds and its peak of memory in MB."""
    command = Path(sys.executable).with_name("super-sdf")
    start = time.perf_counter()
    arguments = [str(command), "upsample", str(grid), str(grid.with_suffix(".ply")), "--force"]
    child = subprocess.Popen([*arguments, "--quiet", "--inside", "negative", *options])
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"{grid.name}: the command ended with {child.returncode}")
    return time.perf_counter() - start, usage.ru_maxrss / 1000


def measure(grids: list[Path], runs: int, options: list[str]) -> tuple[list[float], float]:
    """Return each grid's median of seconds, and the highest peak in MB."""
    for grid in grids[:1]:
        run_once(grid, options)  # files into the cache
    results = [[run_once(grid, options) for _ in range(runs)] for grid in grids]
    seconds = [statistics.median(time for time, _ in result) for result in results]
    return seconds, max(peak for result in results for _, peak in result)


def main() -> None:
    """Print the machine and a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--meshes", type=Path, required=True)
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 64, 128])
    parser.add_argument("--shapes", type=int, default=10, help="how many, spread over the folder")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("options", nargs="*", help="further options of the command, after --")
    asked = parser.parse_args()
    paths = sorted(asked.meshes.glob("*.ply"))
    paths = [paths[i] for i in np.linspace(0, len(paths) - 1, asked.shapes).astype(int)]
    print(
        f"{len(os.sched_getaffinity(0))} cores, Python {platform.python_version()}, "
        f"onnxruntime {onnxruntime.__version__}, {len(paths)} shapes, median of {asked.runs}\n"
    )
    print("| grid | mean s | slowest s | peak MB |\n| --- | ---: | ---: | ---: |")
    for n in asked.sizes:
        with tempfile.TemporaryDirectory() as folder:
            grids = [Path(folder) / f"{path.stem}.npz" for path in paths]
            for path, grid in zip(paths, grids):
                write_grid(path, n, grid)
            seconds, peak = measure(grids, asked.runs, asked.options)
        print(
            f"| {n}^3 | {statistics.mean(seconds):.2f} | {max(seconds):.2f} | {peak:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
