"""Plots: quality by resolution, and its distribution over the shapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from .drawing import write_picture
from .methods import FLOOR, LABELS, OURS
from .rows import Row
from .tables import mean_of

BySize = Mapping[int, Mapping[str, Sequence[Row]]]
"""Measurements by size of the grid and method."""

# The methods that are drawn, in colours that the colour-blind can tell apart (Okabe and Ito).
# Lewiner's table would hide the other marching cubes.
COLOURS = {
    "mc": "#777777",
    "trilinear": "#56b4e9",
    "bspline": "#0072b2",
    OURS: "#d55e00",
    "bound": "#009e73",
    FLOOR: "#000000",
}
MEASURES = {
    "p2s": "mean point to surface (box diagonal 1)",
    "f1": "F1 at 0.003",
    "nc": "normal consistency",
}


def draw_plots(by_size: BySize, folder: Path) -> dict[str, str]:
    """Draw all plots into a folder; return their titles by file name."""
    folder.mkdir(exist_ok=True)
    drawn = {size: {m: rows for m, rows in found.items() if m in COLOURS}
             for size, found in by_size.items()}  # fmt: skip
    write_picture(draw_resolution(drawn), folder / "resolution.png")
    write_picture(draw_distribution(drawn), folder / "distribution.png")
    return {"resolution.png": "Quality against resolution",
            "distribution.png": "F1 of every shape, sorted"}  # fmt: skip


def draw_resolution(by_size: BySize) -> Figure:
    """Draw the mean of each measure against the size of the grid."""
    figure, axes = make_axes(len(MEASURES))
    sizes = list(by_size)
    for ax, (key, title) in zip(axes, MEASURES.items()):
        for method in by_size[sizes[0]]:
            means = [mean_of(by_size[size][method], key) for size in sizes]
            if key != "p2s" or method != FLOOR:  # 0, which a logarithmic axis cannot show
                ax.plot(sizes, means, "o-", color=COLOURS[method], label=LABELS[method])
        ax.set(xscale="log", xlabel="samples along an axis", title=title)
        ax.set_xticks(sizes, [str(size) for size in sizes])
        ax.minorticks_off()
    axes[0].set_yscale("log")
    return with_legend(figure, axes[1])


def draw_distribution(by_size: BySize) -> Figure:
    """Draw the F1 of every shape, worst first, with a curve for each method."""
    figure, axes = make_axes(len(by_size))
    for ax, (size, by_method) in zip(axes, by_size.items()):
        for method, rows in by_method.items():
            figures = sorted(row["f1"] for row in rows)
            numbers = range(1, len(figures) + 1)
            ax.plot(numbers, figures, color=COLOURS[method], label=LABELS[method])
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        ax.set(xlabel="shapes, worst first", ylabel="F1 at 0.003", title=f"{size}^3", ylim=(0, 1))
    return with_legend(figure, axes[0])


def make_axes(count: int) -> tuple[Figure, Sequence[Any]]:
    """Return a figure with ``count`` plots side by side, and their axes."""
    figure = Figure(figsize=(max(4.2 * count, 7), 5.2), dpi=110, layout="constrained")
    axes = figure.subplots(1, count, squeeze=False)[0]
    for ax in axes:
        ax.grid(alpha=0.3)
    return figure, axes


def with_legend(figure: Figure, ax: Any) -> Figure:
    """Put one legend below all plots of a figure; return the figure."""
    handles = ax.get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=3, frameon=False)
    return figure
