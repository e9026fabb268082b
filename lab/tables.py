"""Markdown tables of measurements, of whatever kind."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from . import published
from .methods import LABELS
from .metrics import METRICS, Column, shown_in
from .rows import Row

SECONDS, PEAK = METRICS["seconds"], Column("peak_mb", "peak MB", digits=0)
COSTS = (SECONDS, PEAK)
DENSE = (*COSTS, Column("over_seconds", "time over ours", digits=1),
         Column("over_peak_mb", "memory over ours", digits=1))  # fmt: skip
LARGE = (Column("tiles", "tiles", digits=0), Column("band_voxels", "band voxels", digits=0),
         Column("triangles", "triangles", digits=0), *COSTS)  # fmt: skip
OF_MASKS = (Column("voxels"), Column("bias"), Column("volume", digits=2))
MASKS = (Column("faces", "triangles", digits=0), Column("closed", "closed"),
         Column("seconds", "ms", 1000, 1))  # fmt: skip
GAPS = (Column("count", "number", digits=0),
        *(Column(f"gap_{metric.key}", f"{metric.gap} %", 100, 1)
          for metric in METRICS.values() if metric.gap))  # fmt: skip
WALLS = (Column("voxels", "distance"), Column("most", "worst label"), Column("bias", "bias"),
         Column("gaps", "gaps %", 100), Column("overlaps", "overlaps %", 100), *MASKS[:1],
         Column("open", "open edges", digits=0), Column("megabytes", "MB", digits=1),
         MASKS[2])  # fmt: skip


def markdown(titles: Sequence[str], rows: Iterable[Sequence[str]], align: str = "---:") -> str:
    """Return a table with its first column aligned left and the others right."""
    head = [f"| {' | '.join(titles)} |", "| --- " + f"| {align} " * (len(titles) - 1) + "|"]
    return "\n".join(head + [f"| {' | '.join(row)} |" for row in rows])


def listed(
    rows: Iterable[Row], columns: Sequence[Column], words: Sequence[str] = ("method",)
) -> str:
    """Return a line for each row: some of its words, and figures."""
    body = [[*(word_of(row, word) for word in words), *(column.cell(row) for column in columns)]
            for row in rows]  # fmt: skip
    return markdown([*words, *(column.title for column in columns)], body)


def meanings(tables: str, but: str = "") -> str:
    """Return what the metrics of some tables mean, but those that others have too."""
    metrics = [metric for metric in shown_in(tables) if metric not in shown_in(but)]
    rows = [(metric.title, metric.better, metric.meaning) for metric in metrics]
    return markdown(("figure", "better", "meaning"), rows, "---")


def wide(rows: Iterable[Row], word: str, columns: Sequence[Column], across: str = "size") -> str:
    """Return a line for each method or other word, with the columns of each size side by side."""
    found = {(word_of(row, word), word_of(row, across)): row for row in rows}
    names, sizes = (list(dict.fromkeys(keys)) for keys in zip(*found))
    heads = [f"{n}, {c.title}" if len(columns) > 1 else n for n in sizes for c in columns]
    body = [[name, *(c.cell(found.get((name, n), {})) for n in sizes for c in columns)]
            for name in names]  # fmt: skip
    return markdown([word, *heads], body)


def word_of(row: Row, key: str) -> str:
    value = row.get(key, "-")
    shown = label_of(value) if key == "method" else f"{value}^3" if key == "size" else f"{value}"
    return f"`{shown}`" if shown.startswith("--") else shown


def label_of(method: str) -> str:
    """Return what tables call a method: of ``ours-marching@fast`` super-sdf, marching, fast."""
    if method.startswith("*"):
        return method
    name, _, model = method.partition("@")
    name, _, share = name.partition("/")
    plain = name if name in LABELS else name.partition("-")[0]
    words = [LABELS.get(plain, plain), name[len(plain) + 1 :], model.replace(":", ", ")]
    if share:
        words.append(f"1/{share}" if share.isdigit() else f"as many triangles as {LABELS[share]}")
    return ", ".join(filter(None, words))


def mean_of(rows: Sequence[Row], key: str) -> float | None:
    figures = [row[key] for row in rows if row.get(key) is not None]
    return float(np.mean(figures)) if figures else None


def summary(rows: Sequence[Row]) -> Row:
    """Return the means of the shown metrics over shapes, how many those are, and the counts."""
    known = [m for m in METRICS.values() if m.tables and any(m.key in row for row in rows)]
    counts = {m.key: sum(row[m.key] for row in rows) for m in known if m.counted}
    return {**{m.key: mean_of(rows, m.key) for m in known}, "shapes": len(rows), **counts}


def gaps_closed(ours: Sequence[Row], base: Sequence[Row], bound: Sequence[Row]) -> Row:
    """Return the shares of the gap from one method to the bound that ours closes, of the means."""
    found = {}
    for key in (metric.key for metric in METRICS.values() if metric.gap):
        mine, start, end = (mean_of(rows, key) for rows in (ours, base, bound))
        if mine is not None and start is not None and end is not None and end != start:
            found[f"gap_{key}"] = (mine - start) / (end - start)
    return found


def surface_table(rows: Iterable[Row], size: int) -> str:
    """Return all columns of all methods at a size, the published rows below ours."""
    return listed([*rows, *published.surfaces(size)], shown_in("surface"))
