"""The log of a run: its lines, and loss, held-out errors and dormant units as a picture."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

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


def plot_run(log: Log, path: Path) -> None:
    figure = Figure(figsize=(12, 4), layout="constrained")
    for ax, names in zip(figure.subplots(1, 3), (["loss"], ERRORS, ["dormant"])):
        for name in names:
            known = np.isfinite(log[name])
            ax.plot(log["seconds"][known] / 60, log[name][known], label=name)
        ax.set(xlabel="minutes", yscale="linear" if "dormant" in names else "log")
        ax.legend()
    figure.savefig(path, dpi=100)
