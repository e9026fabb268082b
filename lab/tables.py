"""Markdown tables of measurements, of whatever kind."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
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

    def cell(self, figure: Any) -> str:
        """Return a figure as text, "-" if it is unknown."""
        if figure is None or isinstance(figure, str):
            return figure or "-"
        return f"{figure * self.scale:,.{self.digits}f}"


CD, F1, NC = Column("CD x1e5", "cd", 1e5), Column("F1", "f1"), Column("NC", "nc", 1, 4)
P2S = Column("p2s x1e4", "p2s", 1e4, 2)
THERE = Column("ref to res", "p2s_there", 1e4, 2)
BACK = Column("res to ref", "p2s_back", 1e4, 2)
EF1 = Column("EF1", "ef1")
TRIANGLES = Column("triangles", "faces", 1, 0)
SURFACE = (
    *(CD, Column("excess CD x1e5", "excess_cd", 1e5), F1, NC, Column("signed NC", "signed_nc")),
    *(P2S, THERE, BACK),
    *(Column("p99 x1e4", "p99", 1e4, 1), Column("max x1e4", "max", 1e4, 0)),
    *(Column("ECD x1e5", "ecd", 1e5, 2), EF1),
    *(Column("field MSE x1e6", "field_mse", 1e6), Column("field MAE x1e4", "field_mae", 1e4, 2)),
    TRIANGLES,
)
EDGES = (
    *(EF1, Column("EFv", "efv"), Column("edge distance", "edge_distance")),
    *(Column("angle near", "angle_near", 1, 2), Column("angle beyond", "angle_beyond", 1, 2)),
    *(TRIANGLES, Column("slivers %", "slivers", 100, 2), Column("min angle", "min_angle", 1, 2)),
)
COST = (Column("mean s", "seconds", 1, 2),)
GAPS = {  # the last is one-sided: lost thin parts do not count
    **{"f1": "F1", "nc": "NC", "p2s": "point to surface"},
    "p2s_back": "result to reference",
}
BY_KEY = {column.key: column for column in (*SURFACE, *EDGES)}


def markdown(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table with its first column aligned left and the others right."""
    head = [f"| {' | '.join(titles)} |", "| --- " + "| ---: " * (len(titles) - 1) + "|"]
    return "\n".join(head + [f"| {' | '.join(row)} |" for row in rows])


def mean_of(rows: Sequence[Row], key: str) -> float | None:
    """Return the mean of a figure over the rows that have it; of ``..._max`` the maximum."""
    name = key.removesuffix("_max")
    figures = [row[name] for row in rows if row.get(name) is not None]
    if not figures:
        return None
    return float(max(figures) if key.endswith("_max") else np.mean(figures))


def cells(figures: Mapping[str, Any], columns: Sequence[Column]) -> list[str]:
    """Return the cells of figures by key."""
    return [column.cell(figures.get(column.key)) for column in columns]


def summary(rows: Sequence[Row]) -> Row:
    """Return means of all figures over shapes, how many those are, and how many are closed."""
    columns = [*BY_KEY.values(), *COST]
    found = {column.key: mean_of(rows, column.key) for column in columns}
    return {**found, "shapes": len(rows), "closed": sum(row["closed"] for row in rows)}


def method_of(row: Row) -> list[str]:
    """Return what tables call the method of a row."""
    return [label_of(row["method"])]


def listed(
    rows: Iterable[Row],
    columns: Sequence[Column],
    words: Callable[[Row], list[str]] = method_of,
    heads: Sequence[str] = ("method",),
) -> str:
    """Return a line for each row: words under ``heads``, figures, and how many are closed."""
    body, last = [], []
    for row in rows:
        last = ["closed"] if "closed" in row else []
        body.append([*words(row), *cells(row, columns), *(closed_of(row) for _ in last)])
    return markdown([*heads, *(column.title for column in columns), *last], body)


def closed_of(row: Row) -> str:
    """Return how many meshes are closed."""
    return f"{row['closed']:d} of {row.get('shapes', row.get('grids', 1))}"


def surface_table(
    rows: Iterable[Row], size: int, words: Callable[[Row], list[str]] = method_of
) -> str:
    """Return all columns of all methods at a size, the published rows below ours."""
    published = (f"| {' | '.join([*row, '-'])} |" for row in published_rows(size, SURFACE))
    return "\n".join([listed(rows, SURFACE, words), *published])


def published_rows(size: int, columns: Sequence[Column]) -> list[list[str]]:
    """Return the published rows of a size, marked as such; "-" where a figure is not given."""
    rows = []
    for name, (cd, f1, nc) in published.SURFACES.get(size, {}).items():
        mse, mae = published.FIELDS[size].get(name, (None, None))
        given = {"cd": cd * 1e-5, "f1": f1, "nc": nc, "field_mse": mse, "field_mae": mae}
        rows.append([f"*{name}, published, Thingi30*", *cells(given, columns)])
    return rows


def label_of(method: str) -> str:
    """Return what tables call a method: of ``ours-marching@fast`` super-sdf, marching, fast."""
    name, _, model = method.partition("@")
    name, _, share = name.partition("/")
    plain = name if name in LABELS else name.partition("-")[0]
    words, mesher = [LABELS.get(plain, plain)], name[len(plain) + 1 :]
    words += [mesher] if mesher else []
    words += [model.replace(":", ", ")] if model else []
    if share:
        words.append(f"1/{share}" if share.isdigit() else f"as many triangles as {LABELS[share]}")
    return ", ".join(words)


def gap_closed(
    ours: Sequence[Row], base: Sequence[Row], bound: Sequence[Row], key: str
) -> float | None:
    """Return the share of the gap from B-spline to the bound that ours closes, of the means."""
    mine, start, end = (mean_of(rows, key) for rows in (ours, base, bound))
    if mine is None or start is None or end is None or end == start:
        return None
    return (mine - start) / (end - start)


def percent(share: float | None, digits: int = 0) -> str:
    """Return a share as text in percent, "-" if it is unknown."""
    return "-" if share is None else f"{100 * share:.{digits}f} %"
