"""Kill conversions at random moments, or fill the disk, and check the files that are left.

    python -m benchmarks.kills          # 100 SIGTERM, 100 SIGKILL, 50 full, 80 checks
    python -m benchmarks.kills --terms 5 --kills 5 --full 5 --checks 5    # two minutes

Runs ``super-sdf upsample`` and ends it after a random share of its duration, or in every second run
after a random share of the time from its first file on; or limits the size of files at random. The
target must be absent or complete, a terminated run must leave no other file, and the next run must
leave nothing but the mesh. Runs with ``--check`` and ``--report``, which import native libraries on
the way, are ended by SIGTERM, too: none may go on, or say of the mesh what is not so.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from super_sdf.evaluation.timing import describe_machine

COMMAND = [sys.executable, "-m", "super_sdf"]
SUFFIXES = (".ply", ".stl", ".obj", ".glb", ".3mf")
LONG_ENOUGH = 120.0  # seconds; every run is shorter
AT_ONCE = 0.5  # seconds in which a run ends that was about to end anyway


def write_ball(path: Path, size: int) -> None:
    """Write the grid of a ball, with ``size`` samples along each axis."""
    ijk = np.indices((size,) * 3, dtype=np.float32)
    distance = np.linalg.norm(ijk - np.float32(size / 2 - 0.4), axis=0) - size / 3
    np.save(path, distance.astype(np.float32))


class Bench:
    """A folder with a grid, and the meshes of undisturbed runs in every format."""

    def __init__(self, folder: Path, size: int) -> None:
        self.folder, self.grid = folder / "out", folder / "grid.npy"
        self.folder.mkdir()
        write_ball(self.grid, size)
        self.whole: dict[str, bytes] = {}
        self.seconds: dict[str, float] = {}
        self.writing: dict[str, float] = {}  # the seconds of these from the first file on
        self.turn = 0
        for suffix in SUFFIXES:
            start = time.perf_counter()
            process = self.start(suffix)
            self.wait_for_file(process)
            begun = time.perf_counter()
            process.wait(LONG_ENOUGH)
            self.seconds[suffix] = time.perf_counter() - start
            self.writing[suffix] = time.perf_counter() - begun
            self.whole[suffix] = self.target(suffix).read_bytes()
            self.target(suffix).unlink()
        self.page = folder / "page.html"
        start = time.perf_counter()
        self.start(".ply", None, *self.checked()).wait(LONG_ENOUGH)
        self.checking = time.perf_counter() - start
        self.target(".ply").unlink()

    def checked(self) -> tuple[str, ...]:
        """Return the options of a run that checks the mesh and writes a page of it."""
        return "--check", "--report", str(self.page)

    def target(self, suffix: str) -> Path:
        """Return the path of the mesh."""
        return self.folder / f"ball{suffix}"

    def start(
        self, suffix: str, before: Callable[[], None] | None = None, *more: str
    ) -> subprocess.Popen[bytes]:
        """Start a run."""
        options = ["--quality", "fast", "--quiet", "--force", *more]
        words = [*COMMAND, "upsample", str(self.grid), str(self.target(suffix)), *options]
        return subprocess.Popen(words, stderr=subprocess.PIPE, preexec_fn=before)

    def wait_for_file(self, process: subprocess.Popen[bytes]) -> None:
        """Wait until a run has created a file, or ended."""
        while process.poll() is None and not os.listdir(self.folder):
            time.sleep(0.001)

    def faults(self, suffix: str) -> Counter[str]:
        """Count the files that a disturbed run should not have left, then complete another run."""
        target, found = self.target(suffix), Counter[str]()
        if target.exists():
            found["whole"] += 1
            found["HALF-WRITTEN"] += target.read_bytes() != self.whole[suffix]
        found["left beside"] += bool(set(os.listdir(self.folder)) - {target.name})
        self.start(suffix).wait(LONG_ENOUGH)
        found["LEFT AFTER THE NEXT RUN"] += os.listdir(self.folder) != [target.name]
        found["WRONG AFTER THE NEXT RUN"] += target.read_bytes() != self.whole[suffix]
        target.unlink()
        return found

    def kill(self, number: signal.Signals, suffix: str) -> Counter[str]:
        """End a run by a signal at a random moment."""
        process = self.start(suffix)
        self.turn += 1
        if self.turn % 2:
            self.wait_for_file(process)
        seconds = self.writing if self.turn % 2 else self.seconds
        time.sleep(random.uniform(0, 1.05) * seconds[suffix])
        process.send_signal(number)
        _, output = process.communicate(timeout=LONG_ENOUGH)
        codes = (0, 128 + number, -number)  # the last: before Python, or it, could do anything
        return self.faults(suffix) + Counter(
            {
                "exit codes of others": process.returncode not in codes,
                "more than one line printed": output.count(b"\n") > 1,
            }
        )

    def check(self, suffix: str) -> Counter[str]:
        """End a run that checks the mesh at a random moment."""
        process, target = self.start(suffix, None, *self.checked()), self.target(suffix)
        time.sleep(random.uniform(0, 1) * self.checking)
        process.send_signal(signal.SIGTERM)
        sent = time.perf_counter()
        _, output = process.communicate(timeout=LONG_ENOUGH)
        went_on = process.returncode == 0 and time.perf_counter() - sent > AT_ONCE
        false = b"nothing was written" in output and target.exists()
        false |= b"is written" in output and not target.exists()
        target.unlink(missing_ok=True)
        return Counter(
            {
                "whole": process.returncode == 0 and not went_on,
                "went on": went_on,
                "exit codes of others": process.returncode not in (0, 143, -15),
                "more than one line printed": output.count(b"\n") > 1,
                "said what is not so": false,
                "left beside": bool(os.listdir(self.folder)),
            }
        )

    def fill(self, suffix: str) -> Counter[str]:
        """Limit the size of files at random."""
        most = random.randrange(len(self.whole[suffix]) + 1)
        limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (most, most))
        process = self.start(suffix, limit)
        _, output = process.communicate(timeout=LONG_ENOUGH)
        return self.faults(suffix) + Counter(
            {
                "exit codes of others": process.returncode not in (0, 1),
                "more than one line printed": output.count(b"\n") > 1,
            }
        )


def tally(name: str, runs: int, once: Callable[[str], Counter[str]]) -> bool:
    """Disturb runs of all formats in turn; print the results, return whether all were correct."""
    found = Counter[str]()
    for turn in range(runs):
        found.update(once(SUFFIXES[turn % len(SUFFIXES)]))
    counts = ", ".join(f"{what}: {found[what]}" for what in sorted(found))
    print(f"{name}: {runs} runs; {counts}", flush=True)
    bad = [what for what in found if what not in ("whole", "left beside") and found[what]]
    return not bad and not (name.startswith("SIGTERM") and found["left beside"])


def main() -> None:
    """Run all trials; exit code 1 if any file was incomplete or left over."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--terms", type=int, default=100, help="Runs ended by SIGTERM.")
    parser.add_argument("--kills", type=int, default=100, help="Runs ended by SIGKILL.")
    parser.add_argument("--full", type=int, default=50, help="Runs on a disk that fills.")
    parser.add_argument("--checks", type=int, default=80, help="Runs with --check and --report.")
    parser.add_argument("--size", type=int, default=24, help="Samples along each axis.")
    parser.add_argument("--seed", type=int, default=0, help="Of the random moments.")
    arguments = parser.parse_args()
    random.seed(arguments.seed)
    print(describe_machine())
    folder = Path(tempfile.mkdtemp())
    try:
        bench = Bench(folder, arguments.size)
        good = [
            tally("SIGTERM", arguments.terms, partial(bench.kill, signal.SIGTERM)),
            tally("SIGKILL", arguments.kills, partial(bench.kill, signal.SIGKILL)),
            tally("full disk", arguments.full, bench.fill),
            tally("SIGTERM in checks", arguments.checks, bench.check),
        ]
    finally:
        shutil.rmtree(folder)
    sys.exit(0 if all(good) else 1)


if __name__ == "__main__":
    main()
