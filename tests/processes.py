"""What tests of processes share: signals that they hear, their ends, patience on a busy machine."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
from conftest import ball

# The command line where there are two cores, however few there are.
COMMAND = """
from super_sdf.batch import run
from super_sdf.cli.main import main
run.count_cores = lambda: 2
main()
"""
PATIENCE = 600  # seconds, after which something hangs, however busy the machine is


def hear_signals() -> None:
    """Hear again what ``nohup``, or ``&`` in a script, has a child ignore, before it runs."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        signal.signal(getattr(signal, name), signal.SIG_DFL)


def start_command(*words: object) -> subprocess.Popen[str]:
    """Start the command line as a process, of a group of its own, that hears all signals."""
    arguments = [sys.executable, "-c", COMMAND, *map(str, words)]
    pipe = subprocess.PIPE
    how = {"stdout": pipe, "stderr": pipe, "text": True, "start_new_session": True}
    return subprocess.Popen(arguments, **how, preexec_fn=hear_signals)


def wait_until(condition: Callable[[], bool]) -> bool:
    """Wait until a condition holds; return whether it does."""
    limit = time.monotonic() + PATIENCE
    while not (holds := condition()) and time.monotonic() < limit:
        time.sleep(0.01)
    return holds


def is_over(process: psutil.Process) -> bool:
    """Say whether a process has ended, if only its parent has still to hear of it."""
    with suppress(psutil.NoSuchProcess):
        return process.status() == psutil.STATUS_ZOMBIE
    return True


def all_end(processes: Iterable[psutil.Process]) -> bool:
    """Wait until processes have ended; return whether they have."""
    return wait_until(lambda: all(map(is_over, processes)))


def wait_for_lines(process: subprocess.Popen[str], path: Path, lines: int = 2) -> None:
    """Wait until a process, which must run on, has written some lines to a file."""

    def are_there() -> bool:
        return path.exists() and path.read_bytes().count(b"\n") >= lines

    assert wait_until(lambda: are_there() or process.poll() is not None)
    assert process.poll() is None, process.stderr and process.stderr.read()


def larger_grids(count: int) -> None:
    """Write grids that take a moment, below ``in``."""
    for i in range(count):
        np.save(f"in/more{i}.npy", ball(32, 10 + i / 40).values)
