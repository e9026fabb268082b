"""End conversions and batches at random moments, or fill the disk, and check what is left.

    python -m lab faults                                    # about an hour
    python -m lab faults --runs 2 --size 12 --count 4       # a minute
    python -m lab faults --cluster local

``super-sdf upsample``, in every format and with checks, and ``super-sdf batch`` are ended by a
signal, lose a worker, or may write files of a random size only; with ``--disks`` a batch fills a
RAM disk, which only root may mount. Whatever has its final name must be complete, no run may go on
after its signal or say what is not so, and a terminated one must leave nothing else. Run again, the
command must leave what it leaves undisturbed.
"""

from __future__ import annotations

import argparse
import json
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from shutil import rmtree

import numpy as np
import psutil

from super_sdf.files.meshes import MESH_SUFFIXES

from . import parser_of
from .forms import ball
from .processes import describe_machine

COMMAND = [sys.executable, "-m", "super_sdf"]
QUICK = ["--quality", "fast", "--quiet"]
CHECKED = "-checked"
AT_ONCE = 0.5  # seconds in which a run ends that was about to end anyway
LONG_ENOUGH = 120.0  # seconds; every run is shorter
SIGNALS = {
    "SIGTERM": signal.SIGTERM,
    "SIGHUP": signal.SIGHUP,
    "SIGKILL": signal.SIGKILL,
    "worker SIGTERM": signal.SIGTERM,
    "worker SIGKILL": signal.SIGKILL,
}
LIMIT, DISK = "file limit", "full disk"
DISK_BYTES = 4 << 20
BALLAST = "ballast"  # a file that fills the disk until the first run is over
OF_BATCH = {"report.jsonl", ".super-sdf-batch", ".super-sdf-batch.lock"}
Process = subprocess.Popen[bytes]


class Job:
    """A command that writes files into a folder, and what it leaves there undisturbed."""

    def __init__(self, words: Sequence[object], out: Path) -> None:
        self.words, self.out = [*COMMAND, *map(str, words), *QUICK], out
        self.is_batch = words[0] == "batch"
        out.mkdir()
        start, process = time.perf_counter(), self.start()
        while process.poll() is None and not any(out.iterdir()):
            time.sleep(0.001)
        self.first_file = time.perf_counter() - start
        if output := process.communicate(timeout=LONG_ENOUGH)[1]:
            raise SystemExit(output.decode())
        self.seconds = time.perf_counter() - start
        self.right = {name: data for name, data in self.found().items() if name not in OF_BATCH}

    def start(self, limit: int | None = None) -> Process:
        """Start the command, with a limit on the size of files if one is given."""
        lower = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (limit, limit))
        before = None if limit is None else lower
        return subprocess.Popen(self.words, stderr=subprocess.PIPE, preexec_fn=before)

    def found(self) -> dict[str, bytes]:
        """Return the files of the folder by name; pages hold times, and are not compared."""
        files = {
            path.relative_to(self.out).as_posix(): path
            for path in self.out.rglob("*")
            if path.is_file()
        }
        return {n: b"" if n.endswith(".html") else p.read_bytes() for n, p in files.items()}

    def disturb(self, fault: str) -> str:
        """Cause a fault in a run, run the command again; return "right", or what is wrong."""
        rmtree(self.out)
        self.out.mkdir()
        with small_disk(self.out) if fault == DISK else nullcontext():
            wrong = self.run_with(fault)
            (self.out / BALLAST).unlink(missing_ok=True)
            again = self.start()
            output = again.communicate(timeout=LONG_ENOUGH)[1]
            if not wrong and (again.returncode or output):
                wrong = f"fails when run again: {output.decode()}"
            return wrong or self.half_written() or self.beside() or self.missing() or "right"

    def run_with(self, fault: str) -> str:
        """Run the command with a fault at a random moment; return what is wrong then."""
        sizes = [len(data) for data in self.right.values()]
        if fault == DISK:
            room = random.randrange(sum(sizes))
            (self.out / BALLAST).write_bytes(bytes(max(0, DISK_BYTES - room)))
        process = self.start(random.randrange(max(sizes) + 1) if fault == LIMIT else None)
        sent, number = np.inf, SIGNALS.get(fault, 0)
        if number:  # half of the runs are ended while they write
            time.sleep(random.uniform(random.choice((0, self.first_file)), 1.05 * self.seconds))
            with suppress(psutil.Error, IndexError):  # it was through
                is_worker = fault.startswith("worker")
                victims = workers_of(process.pid) if is_worker else [psutil.Process(process.pid)]
                random.choice(victims).send_signal(number)
                sent = np.inf if is_worker else time.perf_counter()
        output = process.communicate(timeout=LONG_ENOUGH)[1]
        if process.returncode == 0 and time.perf_counter() - sent > AT_ONCE:
            return "goes on after a signal"
        if process.returncode not in (0, 1, 128 + number, -number):
            return f"exit code {process.returncode}"
        if fault == "SIGKILL":  # of which the workers of a batch may complain
            output = b""
        is_ended = fault in ("SIGTERM", "SIGHUP")
        return self.misleading(output) or self.half_written() or (self.beside() if is_ended else "")

    def misleading(self, output: bytes) -> str:
        """Return what should not have been printed; empty if nothing is wrong with it."""
        if b"Traceback" in output or (output.count(b"\n") > 1 and not self.is_batch):
            return f"prints {output.decode()}"
        is_there = bool(self.found().keys() & self.right.keys())
        is_false = b"nothing was written" in output if is_there else b"is written" in output
        return f"says what is not so: {output.decode()}" if is_false and not self.is_batch else ""

    def half_written(self) -> str:
        """Return the files with a final name that are not complete; empty if none is."""
        found = self.found()
        half = [name for name in found.keys() & self.right if found[name] != self.right[name]]
        half += self.reported() - found.keys()
        return f"half-written: {', '.join(half)}" if half else ""

    def beside(self) -> str:
        """Return the files that are neither results nor the report of a batch."""
        names = self.found().keys() - self.right - OF_BATCH
        return f"left beside: {', '.join(names)}" if names else ""

    def missing(self) -> str:
        """Return the results that are not there, or not reported."""
        names = self.right.keys() - self.found()
        names |= self.right.keys() - self.reported() if self.is_batch else set()
        return f"missing: {', '.join(names)}" if names else ""

    def reported(self) -> set[str]:
        """Return the meshes that the complete lines of a batch's report say are made."""
        *lines, _ = self.found().get("report.jsonl", b"").split(b"\n")
        rows = [json.loads(line) for line in lines]
        return {row["out"] for row in rows if row["status"] == "ok"}


def workers_of(pid: int) -> list[psutil.Process]:
    """Return the worker processes of a batch; none if it has ended."""
    children = psutil.Process(pid).children(recursive=True)
    return [child for child in children if "spawn_main" in " ".join(child.cmdline())]


@contextmanager
def small_disk(folder: Path) -> Iterator[None]:
    """Mount a small RAM disk on a folder, which only root may do."""
    words = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(folder)]
    subprocess.run(words, check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def write_balls(folder: Path, count: int, size: int) -> Path:
    """Write grids of balls, no two alike; return the folder."""
    folder.mkdir()
    x, y, z = np.indices((size,) * 3) - size / 2 + 0.4
    for number in range(count):
        values = ball(x, y, z, 0.1 * number, size / 3 - 0.05 * number).astype(np.float32)
        np.savez(folder / f"{number}.npz", values=values, spacing=1.0, origin=0.0)
    return folder


def main() -> int:
    """Run all trials, print a line for each fault; exit code 1 if anything was wrong."""
    parser = parser_of(__doc__)
    parser.add_argument("--runs", type=int, default=200, help="of each fault")
    parser.add_argument("--disks", action="store_true", help="also fill a RAM disk, as root")
    parser.add_argument("--cluster", help="of the batch: local, or the address of a scheduler")
    parser.add_argument("--size", type=int, default=24, help="samples along each axis")
    parser.add_argument("--count", type=int, default=8, help="grids of the batch")
    parser.add_argument("--seed", type=int, default=0, help="of the random moments")
    words = parser.parse_args()
    random.seed(words.seed)
    print(describe_machine(), flush=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        grids = write_balls(folder / "grids", words.count, words.size)
        jobs = {"upsample": single_jobs(folder, grids), "batch": [batch_job(folder, grids, words)]}
        of_process = [fault for fault in SIGNALS if not fault.startswith("worker")]
        faults = {"upsample": [*of_process, LIMIT]}
        faults["batch"] = [*SIGNALS, LIMIT, *([DISK] if words.disks else [])]
        trials = [(kind, fault) for kind in jobs for fault in faults[kind]]
        return int(any([tally(kind, fault, jobs[kind], words.runs) for kind, fault in trials]))


def single_jobs(folder: Path, grids: Path) -> list[Job]:
    """Return conversions of a grid to every format, and one with checks and a report."""
    jobs = []
    for suffix in (*MESH_SUFFIXES, CHECKED):
        out = folder / f"as{suffix}"
        more = ["--check", "--report", out / "page.html"] if suffix == CHECKED else []
        target = out / f"mesh{suffix.removesuffix(CHECKED) or '.ply'}"
        jobs.append(Job(["upsample", grids / "0.npz", target, "--force", *more], out))
    return jobs


def batch_job(folder: Path, grids: Path, words: argparse.Namespace) -> Job:
    """Return a batch in two processes, or on a cluster."""
    out, jobs = folder / "batch", ["--jobs", 2] if words.cluster in (None, "local") else []
    cluster = ["--cluster", words.cluster] if words.cluster else []
    return Job(["batch", grids, "--out", out, "--factor", 2, *jobs, *cluster], out)


def tally(kind: str, fault: str, jobs: Sequence[Job], runs: int) -> bool:
    """Disturb runs of all jobs in turn, print what came of it; return whether any was wrong."""
    found = Counter(jobs[turn % len(jobs)].disturb(fault) for turn in range(runs))
    said = "; ".join(f"{what}: {count}" for what, count in found.items())
    print(f"{kind}, {fault}: {said}", flush=True)
    return set(found) != {"right"}
