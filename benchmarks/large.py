"""Large grids: time, and peak memory compared with the plan, for several limits.

    python -m benchmarks.large GRID.npy --max-memory 3G 1500M 900M [-- --spacing 0.002]
    python -m benchmarks.large --analytic 512 1024 --max-memory 4G

Whole processes, start and files included. The mesh of a grid must be the same file for every limit:
compare its digests. An analytic grid is a torus of area 1.2 in the unit cube, written plane by
plane. Options after ``--`` are passed to the command.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.options import parse
from super_sdf.errors import SuperSdfError
from super_sdf.evaluation.timing import describe_machine, run_python

MAJOR, MINOR = 0.28, 0.11


def write_torus(path: Path, n: int) -> Path:
    """Write the distances to a torus at the voxel centres of the unit cube, (n, n, n) float32."""
    centres = ((np.arange(n) + 0.5) / n - 0.5).astype(np.float32)
    field = np.lib.format.open_memmap(path, "w+", np.float32, (n, n, n))
    for i, x in enumerate(centres):
        ring = np.hypot(x, centres)[:, None] - np.float32(MAJOR)
        field[i] = np.hypot(ring, centres) - np.float32(MINOR)
    field.flush()
    return path


def run(grid: Path, folder: Path, bound: str, options: list[str]) -> str:
    """Convert a grid; return a row of the table."""
    target = folder / "mesh.ply"
    words = ["-m", "super_sdf", "upsample", str(grid), str(target), "--force", "--json", "-q"]
    try:
        seconds, peak, printed = run_python([*words, "--max-memory", bound, *options])
    except SuperSdfError:  # the command has printed why
        return f"| {grid.stem} | {bound} | refused |" + " |" * 9
    report = json.loads(printed)
    planned = report["planned_bytes"] / 1e6
    digest = hashlib.sha256()
    with target.open("rb") as file:
        while block := file.read(1 << 24):
            digest.update(block)
    after = sum(report["seconds"][stage] for stage in ("nodes", "isosurface", "write"))
    file = digest.hexdigest()[:8]
    return (
        f"| {report['shape'][0]}^3 | {bound} | {report['slabs']} | {report['band_voxels']:,} | "
        f"{report['triangles']:,} | {seconds:.1f} | {after / seconds:.0%} | {peak:,.0f} | "
        f"{planned:,.0f} | {planned / peak - 1:+.0%} | {report['closed']} | {file} |"
    )


def main() -> None:
    """Print the machine and a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("grids", type=Path, nargs="*", help=".npy files")
    parser.add_argument("--analytic", type=int, nargs="*", default=[], help="sizes of a torus")
    parser.add_argument("--max-memory", nargs="+", default=["4G"], help="bounds to try")
    arguments, options = parse(parser)
    print(f"{describe_machine()}\n")
    print(
        "| grid | bound | slabs | band voxels | triangles | s | after the network | peak MB | "
        "planned MB | off by | closed | file |\n" + "| --- |" + " ---: |" * 9 + " --- | --- |"
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for grid in arguments.grids:
            for bound in arguments.max_memory:
                print(run(grid, folder, bound, options), flush=True)
        for n in arguments.analytic:
            grid = write_torus(folder / "torus.npy", n)
            for bound in arguments.max_memory:
                print(run(grid, folder, bound, ["--spacing", str(1 / n), *options]), flush=True)


if __name__ == "__main__":
    main()
