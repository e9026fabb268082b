"""Faults at random moments while a batch runs, and whether the output is correct afterwards.

Each trial starts ``super-sdf batch`` in an empty folder, causes one fault, checks the output, and
runs the batch again, which must then be complete.
"""

from __future__ import annotations

import json
import resource
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from shutil import rmtree

import numpy as np
import psutil

from .mixed_grids import write_mixed

COMMAND = [sys.executable, "-m", "super_sdf", "batch"]
KILLS = {
    "batch killed": signal.SIGKILL,
    "batch ended": signal.SIGTERM,
    "batch hung up": signal.SIGHUP,
    "worker killed": signal.SIGKILL,
    "worker ended": signal.SIGTERM,
}
LIMITS = ("file limit", "full disk")
BALLAST = "ballast"  # a file that fills the disk until the first run is over
Process = subprocess.Popen[bytes]
OWN_FILES = {"report.jsonl", ".super-sdf-batch", ".super-sdf-batch.lock"}


@dataclass(frozen=True)
class Setting:
    """The grids, their expected meshes, and the undisturbed duration of the batch."""

    grids: Path
    meshes: Path
    right: dict[str, bytes]
    seconds: float

    def start(self, limit: int | None = None) -> Process:
        """Start the batch with a limit on the size of files."""
        words = [*COMMAND, str(self.grids), "--out", str(self.meshes), "--jobs", "2"]
        words += ["--quality", "fast", "--factor", "2", "--quiet"]
        lower = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (limit, limit))
        return subprocess.Popen(
            words, stderr=subprocess.PIPE, preexec_fn=None if limit is None else lower
        )

    def found(self) -> dict[str, bytes]:
        """Return what is in the output folder, by name."""
        paths = (path for path in self.meshes.rglob("*") if path.is_file())
        return {path.relative_to(self.meshes).as_posix(): path.read_bytes() for path in paths}


def make_setting(folder: Path, count: int, sizes: list[int]) -> Setting:
    """Write the grids, and convert them without a fault."""
    write_mixed(folder / "grids", count, sizes)
    setting = Setting(folder / "grids", folder / "meshes", {}, 0.0)
    start = time.perf_counter()
    _, output = setting.start().communicate()
    if output:
        raise SystemExit(output.decode())
    right = {name: data for name, data in setting.found().items() if name not in OWN_FILES}
    return Setting(setting.grids, setting.meshes, right, time.perf_counter() - start)


def count_faults(setting: Setting, kinds: list[str], seed: int) -> Counter[tuple[str, int, str]]:
    """Run one trial per kind; count the exit codes and the verdicts, "right" or what was wrong."""
    rng, counts = np.random.default_rng(seed), Counter[tuple[str, int, str]]()
    for kind in kinds:
        rmtree(setting.meshes, ignore_errors=True)
        setting.meshes.mkdir()
        with small_disk(setting.meshes) if kind == "full disk" else nullcontext():
            code, wrong = try_once(setting, kind, rng)
        counts[kind, code, wrong or "right"] += 1
        if wrong:
            print(f"{kind}: {wrong}", file=sys.stderr, flush=True)
    return counts


def try_once(setting: Setting, kind: str, rng: np.random.Generator) -> tuple[int, str | None]:
    """Cause a fault, and run the batch again.

    Return the exit code of the first run, and what is wrong, if anything is.
    """
    process = FAULTS[kind](setting, kind, rng)
    output, code = process.communicate()[1], process.returncode
    (setting.meshes / BALLAST).unlink(missing_ok=True)
    if b"Traceback" in output:
        return code, f"a traceback: {output.decode()}"
    wrong = half_written(setting)
    if wrong:
        return code, wrong
    process = setting.start()
    output = process.communicate()[1]
    if process.returncode or output:
        return code, f"exit code {process.returncode} when run again: {output.decode()}"
    return code, incomplete(setting)


def half_written(setting: Setting) -> str | None:
    """Return the files with a final name that are not complete."""
    found = setting.found()
    for name in found.keys() & setting.right.keys():
        if found[name] != setting.right[name]:
            return f"{name} is half written, or wrong"
    *lines, _ = found.get("report.jsonl", b"").split(b"\n")
    for row in map(json.loads, lines):
        if row["status"] == "ok" and row["out"] not in found:
            return f"{row['out']} is in the report alone"
    return None


def incomplete(setting: Setting) -> str | None:
    """Return the names of unexpected and missing files."""
    found = setting.found()
    if found.pop(".super-sdf-batch", b"") != b"":
        return "the journal is not empty"
    found.pop(".super-sdf-batch.lock", None)
    rows = {row["out"]: row for row in map(json.loads, found.pop("report.jsonl").splitlines())}
    if {name for name, row in rows.items() if row["status"] == "ok"} != setting.right.keys():
        return "the report lacks a row"
    names = found.keys() ^ setting.right.keys()
    return f"left over or missing: {', '.join(names)}" if names else half_written(setting)


def kill(setting: Setting, kind: str, rng: np.random.Generator) -> Process:
    """Send a signal to the batch, or to one of its workers, at a random moment."""
    process = setting.start()
    time.sleep(rng.uniform(0, setting.seconds))
    victims = [process.pid]
    if kind.startswith("worker"):
        victims = [child.pid for child in children_of(process.pid)]
    if victims and process.poll() is None:
        with suppress(psutil.NoSuchProcess):  # it was through
            psutil.Process(victims[rng.integers(len(victims))]).send_signal(KILLS[kind])
    return process


def children_of(pid: int) -> list[psutil.Process]:
    """Return the worker processes of a batch."""
    try:
        children = psutil.Process(pid).children()
        return [child for child in children if "spawn_main" in " ".join(child.cmdline())]
    except psutil.Error:  # it has ended, or one of them has
        return []


def limit_files(setting: Setting, kind: str, rng: np.random.Generator) -> Process:
    """Limit the size of files at random: larger ones are written in part."""
    largest = max(map(len, setting.right.values()))
    return setting.start(int(rng.integers(0, largest)))


def fill_disk(setting: Setting, kind: str, rng: np.random.Generator) -> Process:
    """Leave a random amount of free space on the disk."""
    room = int(rng.integers(0, sum(map(len, setting.right.values()))))
    (setting.meshes / BALLAST).write_bytes(bytes(max(0, DISK_BYTES - room)))
    return setting.start()


DISK_BYTES = 4 << 20
FAULTS: dict[str, Callable[[Setting, str, np.random.Generator], Process]] = {
    **dict.fromkeys(KILLS, kill),
    "file limit": limit_files,
    "full disk": fill_disk,
}


@contextmanager
def small_disk(folder: Path) -> Iterator[None]:
    """Mount a small RAM disk on a folder, which only root may do."""
    words = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(folder)]
    subprocess.run(words, check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)
