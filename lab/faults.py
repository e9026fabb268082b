"""End conversions and batches at random moments, or fill the disk, and check what is left.

    python -m lab faults                                    # some hours
    python -m lab faults --terms 3 --kills 3 --full 3 --checks 3 --batches 2 --disks 1

Runs ``super-sdf upsample`` and ends it after a random share of its duration, or in every second run
after a random share of the time from its first file on; or limits the size of files at random. The
target must be absent or complete, a terminated run must leave no other file, and the next run must
leave nothing but the mesh. Runs with ``--check`` and ``--report`` are ended, too: none may go on,
or say of the mesh what is not so. A batch or one of its workers is killed or terminated, or its
disk fills up (a RAM disk, which only root may mount); run again it must be complete.
"""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from shutil import rmtree

import numpy as np
import psutil

from super_sdf.files.meshes import MESH_SUFFIXES

from . import parser_of
from .batch import COMMAND, workers_of, write_grids
from .processes import describe_machine

LONG_ENOUGH = 120.0  # seconds; every run is shorter
AT_ONCE = 0.5  # seconds in which a run ends that was about to end anyway
KILLS = {
    "batch killed": signal.SIGKILL,
    "batch ended": signal.SIGTERM,
    "batch hung up": signal.SIGHUP,
    "worker killed": signal.SIGKILL,
    "worker ended": signal.SIGTERM,
}
LIMITS = ("file limit", "full disk")
DISK_BYTES = 4 << 20
BALLAST = "ballast"  # a file that fills the disk until the first run is over
OWN_FILES = {"report.jsonl", ".super-sdf-batch", ".super-sdf-batch.lock"}
HARMLESS = ("whole", "right", "left beside")
OPTIONS = {
    "--terms": (100, "runs ended by SIGTERM"),
    "--kills": (100, "runs ended by SIGKILL"),
    "--full": (50, "runs with a limit on files"),
    "--checks": (80, "runs with --check and --report"),
    "--batches": (200, "batches that are disturbed"),
    "--disks": (50, "batches on a disk that fills"),
    "--size": (24, "samples along each axis"),
    "--count": (8, "grids of a batch"),
    "--seed": (0, "of the random moments"),
}
Process = subprocess.Popen[bytes]
Counts = Counter[str]


def start(words: Sequence[object], limit: int | None = None) -> Process:
    """Start a command, with a limit on the size of files if one is given."""
    lower = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (limit, limit))
    words, before = [*COMMAND, *map(str, words)], None if limit is None else lower
    return subprocess.Popen(words, stderr=subprocess.PIPE, preexec_fn=before)


class Single:
    """A folder with the grid of a ball, and the meshes of undisturbed runs in every format."""

    def __init__(self, folder: Path, size: int) -> None:
        self.folder, self.grid = folder / "out", folder / "g.npy"
        self.checks = "--check", "--report", folder / "page.html"
        self.folder.mkdir()
        ijk = np.indices((size,) * 3, dtype=np.float32)
        ball = np.linalg.norm(ijk - np.float32(size / 2 - 0.4), axis=0) - size / 3
        np.save(self.grid, ball.astype(np.float32))
        self.whole: dict[str, bytes] = {}
        self.seconds: dict[str, float] = {}
        self.writing: dict[str, float] = {}  # the seconds of these from the first file on
        self.turn = 0
        for suffix in MESH_SUFFIXES:
            begun, process = time.perf_counter(), self.start(suffix)
            self.wait_for_file(process)
            first_file = time.perf_counter()
            process.wait(LONG_ENOUGH)
            self.seconds[suffix] = time.perf_counter() - begun
            self.writing[suffix] = time.perf_counter() - first_file
            self.whole[suffix] = self.target(suffix).read_bytes()
            self.target(suffix).unlink()
        begun = time.perf_counter()
        self.start(".ply", None, *self.checks).wait(LONG_ENOUGH)
        self.checking = time.perf_counter() - begun
        self.target(".ply").unlink()

    def target(self, suffix: str) -> Path:
        """Return the path of the mesh."""
        return self.folder / f"ball{suffix}"

    def start(self, suffix: str, limit: int | None = None, *more: object) -> Process:
        """Start a run."""
        options = ["--quality", "fast", "--quiet", "--force", *more]
        return start(["upsample", self.grid, self.target(suffix), *options], limit)

    def wait_for_file(self, process: Process) -> None:
        """Wait until a run has created a file, or ended."""
        while process.poll() is None and not os.listdir(self.folder):
            time.sleep(0.001)

    def faults(self, suffix: str, process: Process, codes: Sequence[int]) -> Counts:
        """Count what a disturbed run should not have done or left, then complete another run."""
        _, output = process.communicate(timeout=LONG_ENOUGH)
        target, found = self.target(suffix), Counts()
        found["exit codes of others"] += process.returncode not in codes
        found["more than one line printed"] += output.count(b"\n") > 1
        if target.exists():
            found["whole"] += 1
            found["HALF-WRITTEN"] += target.read_bytes() != self.whole[suffix]
        found["left beside"] += bool(set(os.listdir(self.folder)) - {target.name})
        self.start(suffix).wait(LONG_ENOUGH)
        found["LEFT AFTER THE NEXT RUN"] += os.listdir(self.folder) != [target.name]
        found["WRONG AFTER THE NEXT RUN"] += target.read_bytes() != self.whole[suffix]
        target.unlink()
        return found

    def kill(self, number: signal.Signals, suffix: str) -> Counts:
        """End a run by a signal at a random moment."""
        process = self.start(suffix)
        self.turn += 1
        if self.turn % 2:
            self.wait_for_file(process)
        seconds = self.writing if self.turn % 2 else self.seconds
        time.sleep(random.uniform(0, 1.05) * seconds[suffix])
        process.send_signal(number)
        found = self.faults(suffix, process, (0, 128 + number, -number))
        found["LEFT BY SIGTERM"] += number == signal.SIGTERM and found["left beside"]
        return found

    def fill(self, suffix: str) -> Counts:
        """Limit the size of files at random."""
        limit = random.randrange(len(self.whole[suffix]) + 1)
        return self.faults(suffix, self.start(suffix, limit), (0, 1))

    def check(self, suffix: str) -> Counts:
        """End a run that checks the mesh at a random moment."""
        process = self.start(suffix, None, *self.checks)
        target = self.target(suffix)
        time.sleep(random.uniform(0, 1) * self.checking)
        process.send_signal(signal.SIGTERM)
        sent = time.perf_counter()
        _, output = process.communicate(timeout=LONG_ENOUGH)
        went_on = process.returncode == 0 and time.perf_counter() - sent > AT_ONCE
        false = b"nothing was written" in output and target.exists()
        false |= b"is written" in output and not target.exists()
        target.unlink(missing_ok=True)
        found = Counts({"whole": process.returncode == 0 and not went_on, "went on": went_on})
        found["exit codes of others"] += process.returncode not in (0, 143, -15)
        found["more than one line printed"] += output.count(b"\n") > 1
        found["said what is not so"] += false
        return found


class Many:
    """A folder of grids, their meshes, and the undisturbed duration of the batch."""

    def __init__(self, folder: Path, count: int, size: int) -> None:
        self.grids, self.meshes = folder / "grids", folder / "meshes"
        write_grids(self.grids, count, [size])
        begun = time.perf_counter()
        _, output = self.start().communicate()
        if output:
            raise SystemExit(output.decode())
        self.seconds = time.perf_counter() - begun
        self.right = {name: data for name, data in self.found().items() if name not in OWN_FILES}

    def start(self, limit: int | None = None) -> Process:
        """Start the batch."""
        options = ["--jobs", "2", "--quality", "fast", "--factor", "2", "--quiet"]
        return start(["batch", self.grids, "--out", self.meshes, *options], limit)

    def found(self) -> dict[str, bytes]:
        """Return what is in the output folder, by name."""
        paths = (path for path in self.meshes.rglob("*") if path.is_file())
        return {path.relative_to(self.meshes).as_posix(): path.read_bytes() for path in paths}

    def disturb(self, kind: str) -> Counts:
        """Cause a fault at a random moment, and run the batch again."""
        rmtree(self.meshes, ignore_errors=True)
        self.meshes.mkdir()
        with small_disk(self.meshes) if kind == "full disk" else nullcontext():
            output = self.faulty(kind).communicate()[1]
            (self.meshes / BALLAST).unlink(missing_ok=True)
            wrong = "TRACEBACK" if b"Traceback" in output else self.half_written()
            if not wrong:
                process = self.start()
                output = process.communicate()[1]
                wrong = "FAILS WHEN RUN AGAIN" if process.returncode or output else ""
            return Counts({f"{kind}: {wrong or self.incomplete()}": 1})

    def faulty(self, kind: str) -> Process:
        """Start the batch, and cause the fault."""
        if kind == "file limit":
            return self.start(random.randrange(max(map(len, self.right.values()))))
        if kind == "full disk":
            room = random.randrange(sum(map(len, self.right.values())))
            (self.meshes / BALLAST).write_bytes(bytes(max(0, DISK_BYTES - room)))
            return self.start()
        process = self.start()
        time.sleep(random.uniform(0, self.seconds))
        with suppress(psutil.Error, IndexError):  # it was through
            of_batch = kind.startswith("batch")
            victims = [psutil.Process(process.pid)] if of_batch else workers_of(process.pid)
            random.choice(victims).send_signal(KILLS[kind])
        return process

    def half_written(self) -> str:
        """Return the files with a final name that are not complete; empty if none is."""
        found = self.found()
        names = found.keys() & self.right.keys()
        half = [name for name in names if found[name] != self.right[name]]
        *lines, _ = found.get("report.jsonl", b"").split(b"\n")
        rows = [json.loads(line) for line in lines]
        half += [row["out"] for row in rows if row["status"] == "ok" and row["out"] not in found]
        return f"HALF-WRITTEN {', '.join(half)}" if half else ""

    def incomplete(self) -> str:
        """Return what is wrong after the last run: "right", or the names of files."""
        found = self.found()
        rows = [json.loads(line) for line in found.get("report.jsonl", b"").splitlines()]
        reported = {row["out"] for row in rows if row["status"] == "ok"}
        names = (found.keys() - OWN_FILES) ^ self.right.keys() | (reported ^ self.right.keys())
        return f"LEFT OVER OR MISSING {', '.join(names)}" if names else "right"


@contextmanager
def small_disk(folder: Path) -> Iterator[None]:
    """Mount a small RAM disk on a folder, which only root may do."""
    words = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(folder)]
    subprocess.run(words, check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def tally(name: str, runs: int, kinds: Sequence[str], once: Callable[[str], Counts]) -> bool:
    """Disturb runs of all kinds in turn; print the results, return whether all were correct."""
    found = Counts()
    for turn in range(runs):
        found.update(once(kinds[turn % len(kinds)]))
    counts = ", ".join(f"{what}: {n}" for what, n in sorted(found.items()) if n)
    print(f"{name}: {runs} runs; {counts}", flush=True)
    return not [what for what, n in found.items() if n and what.split(": ")[-1] not in HARMLESS]


def main() -> int:
    """Run all trials; exit code 1 if any file was incomplete or left over."""
    parser = parser_of(__doc__)
    for name, (default, what) in OPTIONS.items():
        parser.add_argument(name, type=int, default=default, help=what)
    words = parser.parse_args()
    random.seed(words.seed)
    print(describe_machine(), flush=True)
    with tempfile.TemporaryDirectory() as name:
        single = Single(Path(name), words.size)
        many = Many(Path(name), words.count, words.size)
        good = [
            tally("SIGTERM", words.terms, MESH_SUFFIXES, partial(single.kill, signal.SIGTERM)),
            tally("SIGKILL", words.kills, MESH_SUFFIXES, partial(single.kill, signal.SIGKILL)),
            tally("full disk", words.full, MESH_SUFFIXES, single.fill),
            tally("SIGTERM in checks", words.checks, MESH_SUFFIXES, single.check),
            tally("batch", words.batches, list(KILLS), many.disturb),
            tally("disk of a batch", words.disks, LIMITS, many.disturb),
        ]
    return int(not all(good))
