"""Whether a conversion stays within ``--max-memory``: peak memory of the process over the limit.

    python -m lab bounds --sizes 128 --factors 2 4
    python -m lab bounds --fields mask truncated --sizes 256 --suffixes .ply .obj -- --mesher sharp
    python -m lab bounds --fields ball wall --sizes 24 --factors 2 16

Every conversion runs in its own process, start, files and libraries included; the system reports
its peak when it has ended. The limits are the least that a refusal advises, and a share of what
``--json`` says is planned without a limit; not so of the grids with a surface nearly everywhere
(``DENSE``), which would not fit. While a limit is refused, what the refusal advises is tried. The
exit code is 1 if a peak exceeds 1.05 times its limit. Options after ``--`` go to the command.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from . import parser_of
from .forms import ball
from .processes import Taken, describe_machine, run_python, upsample_words

Values = NDArray[np.float64]
Plane = Callable[[float, Values, Values, int], Values]
ADVICE = re.compile(r"needs? (?:at least )?([\d.,]+) ([MG])B of memory")
SHARE, ALLOWED = 0.6, 1.05
TRIES = 5  # of limits that refusals advise
TINY, AMPLE = "1M", "64G"
TITLES = ("grid", "size", "factor", "file", "bound", "MB", "slabs", "planned", "peak",
          "of the bound", "s")  # fmt: skip


def sphere(x: float, y: Values, z: Values, n: int) -> Values:
    """Return a plane of distances to a ball, n samples a side."""
    return ball(x, y, z, 0, 0.4 * n)


def gyroid(x: float, y: Values, z: Values, n: int, waves: float = 4) -> Values:
    """Return roughly the distance to a gyroid of some waves a side, truncated at 3."""
    turn = 2 * np.pi * waves / n  # radians per sample
    sines, cosines = zip(*((np.sin(turn * axis), np.cos(turn * axis)) for axis in (x, y, z)))
    value = sum(sines[a] * cosines[(a + 1) % 3] for a in range(3))
    slopes = [cosines[a] * cosines[(a + 1) % 3] - sines[a - 1] * sines[a] for a in range(3)]
    slope = np.sqrt(sum(slope**2 for slope in slopes))
    return np.clip(value / (turn * np.maximum(slope, 0.5)), -3, 3)


def noise(x: float, y: Values, z: Values, n: int) -> Values:
    """Return a plane of random numbers, of a normal distribution."""
    return np.random.default_rng(int(x) + n).normal(size=(n, n))


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
DENSE: dict[str, Plane] = {
    "noise": noise,
    "checkers": lambda x, y, z, n: np.where(np.floor(x + y + z + 0.2) % 2, 2.0, -2.0),
    "steps": lambda x, y, z, n: np.rint(2 * noise(x, y, z, n)),
    "dense gyroid": lambda x, y, z, n: gyroid(x, y, z, n, waves=n / 24),
}
SPACINGS = {"noise": 4.0, "checkers": 4.0, "steps": 4.0}  # of others 1
USUAL = (*tuple(FIELDS)[:4], *DENSE)


def write_field(field: str, n: int, path: Path) -> Path:
    """Write a field of n samples along each axis as ``.npy``, plane by plane."""
    at, plane = np.arange(n) - n / 2 + 0.63, (FIELDS | DENSE)[field]
    array = np.lib.format.open_memmap(path, "w+", np.float32, (n, n, n))
    for values, x in zip(array, at):
        values[:] = plane(x, at[:, None], at[None, :], n)
    array.flush()
    return path


def advised(refusal: str) -> int:
    """Return the bytes that a refusal says to allow; 0 if it does not."""
    said = ADVICE.search(refusal)
    return int(float(said[1].replace(",", "")) * {"M": 1e6, "G": 1e9}[said[2]]) if said else 0


def run(words: Sequence[str], limit: str) -> Taken:
    """Run the command with a limit, which it may refuse."""
    return run_python([*words, "--max-memory", limit], failing=True)


def try_limit(cells: Sequence[str], words: Sequence[str], limit: int) -> Taken:
    """Run the command with a limit in bytes, and print its row."""
    taken = run(words, str(limit))
    report = {"slabs": "refused", "planned_bytes": 0} if taken.code else json.loads(taken.printed)
    row = [*cells, f"{limit / 1e6:,.0f}", str(report["slabs"]),
           f"{report['planned_bytes'] / 1e6:,.0f}", f"{taken.peak_mb:,.0f}",
           f"{taken.peak / limit:.2f}", f"{taken.seconds:.1f}"]  # fmt: skip
    print(f"| {' | '.join(row)} |", flush=True)
    return taken


def is_kept(cells: Sequence[str], words: Sequence[str], limit: int) -> bool:
    """Return whether a limit is kept; while one is refused, what is advised is tried instead."""
    for _ in range(TRIES):
        taken = try_limit(cells, words, limit)
        more = advised(taken.errors)
        if not taken.code or more <= limit:
            break
        limit = more
    return not taken.code and taken.peak <= ALLOWED * limit


def main() -> int:
    """Print the machine and a Markdown table; exit code 1 if a limit was not kept."""
    end = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    parser, kept = parser_of(__doc__), []
    parser.add_argument("--fields", nargs="+", choices=FIELDS | DENSE, default=USUAL)
    parser.add_argument("--sizes", type=int, nargs="+", default=[128, 256])
    parser.add_argument("--factors", type=int, nargs="+", default=[2, 4, 16])
    parser.add_argument("--suffixes", nargs="+", default=[".ply"], help="of the mesh files")
    given = parser.parse_args(sys.argv[1:end])
    print(f"{describe_machine()}; MB\n\n| {' | '.join(TITLES)} |\n|{' --- |' * len(TITLES)}")
    for field, size in product(given.fields, given.sizes):
        with tempfile.TemporaryDirectory() as folder:
            grid = write_field(field, size, Path(folder) / "grid.npy")
            for factor, suffix in product(given.factors, given.suffixes):
                options = ["--spacing", str(SPACINGS.get(field, 1)), "--factor", str(factor)]
                options += ["--device", "cpu", "--json", *sys.argv[end + 1 :]]
                words = upsample_words(grid, *options, target=grid.with_suffix(suffix))
                cells = [field, f"{size}^3", str(factor), suffix]
                kept.append(is_kept([*cells, "least"], words, advised(run(words, TINY).errors)))
                if field not in DENSE:
                    planned = json.loads(run(words, AMPLE).printed)["planned_bytes"]
                    kept.append(is_kept([*cells, "share"], words, int(SHARE * planned)))
    print(f"\n{kept.count(False)} of {len(kept)} limits were not kept")
    return int(not all(kept))
