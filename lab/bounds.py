"""Whether a conversion stays within ``--max-memory``: peak memory of the process over the limit.

    python -m lab bounds --sizes 128 --factors 2 4
    python -m lab bounds --fields mask truncated spline scaled --sizes 256 --factors 4
    python -m lab bounds --fields --dense noise gyroid --follow
    python -m lab bounds --quick

Every conversion runs in its own process, start, files and libraries included; the system reports
its peak when it has ended. Without a limit the plan is read from ``--json``; then a share of it is
the limit, and the least that a refusal of a tiny limit advises. Grids of which most samples are
beside the surface, or cut off, have limits of their own (``DENSE``). These may be too small: then
the refusal must hold the limit, too, and with ``--follow`` what it says to allow is tried. The exit
code is 1 if a peak exceeds 1.05 times its limit.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from super_sdf.options import DEFAULT_MESHER, MESHERS

from . import parser_of
from .forms import ball
from .processes import Taken, describe_machine, run_python, upsample_words

Values = NDArray[np.float64]
Plane = Callable[[float, Values, Values, int], Values]
TURN = 2 * np.pi / 24  # radians per sample of the gyroid among the dense grids
# Shape, type, spacing and limit in bytes of grids with a surface nearly everywhere, or cut off.
DENSE = {
    "noise": ((197, 197, 197), "float32", 4, 400_000_000),
    "checkers": ((300, 300, 300), "float32", 4, 600_000_000),
    "steps": ((476, 476, 476), "int8", 100, 600_000_000),
    "dense gyroid": ((64, 768, 768), "float32", 1, 500_000_000),
    "cut off at 3": ((256, 256, 256), "float32", 1, 400_000_000),
}
ADVICE = re.compile(r"needs? (?:at least )?([\d.,]+) ([MG])B of memory")
SUFFIXES = (".ply", ".stl", ".obj")
SHARE, ALLOWED, TINY = 0.6, 1.05, "1M"
HEAD = (
    "| grid | size | factor | precision | files | bound | MB | slabs | planned | peak | "
    "of the bound | s |\n| --- | ---: | ---: |" + " --- |" * 3 + " ---: |" * 6
)


def sphere(x: float, y: Values, z: Values, n: int) -> Values:
    """Return a plane of distances to a ball, n samples a side."""
    return ball(x, y, z, 0, 0.4 * n)


def gyroid(x: float, y: Values, z: Values, n: int, turn: float = 0) -> Values:
    """Return roughly the distance to a gyroid, truncated at 3; ``turn``: radians per sample."""
    turn = turn or 8 * np.pi / n
    sines, cosines = zip(*((np.sin(turn * axis), np.cos(turn * axis)) for axis in (x, y, z)))
    value = sum(sines[a] * cosines[(a + 1) % 3] for a in range(3))
    slopes = [cosines[a] * cosines[(a + 1) % 3] - sines[a - 1] * sines[a] for a in range(3)]
    slope = np.sqrt(sum(slope**2 for slope in slopes))
    return np.clip(value / (turn * np.maximum(slope, 0.5)), -3, 3)


FIELDS: dict[str, Plane] = {
    "ball": sphere,
    "gyroid": gyroid,
    "wall": lambda x, y, z, n: np.full((n, n), abs(x) - 1.7),
    "wall across z": lambda x, y, z, n: np.broadcast_to(np.abs(z) - 1.7, (n, n)),
    "mask": lambda x, y, z, n: np.where(sphere(x, y, z, n) < 0, 1.0, 0.0),
    "truncated": lambda x, y, z, n: np.clip(sphere(x, y, z, n), -1, 1),
    "spline": lambda x, y, z, n: np.clip(sphere(x, y, z, n), -0.5, 0.5),
    "scaled": lambda x, y, z, n: sphere(x, y, z, n) * (1 + sphere(x, y, z, n) / (3 * n)),
}
USUAL = tuple(FIELDS)[:4]


def dense_plane(name: str, i: int, shape: tuple[int, ...]) -> Values:
    """Return plane ``i`` of a grid of ``DENSE``."""
    rng = np.random.default_rng(i)
    y, z = np.indices(shape[1:]).astype(np.float64)
    if name == "noise":
        return rng.normal(size=shape[1:])
    if name == "checkers":
        return ((i + y + z) % 2 * 2 - 1) * (1 + rng.random(shape[1:]))
    if name == "steps":
        return rng.integers(-100, 101, shape[1:]).astype(np.float64)
    if name == "dense gyroid":
        return gyroid(i, y, z, 0, TURN)
    n = shape[0] / 2
    return np.clip(ball(i - n, y - n, z - n, 0, 0.8 * n), -3, 3)


def write_planes(path: Path, shape: Sequence[int], dtype: str, plane: Callable[[int], Any]) -> Path:
    """Write a grid plane by plane as ``.npy``."""
    array = np.lib.format.open_memmap(path, "w+", np.dtype(dtype), tuple(shape))
    for i in range(shape[0]):
        array[i] = plane(i)
    array.flush()
    return path


def write_field(field: str, n: int, path: Path) -> Path:
    """Write a field of n samples along each axis, spacing 1."""
    at = np.arange(n) - n / 2 + 0.63
    return write_planes(path, (n, n, n), "float32",
                        lambda i: FIELDS[field](at[i], at[:, None], at[None, :], n))  # fmt: skip


def advised(refusal: str) -> int | None:
    """Return the bytes that a refusal says to allow."""
    said = ADVICE.search(refusal)
    return said and int(float(said[1].replace(",", "")) * {"M": 1e6, "G": 1e9}[said[2]])


class Trial:
    """A conversion that is tried within limits; ``over`` collects the rows of those exceeded."""

    def __init__(self, cells: list[str], grid: Path, options: list[str], suffix: str) -> None:
        self.cells = [*cells, f"{grid.suffix} to {suffix}"]
        target = grid.with_name(f"mesh{suffix}")
        self.words = upsample_words(grid, "--json", *options, target=target)
        self.over: list[str] = []

    def run(self, limit: str) -> Taken:
        """Run the command with a limit."""
        return run_python([*self.words, "--max-memory", limit], failing=True)

    def try_limit(self, name: str, limit: int) -> Taken:
        """Run the command, and print its row; a refusal has to be for lack of memory."""
        taken = self.run(str(limit))
        report = {} if taken.code else json.loads(taken.printed)
        cells = [*self.cells, name, f"{limit / 1e6:,.0f}", str(report.get("slabs", "refused"))]
        cells += [f"{report['planned_bytes'] / 1e6:,.0f}" if report else ""]
        cells += [f"{taken.peak_mb:,.0f}", f"{taken.peak / limit:.2f}", f"{taken.seconds:.1f}"]
        line = f"| {' | '.join(cells)} |"
        print(line, flush=True)
        if taken.peak > ALLOWED * limit or (taken.code and "memory" not in taken.errors):
            self.over.append(f"{line} {taken.errors}")
        return taken

    def try_plan(self, share: float, names: list[str]) -> list[str]:
        """Try a share of what the plan needs without a limit, and the least it accepts."""
        planned = json.loads(self.run("64G").printed)["planned_bytes"]
        least = advised(self.run(TINY).errors) or 0
        limits = {"share": max(int(share * planned), least), "least": least}
        for name in names:
            if self.try_limit(name, limits[name]).code:
                self.over.append(f"| {' | '.join(self.cells)} | {name}: refused |")
        return self.over


def try_dense(name: str, folder: Path, *, follow: bool) -> list[str]:
    """Try a grid of ``DENSE``, and what its refusal advises; return the rows that exceed."""
    shape, dtype, spacing, limit = DENSE[name]
    plane = partial(dense_plane, name, shape=shape)
    grid = write_planes(folder / "grid.npy", shape, dtype, plane)
    cells = [name, f"{shape[0]}^3", "4", "int8"]
    options = ["--spacing", str(spacing), "--device", "cpu", "--precision", "int8"]
    trial = Trial(cells, grid, options, ".ply")
    refusal = trial.try_limit("given", limit)
    if refusal.code and follow and trial.try_limit("advised", advised(refusal.errors) or 0).code:
        trial.over.append(f"{name}: what a refusal advises is refused")
    return trial.over


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = parser_of(__doc__)
    parser.add_argument("--fields", nargs="*", choices=FIELDS, default=USUAL)
    parser.add_argument("--dense", nargs="*", choices=DENSE, default=tuple(DENSE))
    parser.add_argument("--follow", action="store_true", help="allow what a refusal advises, too")
    parser.add_argument("--sizes", type=int, nargs="+", default=[128, 256])
    parser.add_argument("--factors", type=int, nargs="+", default=[2, 4, 16])
    parser.add_argument("--precisions", nargs="+", default=["float32", "int8"])
    parser.add_argument("--mesher", choices=MESHERS, default=DEFAULT_MESHER)
    parser.add_argument("--suffixes", nargs="+", default=SUFFIXES)
    parser.add_argument("--bounds", nargs="+", choices=["share", "least"], default=["share"])
    parser.add_argument("--share", type=float, default=SHARE)
    parser.add_argument("--quick", action="store_true", help="a few small grids, for a check")
    words = parser.parse_args()
    if words.quick:
        words.fields, words.sizes, words.factors, words.dense = ["ball", "wall"], [24], [2, 16], []
        words.suffixes, words.precisions, words.bounds = [".ply"], ["int8"], ["least"]
    return words


def main() -> int:
    """Print the machine and a Markdown table; exit code 1 if a limit was exceeded."""
    words, over = parse(), []
    print(f"{describe_machine()}; MB\n\n{HEAD}", flush=True)
    for field, size in product(words.fields, words.sizes):
        with tempfile.TemporaryDirectory() as folder:
            grid = write_field(field, size, Path(folder) / "grid.npy")
            kinds = product(words.factors, words.precisions, words.suffixes)
            for factor, precision, suffix in kinds:
                options = ["--factor", str(factor), "--precision", precision, "--device", "cpu"]
                options += ["--spacing", "1", "--mesher", words.mesher]
                cells = [field, f"{size}^3", str(factor), precision]
                over += Trial(cells, grid, options, suffix).try_plan(words.share, words.bounds)
    for field in words.dense:
        with tempfile.TemporaryDirectory() as folder:
            over += try_dense(field, Path(folder), follow=words.follow)
    print("\n".join(["\nover the bound:", *over] if over else ["\nall within the bounds"]))
    return int(bool(over))
