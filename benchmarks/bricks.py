"""One grid on the workers of a local cluster: time and memory, against one process.

    python -m benchmarks.bricks --size 512 --workers 1 2 4 --max-memory 4G [-- OPTIONS]

Whole processes, start and files included. The grid is that of ``benchmarks.large``, as an .npy for
one process and as a Zarr store in chunks of 64^3 for the workers, which share the memory. The mesh
must be the same file: compare its digests. What is not done by workers is what the command's own
process does: its CPU seconds. Options after ``--`` are passed to the command.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
from pathlib import Path

from benchmarks.commands import run_command
from benchmarks.large import write_torus
from benchmarks.options import parse
from benchmarks.zarr_chunks import layouts, store
from super_sdf.evaluation.timing import describe_machine


def run(grid: Path, workers: int, bound: str, options: list[str]) -> str:
    """Convert a grid, with workers unless their number is 0; return a row of the table."""
    target = grid.parent / "mesh.ply"
    words = ["upsample", str(grid), str(target), "--force", "--json", "-q"]
    words += ["--cluster", "local", "--jobs", str(workers)] if workers else []
    taken = run_command([*words, "--max-memory", bound, *options])
    report = json.loads(taken.printed)
    found = report.get("workers", [])
    peaks = ", ".join(f"{worker['peak_bytes'] / 1e6:,.0f}" for worker in found)
    each = f"{found[0]['max_memory'] / 1e6:,.0f}" if found else ""
    digest = hashlib.sha256(target.read_bytes()).hexdigest()[:8]
    return (
        f"| {grid.suffix} | {workers or 'none'} | {report.get('bricks', report['slabs'])} | "
        f"{taken.seconds:.1f} | {taken.cpu:.1f} | {taken.cpu_of_workers:.1f} | "
        f"{taken.peak / 1e6:,.0f} | {each} | {peaks} | "
        f"{digest} |"
    )


def main() -> None:
    """Print the machine and a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size", type=int, default=512, help="samples along each axis")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--max-memory", default="4G", help="of all workers together")
    arguments, options = parse(parser)
    print(f"{describe_machine()}\n")
    print(
        "| grid | workers | bricks | s | CPU s, command | CPU s, workers | peak MB, command | "
        "MB that a worker may hold | its peak | file |\n| --- |" + " ---: |" * 8 + " --- |"
    )
    with tempfile.TemporaryDirectory(dir="/var/tmp") as name:
        grid = write_torus(Path(name, "torus.npy"), arguments.size)
        options = ["--spacing", str(1 / arguments.size), *options]
        print(run(grid, 0, arguments.max_memory, options), flush=True)
        path = Path(name, "torus.zarr")
        store(grid, path, layouts(arguments.size)["cubes"])
        for workers in arguments.workers:
            print(run(path, workers, arguments.max_memory, options), flush=True)


if __name__ == "__main__":
    main()
