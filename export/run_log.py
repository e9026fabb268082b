"""The logs of runs: their lines, and held-out errors against time as pictures.

    python -m export.run_log export/logs/nine-*.csv --shipped 0.01558 --out history.png

draws runs that each went on from the network of the one before on one axis of hours.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from export.arguments import Parser, positive
from super_sdf.errors import FileError

LOG_COLUMNS = ("step", "seconds", "samples", "loss", "held-out", "near", "normal", "dormant")
ERRORS = ("held-out", "near", "normal")


Log = dict[str, NDArray[np.float64]]


def append_line(path: Path, line: Sequence[float | str]) -> None:
    """Append a line to a log and print it; it may end before the errors."""
    with path.open("a", newline="") as file:
        csv.writer(file).writerow(line)
    print(" ".join(f"{name} {value}" for name, value in zip(LOG_COLUMNS, line)), flush=True)


def read_log(path: Path) -> Log:
    """Return the columns of a log, (n,) each, NaN where nothing was measured.

    A run that resumed from its checkpoint took some steps again: the later lines count.
    """
    with path.open(newline="") as file:
        rows = [row + ["nan"] * (len(LOG_COLUMNS) - len(row)) for row in csv.reader(file)]
    if not rows:
        raise FileError(f"{path} is empty: give the log.csv of a run")
    lines = np.array(rows, float)
    least_from_here = np.minimum.accumulate(lines[::-1, 0])[::-1]
    counts = np.append(lines[:-1, 0] < least_from_here[1:], True)
    return dict(zip(LOG_COLUMNS, lines[counts].T, strict=True))


def measured(log: Log) -> Log:
    """Return the lines of a log on which held-out errors stand."""
    is_measured = np.isfinite(log["held-out"])
    return {name: column[is_measured] for name, column in log.items()}


def plot_run(log: Log, path: Path) -> None:
    """Plot loss, held-out errors and dormant units of one run against minutes."""
    figure = Figure(figsize=(12, 4), layout="constrained")
    for ax, names in zip(figure.subplots(1, 3), (["loss"], ERRORS, ["dormant"])):
        for name in names:
            known = np.isfinite(log[name])
            ax.plot(log["seconds"][known] / 60, log[name][known], label=name)
        ax.set(xlabel="minutes", yscale="linear" if "dormant" in names else "log")
        ax.legend()
    figure.savefig(path, dpi=100)


def draw_history(paths: Sequence[Path], shipped: float | None) -> Figure:
    """Draw the held-out errors of consecutive runs against the hours spent on all of them."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    ax, before = figure.subplots(), 0.0
    for log in map(read_log, paths):
        lines = measured(log)
        ax.plot((before + lines["seconds"]) / 3600, lines["held-out"], marker=".")
        before += log["seconds"][-1]
        ax.axvline(before / 3600, color="0.85", zorder=0)
    if shipped is not None:
        ax.axhline(shipped, color="0.4", linestyle="--", label="the network shipped before")
        ax.legend()
    ax.set(xlabel="hours of training, all runs", ylabel="mean held-out error (voxels)")
    return figure


def main() -> None:
    """Plot consecutive runs."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="+", type=Path, help="log.csv of each run, in order")
    parser.add_argument("--shipped", type=positive, help="error to compare with, in voxels")
    parser.add_argument("--out", type=Path, required=True, help="the picture")
    options = parser.parse_args()
    with parser.one_line_errors():
        draw_history(options.logs, options.shipped).savefig(options.out, dpi=100)


if __name__ == "__main__":
    main()
