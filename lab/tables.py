"""Markdown tables of measurements, of whatever kind."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from . import published
from .methods import LABELS
from .rows import Row


@dataclass(frozen=True)
class Column:
    """A column of a table: the figure that it shows, its title, scale and rounding."""

    title: str
    key: str
    scale: float = 1.0
    digits: int = 3

    def cell(self, row: Mapping[str, Any]) -> str:
        """Return the figure of a row as text, "-" if it is unknown."""
        figure = row.get(self.key)
        if figure is None or isinstance(figure, str):
            return figure or "-"
        return f"{figure * self.scale:,.{self.digits}f}"


CD, F1, NC = Column("CD x1e5", "cd", 1e5), Column("F1", "f1"), Column("NC", "nc", 1, 4)
P2S = Column("p2s x1e4", "p2s", 1e4, 2)
THERE = Column("ref to res", "p2s_there", 1e4, 2)
BACK = Column("res to ref", "p2s_back", 1e4, 2)
EF1 = Column("EF1", "ef1")
MAE = Column("field MAE x1e4", "field_mae", 1e4, 2)
TRIANGLES = Column("triangles", "faces", 1, 0)
SLIVERS = Column("slivers %", "slivers", 100, 2)
SECONDS = Column("seconds", "seconds", 1, 2)
SURFACE = (
    *(CD, Column("excess CD x1e5", "excess_cd", 1e5), F1, NC, Column("signed NC", "signed_nc")),
    *(P2S, THERE, BACK),
    *(Column("p99 x1e4", "p99", 1e4, 1), Column("max x1e4", "max", 1e4, 0)),
    *(Column("ECD x1e5", "ecd", 1e5, 2), EF1),
    *(Column("field MSE x1e6", "field_mse", 1e6), MAE, TRIANGLES),
)
EDGES = (
    *(EF1, Column("EFv", "efv"), Column("edge distance", "edge_distance")),
    *(Column("angle near", "angle_near", 1, 2), Column("angle beyond", "angle_beyond", 1, 2)),
    *(TRIANGLES, SLIVERS, Column("min angle", "min_angle", 1, 2)),
)
GAPS = {"f1": "F1", "nc": "NC", "p2s": "point to surface", "p2s_back": "result to reference"}
GAP = Column("F1 gap closed %", "gap_f1", 100, 0)
PEAK = Column("peak MB", "peak_mb", 1, 0)
SHORT, COSTS = (F1, NC), (SECONDS, PEAK)
NETWORKS = (F1, NC, THERE, BACK, EF1, MAE, GAP)
MESHERS = (F1, NC, THERE, BACK, *EDGES[:-1])
PEERS = (*MESHERS, SECONDS)
SETTINGS = (CD, F1, NC, P2S, BACK, GAP)
SIMPLIFIED = (Column("triangles left %", "left", 100, 1), TRIANGLES, THERE, BACK, SLIVERS)
DENSE = (SECONDS, PEAK, Column("time over ours", "over_seconds", 1, 1),
         Column("memory over ours", "over_peak_mb", 1, 1))  # fmt: skip
LARGE = (Column("tiles", "tiles", 1, 0), Column("band voxels", "band_voxels", 1, 0),
         Column("triangles", "triangles", 1, 0), SECONDS, PEAK)  # fmt: skip
BY_KEY = {column.key: column for column in (*SURFACE, *EDGES, SECONDS)}


def markdown(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table with its first column aligned left and the others right."""
    head = [f"| {' | '.join(titles)} |", "| --- " + "| ---: " * (len(titles) - 1) + "|"]
    return "\n".join(head + [f"| {' | '.join(row)} |" for row in rows])


def listed(
    rows: Iterable[Row], columns: Sequence[Column], words: Sequence[str] = ("method",)
) -> str:
    """Return a line for each row: some of its words, figures, and how many meshes are closed."""
    rows = list(rows)
    last = ["closed"] if any("closed" in row for row in rows) else []
    body = [
        [
            *(word_of(row, word) for word in words),
            *(column.cell(row) for column in columns),
            *(f"{row['closed']} of {row['shapes']}" if "closed" in row else "-" for _ in last),
        ]
        for row in rows
    ]
    return markdown([*words, *(column.title for column in columns), *last], body)


def wide(rows: Iterable[Row], word: str, columns: Sequence[Column]) -> str:
    """Return a line for each method or other word, with the columns of each size side by side."""
    found = {(word_of(row, word), row["size"]): row for row in rows}
    names, sizes = (list(dict.fromkeys(keys)) for keys in zip(*found))
    heads = [f"{n}^3, {c.title}" if len(columns) > 1 else f"{n}^3" for n in sizes for c in columns]
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
    """Return means of all figures over shapes, how many those are, and how many are closed."""
    means = {key: mean_of(rows, key) for key in BY_KEY}
    return {**means, "shapes": len(rows), "closed": sum(row["closed"] for row in rows)}


def gaps_closed(ours: Sequence[Row], base: Sequence[Row], bound: Sequence[Row]) -> Row:
    """Return the shares of the gap from one method to the bound that ours closes, of the means."""
    found = {}
    for key in GAPS:
        mine, start, end = (mean_of(rows, key) for rows in (ours, base, bound))
        if mine is not None and start is not None and end is not None and end != start:
            found[f"gap_{key}"] = (mine - start) / (end - start)
    return found


def surface_table(rows: Iterable[Row], size: int) -> str:
    """Return all columns of all methods at a size, the published rows below ours."""
    return listed([*rows, *published.surfaces(size)], SURFACE)
