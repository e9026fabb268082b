"""Test ``super-sdf batch`` on many grids, some of them broken, with kills in between.

    python -m benchmarks.batch                                # 500 grids, 16^3 to 128^3
    python -m benchmarks.batch --count 20 --sizes 12 16 24    # half a minute
    python -m benchmarks.batch --count 8 --sizes 8 12 16 --faults 200 --full 50

Writes the grids, runs ``super-sdf batch``, kills it with SIGKILL ``--kills`` times, resumes it,
runs it once more, and prints the results and the overhead per file over the warm pipeline. With
``--faults`` the batch or one of its workers is instead killed or terminated at random moments, one
fault per trial; with ``--full`` the disk fills up (a RAM disk, which only root may mount).
"""

from __future__ import annotations

import argparse
import filecmp
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

import numpy as np
import trimesh

from super_sdf.batch.inputs import find_jobs
from super_sdf.batch.job import Job
from super_sdf.batch.lock import FolderLock
from super_sdf.batch.plan import Batch, Settings
from super_sdf.batch.run import Run
from super_sdf.convert import ConvertOptions, convert
from super_sdf.evaluation.timing import describe_machine
from super_sdf.machine.threads import count_cores
from super_sdf.mesh import Mesh
from super_sdf.network.network import load_network

from .batch_faults import KILLS, LIMITS, count_faults, make_setting
from .mixed_grids import BROKEN, Placed, write_broken, write_mixed

COMMAND = [sys.executable, "-m", "super_sdf"]
FAR, MEAN = 1.0, 0.05  # voxels: largest accepted error of a vertex, and mean


@dataclass(frozen=True)
class Place:
    """A folder of grids, and the batch that converts them."""

    grids: Path
    meshes: Path
    jobs: int
    options: tuple[str, ...] = ()

    def start(self) -> subprocess.Popen[str]:
        """Start the batch."""
        options = ["--out", str(self.meshes), "--jobs", str(self.jobs), *self.options]
        return subprocess.Popen(
            [*COMMAND, "batch", str(self.grids), *options], stderr=subprocess.PIPE, text=True
        )

    def lines(self) -> list[str]:
        """Return the complete lines of the report."""
        report = self.meshes / "report.jsonl"
        return report.read_text().split("\n")[:-1] if report.exists() else []

    def run(self) -> tuple[int, str, float]:
        """Run the batch to its end; return the exit code, the last line and the seconds."""
        start = time.perf_counter()
        process = self.start()
        _, output = process.communicate()
        return process.returncode, output.strip().splitlines()[-1], time.perf_counter() - start

    def run_and_kill(self, lines: int) -> None:
        """Kill the batch when the report has this many lines."""
        process = self.start()
        while len(self.lines()) < lines and process.poll() is None:
            time.sleep(0.02)
        process.kill()
        process.wait()


def is_right(path: Path, solid: Placed, spacing: float, n: int) -> bool:
    """Return whether a mesh is closed and its vertices are on the surface of the solid.

    The spacing of an .npy is inferred: of a coarse grid approximately, as the report says.
    """
    read = trimesh.load(path, process=False)
    if not Mesh(np.asarray(read.vertices), np.asarray(read.faces, np.int32)).is_closed():
        return False
    away = np.abs(solid.distance(np.asarray(read.vertices) / spacing / n)) * n
    return bool(away.max() < FAR and away.mean() < MEAN)


def count_right(place: Place, solids: dict[str, Placed]) -> int:
    """Count the meshes that exist and are correct."""
    rows, right = {row["out"]: row for row in map(json.loads, place.lines())}, 0
    for name, solid in solids.items():
        target = Path(name).with_suffix(".ply")
        path, row = place.meshes / target, rows.get(target.as_posix(), {})
        if path.exists() and row.get("status") == "ok":
            right += is_right(path, solid, row["spacing"][0], row["shape"][0])
    return right


def count_named(place: Place) -> int:
    """Count the broken files whose error message names the fault."""
    rows = {row["in"]: row for row in map(json.loads, place.lines())}
    reasons = {Path(name).name: row["reason"] for name, row in rows.items() if row["reason"]}
    return sum(text in reasons.get(name, "") for name, text in BROKEN.items())


def count_equal(place: Place, names: list[str]) -> int:
    """Count the meshes that are byte for byte those of ``super-sdf upsample``."""
    single, equal = place.meshes.parent / "single.ply", 0
    for name in names:
        words = ["upsample", str(place.grids / name), str(single), "--force", "--quiet"]
        subprocess.run([*COMMAND, *words], check=True)
        made = (place.meshes / name).with_suffix(".ply")
        equal += made.exists() and filecmp.cmp(single, made, shallow=False)
    return equal


def measure_overhead(place: Place, names: list[str], repeats: int = 3) -> tuple[float, float]:
    """Return the seconds of the warm pipeline alone and in a batch, each file's best of repeats.

    The first file is left out: with it the batch loads the network.
    """
    jobs = find_jobs([str(place.grids / name) for name in names], ".ply", ConvertOptions()).jobs
    rounds = []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            rounds.append(time_pairs(jobs, Path(folder))[1:])
    alone, batched = np.min(rounds, axis=0).sum(axis=0)
    return float(alone), float(batched)


def time_pairs(jobs: list[Job], folder: Path) -> list[tuple[float, float]]:
    """Return for each file the seconds of the pipeline alone, and from file to file in a batch.

    They are taken in turn, file by file, so that what else the machine does is the same for both.
    """
    network, pairs = load_network(), []
    clock = time.perf_counter()

    def take(batch: Batch) -> None:
        nonlocal clock
        batched, job = time.perf_counter() - clock, batch.done[-1].job
        start = time.perf_counter()
        convert(job.source, folder / f"alone-{len(pairs)}.ply", network, job.options)
        pairs.append((time.perf_counter() - start, batched))
        clock = time.perf_counter()

    with FolderLock(folder) as lock:
        Run(jobs, Settings(folder, workers=1), lock).complete(take)
    return pairs


@contextmanager
def working_folder(given: Path | None) -> Iterator[Path]:
    """Yield the given folder, or a temporary one."""
    if given:
        given.mkdir(parents=True, exist_ok=True)
        yield given
        return
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def spread(names: list[str], count: int) -> list[str]:
    """Return this many of the names, evenly spread."""
    chosen = np.linspace(0, len(names) - 1, min(count, len(names))).round().astype(int)
    return [names[i] for i in chosen]


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=500, help="grids, broken ones not counted")
    parser.add_argument("--sizes", type=int, nargs="+", default=[16, 24, 32, 48, 64, 96, 128])
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--faults", type=int, default=0, help="kills at random moments instead")
    parser.add_argument("--full", type=int, default=0, help="full disks instead")
    parser.add_argument("--seed", type=int, default=0, help="of the moments of faults")
    parser.add_argument("--jobs", type=int, default=count_cores(), help="processes")
    parser.add_argument("--equal", type=int, default=40, help="meshes held against single runs")
    parser.add_argument("--overhead", type=int, default=40, help="files timed, each three times")
    parser.add_argument("--folder", type=Path, help="to work in, and to leave as it is at the end")
    return parser.parse_args()


def main() -> None:
    """Print the machine and a Markdown table."""
    arguments = parse()
    with working_folder(arguments.folder) as folder:
        if arguments.faults or arguments.full:
            report_faults(folder, arguments)
            return
        place = Place(folder / "grids", folder / "meshes", arguments.jobs)
        solids = write_mixed(place.grids, arguments.count, arguments.sizes)
        write_broken(place.grids / "broken")
        total = arguments.count + len(BROKEN)
        print(f"{describe_machine()}; {total} files\n\n| | |\n| --- | --- |", flush=True)
        for kill in range(1, arguments.kills + 1):
            place.run_and_kill(total * kill // (arguments.kills + 1))
            print(f"| killed after | {len(place.lines())} files |", flush=True)
        report(place, solids, arguments, total)


def report_faults(folder: Path, arguments: argparse.Namespace) -> None:
    """Print the results for each kind of fault."""
    kinds = [kind for kind, _ in zip(cycle(KILLS), range(arguments.faults))]
    kinds += [kind for kind, _ in zip(cycle(LIMITS), range(arguments.full))]
    counts = count_faults(
        make_setting(folder, arguments.count, arguments.sizes), kinds, arguments.seed
    )
    print(f"{describe_machine()}; {arguments.count} files\n")
    print(
        "| fault | exit code | times | found then, and after another run |\n" + "| --- " * 4 + "|"
    )
    for (kind, code, found), count in sorted(counts.items()):
        print(f"| {kind} | {code} | {count} | {found} |")


def report(
    place: Place, solids: dict[str, Placed], arguments: argparse.Namespace, total: int
) -> None:
    """Print the results, row by row as they come."""

    def row(name: str, value: object) -> None:
        print(f"| {name} | {value} |", flush=True)

    code, output, seconds = place.run()
    row("the last run", f"exit code {code}, {seconds:.1f} s: {output}")
    row("lines in the report", f"{len(place.lines())} of {total}")
    row("right meshes", f"{count_right(place, solids)} of {arguments.count}")
    row("failures that name the fault", f"{count_named(place)} of {len(BROKEN)}")
    parts = [p for p in place.meshes.rglob("*") if p.suffix == ".part"]
    row("unfinished files left", len(parts))
    code, output, seconds = place.run()
    row("run again", f"exit code {code}, {seconds:.2f} s: {output}")
    names = spread(sorted(solids), arguments.equal)
    row("equal to single runs", f"{count_equal(place, names)} of {len(names)}")
    names = spread(sorted(solids), arguments.overhead)
    alone, batched = measure_overhead(place, names)
    share = 100 * (batched / alone - 1)
    row("over the warm pipeline", f"{batched:.2f} s for {alone:.2f} s: {share:+.1f} %")


if __name__ == "__main__":
    main()
