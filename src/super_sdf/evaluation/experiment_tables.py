"""Tables of the experiments; in those of the paper the published results stand beside ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product

from ..options import MESHERS
from . import published
from .cases import Setting
from .field_tables import field_section
from .measuring import Measurement
from .names import (
    LABELS,
    MESHED,
    OURS,
    SHARES,
    meshed_by,
    simplified,
)
from .results import Results
from .scope import (
    BASE_SIZE,
    FACTORS,
    NOISES,
    PASSES,
    SCALES,
    SIMPLIFIED_FACTOR,
    mesher_settings,
)
from .tables import (
    BACK,
    CD,
    EDGES,
    F1,
    NC,
    SHORT,
    THERE,
    gap_closed,
    markdown,
    mean_of,
    mean_row,
    percent,
    title_of,
)
from .timing import RUNS, describe_machine

MESHER_LINES = """\
With factor 1 the field is refined by 4, but meshed at the corners of the voxels only. 1/4 and 1/16:
simplified to that share of the triangles. These, and other factors than 4, at the smallest size."""
MESHER_COLUMNS = (F1, NC, THERE, BACK, *EDGES)


def factor_section(results: Results) -> str:
    """Return the section on the factors 2 to 16, each with its own bound (Fig. 9)."""
    paths = results.scope.experiment_paths()
    rows = [
        ["1", *mean_row(LABELS["mc"], results.rows(Setting(BASE_SIZE), "mc", paths), SHORT), "-"]
    ]
    for factor in FACTORS:
        setting = Setting(BASE_SIZE, factor)
        measured = {name: results.rows(setting, name, paths) for name in ("bspline", OURS, "bound")}
        gap = percent(gap_closed(measured[OURS], measured["bspline"], measured["bound"], "f1"))
        rows += [
            [
                str(factor),
                *mean_row(LABELS[name], measured[name], SHORT),
                gap if name == OURS else "-",
            ]
            for name in measured
        ]
    titles = ["factor", "method", *(column.title for column in SHORT), "F1 gap closed"]
    table = markdown(titles, rows)
    return f"{title_of('Upscaling factors', paths)}\n\n{table}\n\n{published.FACTORS}"


def noise_section(results: Results) -> str:
    """Return the section on F1 by noise, beside the published F1 (supplement, Table 1)."""
    paths = results.scope.experiment_paths()
    rows = []
    for noise in NOISES:
        setting = Setting(BASE_SIZE, noise=noise)
        names = ("mc", "bspline", OURS)
        mine = [mean_of(results.rows(setting, name, paths), "f1") for name in names]
        theirs = published.NOISE_F1[noise]
        figures = [*mine, gain(mine[2], mine[0]), *theirs, gain(theirs[1], theirs[0])]
        rows.append([f"{100 * noise:.0f} %", *(F1.cell(figure) for figure in figures)])
    titles = ["noise", "MC", "B-spline + MC", "super-sdf", "gain on MC"]
    titles += ["*MC, published*", f"*{published.PAPER}*", "*its gain*"]
    title = title_of("Noise: F1, uniform noise in percent of half a voxel", paths)
    return f"{title}\n\n{markdown(titles, rows)}"


def iterated_section(results: Results) -> str:
    """Return the section on refining once and twice, beside the paper (supplement, Table 2)."""
    paths, rows = results.scope.experiment_paths(), []
    for passes in PASSES:
        setting = Setting(BASE_SIZE, passes=passes)
        sizes = " -> ".join(f"{BASE_SIZE * setting.factor**n}^3" for n in range(passes + 1))
        mine = mean_row(sizes, results.rows(setting, OURS, paths), SHORT)
        rows.append(mine + published_cells(published.ITERATED[passes]))
    titles = ["grids", *(column.title for column in SHORT), *published_titles()]
    return f"{title_of('Iterated', paths)}\n\n{markdown(titles, rows)}"


def scale_section(results: Results) -> str:
    """Return the section on shapes that fill a part of the grid (supplement, Table 3)."""
    paths, rows = results.scope.experiment_paths(), []
    for size in results.scope.sizes:
        for scale in SCALES:
            setting = Setting(size, scale=scale)
            names = ("mc", "bspline", OURS, "bound")
            measured = {name: results.rows(setting, name, paths) for name in names}
            gap = percent(gap_closed(measured[OURS], measured["bspline"], measured["bound"], "f1"))
            for name in names:
                other = published.SCALED.get((scale, size)) if name == OURS else None
                row = [f"{scale:g}, {size}^3", *mean_row(LABELS[name], measured[name], SHORT)]
                rows.append([*row, gap if name == OURS else "-", *published_cells(other)])
    titles = ["scale, grid", "method", *(column.title for column in SHORT), "F1 gap closed"]
    title = title_of("Scale: longest side of the shape over that of the grid", paths)
    return f"{title}\n\n{markdown([*titles, *published_titles()], rows)}"


def mesher_section(results: Results) -> str:
    """Return the section on the meshers, with our field and with the true one (the bound)."""
    paths, rows = results.scope.experiment_paths(), []
    sizes = results.scope.sizes
    for size, factor in mesher_settings(sizes):
        for mesher, method in product(MESHERS, MESHED):
            name = meshed_by(method, mesher)
            names = {name: LABELS[method]}
            if method == OURS and (size, factor) == (min(sizes), SIMPLIFIED_FACTOR):
                names |= {simplified(name, n): f"{LABELS[OURS]}, 1/{n}" for n in SHARES}
            for each, label in names.items():
                measured = results.rows(Setting(size, factor), each, paths)
                closed = f"{sum(row['closed'] for row in measured)} of {len(measured)}"
                where = [f"{size}^3, factor {factor}", mesher]
                rows.append([*where, *mean_row(label, measured, MESHER_COLUMNS), closed])
    titles = ["grid", "mesher", "method", *(column.title for column in MESHER_COLUMNS), "closed"]
    return f"{title_of('Meshers', paths)}\n\n{MESHER_LINES}\n\n{markdown(titles, rows)}"


SECTIONS = {
    "factors": factor_section,
    "noise": noise_section,
    "iterated": iterated_section,
    "scale": scale_section,
    "meshers": mesher_section,
    "fields": field_section,
}


def timing_section(timings: Mapping[int, Sequence[Measurement]]) -> str:
    """Return the section on the times of whole processes, beside the published (Table 2)."""
    rows = []
    for size, measured in timings.items():
        seconds = [row["seconds"] for row in measured]
        cells = [sum(seconds) / len(seconds), min(seconds), max(seconds)]
        peak = max(row["peak_mb"] for row in measured)
        rows.append([f"{size}^3", LABELS[OURS], *(f"{s:.2f}" for s in cells), f"{peak:.0f}"])
        for name, theirs in published.SECONDS.get(size, {}).items():
            cells = [f"{s:.2f}" for s in theirs]
            rows.append([f"{size}^3", f"*{name}, published, Thingi30*", *cells, "-"])
    titles = ["grid", "method", "mean s", "least", "most", "highest peak MB"]
    count = max(map(len, timings.values()))
    return "\n\n".join(
        [
            f"## Timings, {count} shapes",
            f"Whole processes, start and files included, one at a time, median of {RUNS}. "
            "The paper and PoNQ ran on an RTX 3080.",
            describe_machine(),
            markdown(titles, rows),
        ]
    )


def gain(one: float | None, other: float | None) -> float | None:
    """Return the difference of two figures, None if one is unknown."""
    return None if one is None or other is None else one - other


def published_titles() -> list[str]:
    """Return the titles of the columns with the paper's figures."""
    return [f"*{column.title}, paper*" for column in (CD, F1, NC)]


def published_cells(figures: tuple[float, float, float] | None) -> list[str]:
    """Return the cells with the paper's CD x1e5, F1 and NC, or dashes."""
    return ["-"] * 3 if figures is None else [f"{figure:.3f}" for figure in figures]
