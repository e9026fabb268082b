"""Processes that are timed: seconds and peak memory, start and files included."""

from __future__ import annotations

import os
import platform
import statistics
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from super_sdf.errors import SuperSdfError
from super_sdf.threads import count_cores
from super_sdf.threads import described, processor_name
from super_sdf.truth.sampling import sample_solid, unit_layout

from .forms import torus
from .shapes import Shape

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
