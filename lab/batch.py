"""Test ``super-sdf batch`` on many grids, some of them broken, with kills in between.

    python -m lab batch                                # 500 grids, 16^3 to 128^3
    python -m lab batch --count 20 --sizes 12 16 24    # half a minute
    python -m lab batch --count 200 --sizes 32 48 64 --cluster local

Writes the grids, runs the batch, kills it with SIGKILL ``--kills`` times, resumes it, runs it once
more, and holds the meshes against the truth and against ``super-sdf upsample``. On a cluster of
this machine a worker is killed in the middle instead, and the same batch is timed in processes.
"""

from __future__ import annotations

import argparse
import filecmp
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import trimesh

from super_sdf.machine.resources import count_cores
from super_sdf.mesh import Mesh

from .mixed_grids import BROKEN, Placed, write_broken, write_mixed
from .processes import describe_machine
from .shapes import spread

COMMAND = [sys.executable, "-m", "super_sdf"]
FAR, MEAN = 1.0, 0.05  # voxels: largest accepted error of a vertex, and mean


@dataclass(frozen=True)
class Place:
    """A folder of grids, and the batch that converts them."""

    grids: Path
    meshes: Path
    options: Sequence[str]

    def start(self) -> subprocess.Popen[str]:
        """Start the batch."""
        words = [*COMMAND, "batch", str(self.grids), "--out", str(self.meshes), *self.options]
        return subprocess.Popen(words, stderr=subprocess.PIPE, text=True)

    def rows(self) -> list[dict[str, object]]:
        """Return the complete lines of the report."""
        report = self.meshes / "report.jsonl"
        lines = report.read_text().split("\n")[:-1] if report.exists() else []
        return [json.loads(line) for line in lines]

    def run(self) -> str:
        """Run the batch to its end; return exit code, seconds and last line."""
        start = time.perf_counter()
        return self.end(self.start(), start)

    def end(self, process: subprocess.Popen[str], start: float) -> str:
        """Wait for a batch; return exit code, seconds and last line."""
        last = process.communicate()[1].strip().splitlines()[-1:]
        return f"exit code {process.returncode}, {time.perf_counter() - start:.1f} s: {last}"

    def wait_for(self, count: int, process: subprocess.Popen[str]) -> None:
        """Wait until the report has this many lines, or the batch has ended."""
        while len(self.rows()) < count and process.poll() is None:
            time.sleep(0.02)

    def run_and_kill(self, count: int) -> str:
        """Kill the batch when the report has this many lines."""
        process = self.start()
        self.wait_for(count, process)
        process.kill()
        process.communicate()
        return f"killed after {len(self.rows())} files"

    def run_and_kill_a_worker(self, count: int) -> str:
        """Kill one worker of the batch when the report has this many lines; let it end."""
        start, process = time.perf_counter(), self.start()
        self.wait_for(count, process)
        killed = False
        for child in workers_of(process.pid)[:1]:
            child.kill()
            killed = True
        how = "a worker killed" if killed else "too late to kill a worker"
        return f"{how}; {self.end(process, start)}"


def workers_of(pid: int) -> list[psutil.Process]:
    """Return the worker processes of a batch; none if it has ended."""
    try:
        children = psutil.Process(pid).children(recursive=True)
        return [child for child in children if "spawn_main" in " ".join(child.cmdline())]
    except psutil.Error:
        return []


def is_right(path: Path, solid: Placed, spacing: float, n: int) -> bool:
    """Return whether a mesh is closed and its vertices are on the surface of the solid.

    The spacing of an .npy is inferred: of a coarse grid approximately, as the report says.
    """
    read = trimesh.load(path, process=False)
    if not Mesh(np.asarray(read.vertices), np.asarray(read.faces, np.int32)).is_closed():
        return False
    away = np.abs(solid.distance(np.asarray(read.vertices) / spacing / n)) * n
    return bool(away.max() < FAR and away.mean() < MEAN)


def count_right(place: Place, solids: Mapping[str, Placed]) -> int:
    """Count the meshes that exist and are correct."""
    rows, right = {row["out"]: row for row in place.rows()}, 0
    for name, solid in solids.items():
        target = Path(name).with_suffix(".ply")
        path, row = place.meshes / target, rows.get(target.as_posix(), {})
        if path.exists() and row.get("status") == "ok":
            right += is_right(path, solid, row["spacing"][0], row["shape"][0])
    return right


def count_named(place: Place) -> int:
    """Count the broken files whose error message names the fault."""
    reasons = {Path(row["in"]).name: row["reason"] for row in place.rows() if row["reason"]}
    return sum(text in reasons.get(name, "") for name, text in BROKEN.items())


def count_equal(place: Place, names: Sequence[str]) -> int:
    """Count the meshes that are byte for byte those of ``super-sdf upsample``."""
    single, equal = place.meshes.parent / "single.ply", 0
    for name in names:
        words = ["upsample", str(place.grids / name), str(single), "--force", "--quiet"]
        subprocess.run([*COMMAND, *words], check=True)
        made = (place.meshes / name).with_suffix(".ply")
        equal += made.exists() and filecmp.cmp(single, made, shallow=False)
    return equal


def main() -> int:
    """Print the machine and a Markdown table; exit code 1 if anything is wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=500, help="grids, broken ones not counted")
    parser.add_argument("--sizes", type=int, nargs="+", default=[16, 24, 32, 48, 64, 96, 128])
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=count_cores(), help="processes")
    parser.add_argument("--equal", type=int, default=40, help="meshes held against single runs")
    parser.add_argument("--cluster", help="local, or the address of a scheduler")
    words = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        jobs = ["--jobs", str(words.jobs)] if words.cluster in (None, "local") else []
        cluster = ["--cluster", words.cluster] if words.cluster else []
        place = Place(folder / "grids", folder / "meshes", [*jobs, *cluster])
        solids = write_mixed(place.grids, words.count, words.sizes)
        if not words.cluster:
            write_broken(place.grids / "broken")
        print(f"{describe_machine()}; {words.count} grids\n\n| | |\n| --- | --- |", flush=True)
        return report(place, solids, words)


def report(place: Place, solids: Mapping[str, Placed], words: argparse.Namespace) -> int:
    """Run and kill, and print what came of it, row by row; return 1 if anything is wrong."""
    wrong = []

    def row(name: str, value: object, wanted: object = None) -> None:
        is_wrong = wanted is not None and value != wanted
        wrong.extend([name] if is_wrong else [])
        print(f"| {name} | {value}{f' of {wanted}' if wanted is not None else ''} |", flush=True)

    total = len(solids) + (0 if words.cluster else len(BROKEN))
    if words.cluster:
        row("one run", place.run_and_kill_a_worker(len(solids) // 2))
        others = Place(place.grids, place.meshes.parent / "others", ["--jobs", str(words.jobs)])
        row("in processes", others.run())
    else:
        for kill in range(1, words.kills + 1):
            row("run", place.run_and_kill(total * kill // (words.kills + 1)))
        row("the last run", place.run())
        row("failures whose message names the fault", count_named(place), len(BROKEN))
    row("correct meshes", count_right(place, solids), len(solids))
    parts = [path for path in place.meshes.rglob("*") if path.suffix == ".part"]
    row("unfinished files left", len(parts), 0)
    row("run again", place.run())
    names = spread(sorted(solids), words.equal)
    row("equal to single runs", count_equal(place, names), len(names))
    return int(bool(wrong))
