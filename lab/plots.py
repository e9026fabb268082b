"""Plots of measured rows, as SVG files for the pages of figures; ``lab.documents`` writes them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from io import StringIO
from typing import Any

from . import published
from .metrics import METRICS
from .rows import Row
from .tables import label_of

# Each line: its colour, and how it is drawn.
STYLES = {"mc": ("#999999", "^-"), "bspline": ("#c2731d", "s-"), "ours": ("#1f5fbf", "o-"),
          "bound": ("#222222", "x:"), "default": ("#1f5fbf", "o-"), "zoom-cubic": ("#c2731d", "D-"),
          "--quality fast": ("#5b9bd5", "v-"), "--mesher marching": ("#3a8a4d", "s-")}  # fmt: skip
PEERS = {"PoNQ": "#7b4fa3", "RFTA": "#b03a48", published.PAPER: "#3a8a4d"}
TIMES = {"default": "super-sdf", "--quality fast": "super-sdf --quality fast",
         "--mesher marching": "super-sdf --mesher marching",
         "zoom-cubic": "SciPy's cubic zoom + marching cubes"}  # fmt: skip
STYLE = {"svg.fonttype": "none", "svg.hashsalt": "super-sdf", "font.size": 10, "axes.grid": True,
         "grid.alpha": 0.3, "axes.spines.top": False, "axes.spines.right": False}  # fmt: skip


def lines(
    axes: Any, rows: Iterable[Row], key: str, word: str, labels: Mapping[str, str], scale: float = 1
) -> None:
    """Draw a figure against the size of the grid, a line for each label."""
    for name, label in labels.items():
        found = sorted((row["size"], scale * row[key]) for row in rows if row.get(word) == name)
        colour, style = STYLES[name]
        axes.plot(*zip(*found), style, color=colour, label=label)


def resolutions(axes: Any, title: str, ticks: Sequence[float] = ()) -> None:
    """Label the axes, of sizes and, if there are ticks, of figures in a logarithmic scale."""
    if ticks:
        axes.set_yscale("log")
        axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xscale("log", base=2)
    axes.set_xticks([32, 64, 128], ["32³", "64³", "128³"])
    axes.minorticks_off()
    axes.set_xlabel("samples of the grid")
    axes.set_title(title, fontsize=10, loc="left")


def errors(rows: Sequence[Row], figure: Any) -> None:
    """Draw the mean distance to the true surface, and F1 beside published figures."""
    left, right = figure.subplots(1, 2)
    labels = {name: label_of(name) for name in ("mc", "bspline", "ours", "bound")}
    lines(left, rows, "p2s", "method", labels, METRICS["p2s"].scale)
    title = "Mean distance, 1e-4 box diagonals: lower is better"
    resolutions(left, title, (0.5, 1, 2, 5, 10, 20, 50))
    lines(right, rows, "f1", "method", labels)
    for name, colour in PEERS.items():
        found = [(size, some[name][1]) for size, some in published.SURFACES.items()]
        right.plot(*zip(*found), "--", color=colour, label=f"{name}, published")
    resolutions(right, "F1 within 0.003 of the diagonal: higher is better")
    right.legend(fontsize=8)


def times(rows: Sequence[Row], figure: Any) -> None:
    """Draw the seconds and the memory of whole processes."""
    left, right = figure.subplots(1, 2)
    lines(left, rows, "seconds", "option", TIMES)
    resolutions(left, "Seconds: lower is better", (0.5, 1, 2, 5, 10, 20))
    lines(right, rows, "peak_mb", "option", TIMES)
    resolutions(right, "Peak of memory, MB: lower is better", (100, 200, 400, 800))
    left.legend(fontsize=8)


PLOTS: dict[str, Callable[[Sequence[Row], Any], None]] = {"quality": errors, "speed": times}


def plot(name: str, rows: Sequence[Row]) -> str:
    """Return a plot of the rows of a figure as SVG, the same for the same rows."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9, 3.8), layout="constrained")
        PLOTS[name](rows, figure)
        file = StringIO()
        figure.savefig(file, format="svg", metadata={"Date": None})
    return file.getvalue()
