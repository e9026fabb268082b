"""What a conversion costs: whole processes, start and files included, one after the other."""

from __future__ import annotations

import os
import platform
import statistics
import subprocess
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from super_sdf import Mesh, write_mesh
from super_sdf.errors import SuperSdfError
from super_sdf.threads import count_cores
from super_sdf.truth import sample_solid

from .rows import Row
from .shapes import Shape

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


def machine() -> dict[str, Any]:
    """Return the processor, its instructions, and the versions that times depend on."""
    about = {}
    if (path := Path("/proc/cpuinfo")).exists():
        pairs = (line.partition(":") for line in path.read_text().splitlines())
        about = {name.strip(): value.strip() for name, _, value in pairs}
    flags = about.get("flags", "").split()
    return {
        "processor": about.get("model name") or platform.processor() or platform.machine(),
        "cores": count_cores(),
        "instructions": [flag for flag in FLAGS if flag in flags],
        "system": platform.system(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "onnxruntime": version("onnxruntime"),
    }


def run_python(words: Sequence[str]) -> tuple[float, float, str]:
    """Run Python once; return its seconds, its peak in MB, and what it printed."""
    # an installed package is compiled: a fifth of a second more is not what its users wait for
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    command = [sys.executable, "-c", LAUNCHER, *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    printed, _, last = done.stdout.rstrip("\n").rpartition("\n")
    code, seconds, peak = last.split()
    if int(code):
        last_line = done.stderr.strip().rpartition("\n")[2]
        raise SuperSdfError(f"python {' '.join(words)} ended with {code}: {last_line}")
    return float(seconds), int(peak) / 1e6, printed.rstrip("\n")


def upsample_words(grid: Path, *options: str) -> list[str]:
    """Return Python's arguments that convert a grid to a mesh beside it."""
    mesh = grid.with_suffix(".ply")
    return ["-m", "super_sdf", "upsample", str(grid), str(mesh), "--force", "--quiet", *options]


def timed(words: Sequence[str], runs: int) -> Row:
    """Return the median of the seconds and the largest peak in MB of runs after a warm-up."""
    run_python(words)  # reads the files into the cache
    seconds, peaks, _ = zip(*(run_python(words) for _ in range(runs)))
    return {"seconds": statistics.median(seconds), "peak_mb": max(peaks)}


def write_grid(shape: Shape, size: int, folder: Path) -> Path:
    layout = (size, size, size), 1 / size, np.full(3, 0.5 / size - 0.5)
    grid = sample_solid(shape.solid, layout, band=np.inf)
    path = folder / f"{size}.npz"
    np.savez(path, values=grid.values, spacing=grid.spacing, origin=grid.origin)
    return path


def write_torus(path: Path, n: int) -> Path:
    """Write the distances to a torus of area 1.2 at the voxel centres of the unit cube, .npy."""
    centres = ((np.arange(n) + 0.5) / n - 0.5).astype(np.float32)
    field = np.lib.format.open_memmap(path, "w+", np.float32, (n, n, n))
    for plane, x in zip(field, centres):
        plane[:] = np.hypot(np.hypot(x, centres[:, None]) - 0.28, centres) - 0.11
    field.flush()
    return path


def convert_densely(source: str, target: str, order: str, factor: int = 4) -> None:
    """Refine a grid with SciPy and mesh it with scikit-image, as a short script would."""
    from scipy.ndimage import zoom
    from skimage.measure import marching_cubes

    values = np.load(source)["values"]
    scale = [(factor * n + 1) / n for n in values.shape]
    fine = zoom(values, scale, order=int(order), mode="nearest", grid_mode=True)
    vertices, faces, _, _ = marching_cubes(fine, 0.0)
    write_mesh(Mesh(vertices, faces.astype(np.int32)), target, force=True)


if __name__ == "__main__":
    convert_densely(*sys.argv[1:])
