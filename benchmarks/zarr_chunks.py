"""Zarr arrays in chunks of several shapes: time and memory against the .npy of the same grid.

    python -m benchmarks.zarr_chunks --size 512 --max-memory 2G [--layouts cubes sharded] [-- ...]

Whole processes, start and files included; the grid is that of ``benchmarks.large``. The mesh must
be the same file for every layout: compare its digests. Options after ``--`` are passed to the
command.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from benchmarks.commands import run_command
from benchmarks.large import write_torus
from benchmarks.options import parse
from super_sdf.errors import SuperSdfError
from super_sdf.evaluation.timing import describe_machine

BLOCK = 64


def layouts(n: int) -> dict[str, dict[str, Any]]:
    """Return how an array of n^3 samples is stored, by name."""
    return {
        "cubes": {"chunks": (BLOCK,) * 3},
        "cubes, Zarr 2": {"chunks": (BLOCK,) * 3, "zarr_format": 2},
        "first axis whole": {"chunks": (n, n, 1)},
        "last axis whole": {"chunks": (1, n, n)},
        "sharded": {"chunks": (BLOCK // 2,) * 3, "shards": (4 * BLOCK,) * 3},
        "one chunk": {"chunks": (n, n, n)},
    }


def store(grid: Path, path: Path, layout: dict[str, Any]) -> None:
    """Write the grid (x, y, z) as a Zarr array (z, y, x)."""
    values = np.load(grid, mmap_mode="r").T
    array = zarr.create_array(path, shape=values.shape, dtype=values.dtype, **layout)
    whole = layout.get("shards", layout["chunks"])
    step = max(BLOCK, whole[0])
    for first in range(0, len(values), step):
        array[first : first + step] = values[first : first + step]


def row(name: str, layout: dict[str, Any], grid: Path, bound: str, options: list[str]) -> str:
    """Convert a grid; return a row of the table."""
    target = grid.parent / "mesh.ply"
    words = ["upsample", str(grid), str(target), "--force", "--json", "-q"]
    shape = " x ".join(map(str, layout.get("chunks", ())))
    shape += f" in {' x '.join(map(str, layout['shards']))}" if "shards" in layout else ""
    try:
        taken = run_command([*words, "--max-memory", bound, *options])
    except SuperSdfError:  # the command has printed why
        return f"| {name} | {shape} | {bound} | refused |" + " |" * 4
    report = json.loads(taken.printed)
    digest = hashlib.sha256(target.read_bytes()).hexdigest()[:8]
    return (
        f"| {name} | {shape} | {bound} | {report['seconds']['read']:.1f} | {taken.cpu:.1f} | "
        f"{taken.peak / 1e6:,.0f} | {report['slabs']} | {digest} |"
    )


def main() -> None:
    """Print the machine and a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size", type=int, default=512, help="samples along each axis")
    parser.add_argument("--max-memory", nargs="+", default=["2G"], help="bounds to try")
    parser.add_argument("--layouts", nargs="+", choices=[*layouts(1)], help="default: all")
    arguments, options = parse(parser)
    print(f"{describe_machine()}\n")
    print(
        "| stored | chunks | bound | s to read | CPU s in all | peak MB | slabs | file |\n"
        "| --- | --- |" + " ---: |" * 5 + " --- |"
    )
    with tempfile.TemporaryDirectory(dir="/var/tmp") as name:
        grid = write_torus(Path(name, "torus.npy"), arguments.size)
        options = ["--spacing", str(1 / arguments.size), *options]
        for bound in arguments.max_memory:
            print(row(".npy", {}, grid, bound, options), flush=True)
        for kind, layout in layouts(arguments.size).items():
            if arguments.layouts and kind not in arguments.layouts:
                continue
            path = Path(name, f"{kind.replace(' ', '-').replace(',', '')}.zarr")
            store(grid, path, layout)
            for bound in arguments.max_memory:
                print(row(kind, layout, path, bound, options), flush=True)


if __name__ == "__main__":
    main()
