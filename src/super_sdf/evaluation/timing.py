"""Time and memory of the whole command, including its start and files."""

from __future__ import annotations

import os
import platform
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import numpy as np

from ..errors import SuperSdfError
from ..machine.processor import processor_name
from ..machine.threads import count_cores
from .cases import Case, Setting, Shape
from .measuring import Measurement

RUNS = 5
# Runs Python with its arguments; prints exit code, seconds, and the peak of memory in bytes. That
# peak includes what the parent held when it started the process, so the parent has to be small.
# Windows has no wait4: there the peak is read while the process runs.
LAUNCHER = """
import os, sys, time
sys.path[:] = filter(None, sys.path)  # nothing from the current folder
command = [sys.executable, *sys.argv[1:]]
if hasattr(os, "wait4"):
    start = time.perf_counter()
    child = os.spawnv(os.P_NOWAIT, sys.executable, command)
    _, status, usage = os.wait4(child, 0)
    seconds, code = time.perf_counter() - start, os.waitstatus_to_exitcode(status)
    peak = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
else:
    import psutil, subprocess
    start, peak = time.perf_counter(), 0
    child = subprocess.Popen(command)
    while (code := child.poll()) is None:
        try:
            peak = psutil.Process(child.pid).memory_info().peak_wset
        except psutil.Error:  # it has just ended
            pass
        time.sleep(0.005)
    seconds = time.perf_counter() - start
print()
print(code, seconds, peak)
"""


def describe_machine() -> str:
    """Return the processor and the versions that times depend on, in one line."""
    return (
        f"{processor_name()}, {count_cores()} cores, {platform.system()}, Python "
        f"{platform.python_version()}, NumPy {np.__version__}, onnxruntime {version('onnxruntime')}"
    )


def run_command(words: Sequence[str]) -> tuple[float, float]:
    """Run ``super-sdf`` once; return its seconds and its peak of memory in MB.

    Raises
    ------
    SuperSdfError
        If the command fails.
    """
    seconds, peak, _ = run_python(["-m", "super_sdf", *words])
    return seconds, peak


def run_python(words: Sequence[str]) -> tuple[float, float, str]:
    """Run Python once with these arguments; return seconds, peak in MB, and its output.

    Raises
    ------
    SuperSdfError
        If it fails.
    """
    command = [sys.executable, "-c", LAUNCHER, *words]
    # an installed package is compiled: a fifth of a second more is not what its users wait for
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment)
    printed, _, last = done.stdout.rstrip("\n").rpartition("\n")
    code, seconds, peak = last.split()
    if int(code):
        raise SuperSdfError(f"python {' '.join(words)} ended with {code}")
    return float(seconds), int(peak) / 1e6, printed


@contextmanager
def grid_file(shape: Shape, setting: Setting) -> Iterator[Path]:
    """Yield the path of a shape's grid, in a temporary folder."""
    case = Case(shape, setting)
    with tempfile.TemporaryDirectory() as folder:
        grid = Path(folder) / "grid.npz"
        np.savez(grid, values=case.coarse, spacing=case.spacing, origin=case.grid.origin)
        yield grid


def time_shape(shape: Shape, setting: Setting, options: Sequence[str] = ()) -> Measurement:
    """Return the time of the command on a shape's grid: the median of ``RUNS`` after a warm-up."""
    with grid_file(shape, setting) as grid:
        words = ["upsample", str(grid), str(grid.with_suffix(".ply")), "--force", "--quiet"]
        words += ["--inside", "negative", "--factor", str(setting.factor), *options]
        run_command(words)  # warm-up: reads the files into the cache
        runs = [run_command(words) for _ in range(RUNS)]
    seconds, peaks = zip(*runs)
    return {"seconds": statistics.median(seconds), "peak_mb": max(peaks), "error": None}
