"""Test ``super-sdf batch --cluster local``: a worker killed in the middle, and the cost per file.

    python -m benchmarks.cluster                              # 200 grids, 32^3 to 64^3
    python -m benchmarks.cluster --count 10 --sizes 12 16 --runs 1

Writes the grids, converts them on a Dask cluster of this machine, kills one of its workers with
SIGKILL when half of them are done, and holds every mesh against that of ``super-sdf upsample``.
Then it converts them on the cluster and in as many processes, in turn, and prints the medians:
seconds per file while all workers are at work, and seconds in all, start and end included.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from subprocess import Popen

import psutil

from super_sdf.batch.inputs import find_jobs
from super_sdf.batch.job import Job
from super_sdf.batch.lock import FolderLock
from super_sdf.batch.plan import Batch, Settings
from super_sdf.batch.run import Run
from super_sdf.convert import ConvertOptions
from super_sdf.evaluation.timing import describe_machine

from .batch import Place, count_equal, count_right, working_folder
from .mixed_grids import Placed, write_mixed

ON_CLUSTER = ("--cluster", "local")
MARGIN = 0.1  # of the files at the beginning and at the end, which do not count for the pace


def kill_a_worker(batch: Popen[str]) -> str:
    """Kill a worker process of a batch with SIGKILL; return what happened."""
    try:
        children = psutil.Process(batch.pid).children(recursive=True)
        workers = [child for child in children if "spawn_main" in " ".join(child.cmdline())]
        workers[0].kill()
    except (IndexError, psutil.NoSuchProcess):
        return "too late to kill a worker"
    return "a worker killed in the middle"


def run_with_a_kill(place: Place, count: int) -> str:
    """Run a batch, and kill a worker in the middle; return a row with exit code and last line."""
    batch = place.start()
    while len(place.lines()) < count // 2 and batch.poll() is None:
        time.sleep(0.01)
    what = kill_a_worker(batch)
    _, output = batch.communicate()
    return f"| {what} | exit code {batch.returncode}: {output.strip().splitlines()[-1]} |"


def time_batch(jobs: list[Job], cluster: str | None, workers: int) -> tuple[float, float]:
    """Return the seconds per file in the middle of a batch, and those in all."""
    times: list[float] = []

    def take(batch: Batch) -> None:
        times.append(batch.seconds)

    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(Path(folder), workers=workers, cluster=cluster)
        with FolderLock(settings.folder) as lock:
            Run(jobs, settings, lock).complete(take)
    seconds = time.perf_counter() - start
    first = int(MARGIN * len(times))
    last = len(times) - 1 - first
    return (times[last] - times[first]) / max(1, last - first), seconds


def compare(jobs: list[Job], workers: int, runs: int) -> dict[str, tuple[float, float]]:
    """Return the medians of alternating runs: seconds per file, and in all."""
    kinds: dict[str, str | None] = {"processes": None, "cluster": "local"}
    found: dict[str, list[tuple[float, float]]] = {kind: [] for kind in kinds}
    for _ in range(runs):
        for kind, cluster in kinds.items():
            found[kind].append(time_batch(jobs, cluster, workers))
            print(f"{kind}: {found[kind][-1]}", file=sys.stderr, flush=True)
    return {
        kind: (median(pace for pace, _ in times), median(seconds for _, seconds in times))
        for kind, times in found.items()
    }


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=200, help="grids")
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 48, 64])
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--runs", type=int, default=5, help="timed runs of each; 0: none")
    parser.add_argument("--no-kill", action="store_true", help="time only")
    parser.add_argument("--folder", type=Path, help="to work in, and to leave as it is at the end")
    return parser.parse_args()


def report_kill(place: Place, solids: dict[str, Placed]) -> None:
    """Print what a batch with a killed worker made."""
    print(run_with_a_kill(place, len(solids)))
    print(f"| right meshes | {count_right(place, solids)} of {len(solids)} |")
    equal = count_equal(place, sorted(solids))
    print(f"| byte for byte those of upsample | {equal} of {len(solids)} |")
    parts = [path for path in place.meshes.rglob("*") if path.suffix == ".part"]
    print(f"| unfinished files left | {len(parts)} |", flush=True)


def main() -> None:
    """Print the machine and a Markdown table."""
    arguments = parse()
    with working_folder(arguments.folder) as folder:
        place = Place(folder / "grids", folder / "meshes", arguments.workers, ON_CLUSTER)
        solids = write_mixed(place.grids, arguments.count, arguments.sizes)
        print(f"{describe_machine()}; {len(solids)} files; {arguments.workers} workers\n")
        print("| | |\n| --- | --- |", flush=True)
        if not arguments.no_kill:
            report_kill(place, solids)
        if arguments.runs:
            jobs = find_jobs([str(place.grids)], ".ply", ConvertOptions()).jobs
            report_times(compare(jobs, arguments.workers, arguments.runs))


def report_times(found: dict[str, tuple[float, float]]) -> None:
    """Print the medians of processes and cluster, and how much longer the cluster takes."""
    (pace, seconds), (cluster_pace, cluster_seconds) = found["processes"], found["cluster"]
    more = 100 * (cluster_pace / pace - 1)
    print(f"| a file | {1e3 * cluster_pace:.1f} ms for {1e3 * pace:.1f} ms: {more:+.1f} % |")
    print(f"| in all | {cluster_seconds:.1f} s for {seconds:.1f} s |")


if __name__ == "__main__":
    main()
