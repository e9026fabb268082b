"""What documents show of the measured figures: tables by name, and single numbers in sentences.

``TABLES`` is the list: NAME.TABLE is made from the rows of NAME.json, and only of that file, so no
table mixes two networks or machines.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from super_sdf.errors import FileError

from . import published
from .forms import FORMS
from .kinds import KIND_LABELS
from .rows import Row
from .tables import (
    BACK,
    BY_KEY,
    CD,
    EDGES,
    EF1,
    F1,
    NC,
    P2S,
    SURFACE,
    THERE,
    Column,
    cells,
    label_of,
    markdown,
    percent,
    published_rows,
)

UNKNOWN = "(not measured)"
ONE_OF = {"over": 0, "above": 1, "below": 2}
MAE = BY_KEY["field_mae"]
SHORT = (F1, NC, THERE, BACK, CD, EF1, MAE)
VOXELS = Column("mean distance", "voxels", 1, 4)
# Columns of numbers in sentences, besides those of ``tables``.
COLUMNS = {
    **BY_KEY,
    **{name: Column(name, name, 1, 0) for name in (
        "closed", "shapes", "grids", "pieces", "pieces_of_reference", "refused", "told", "slabs",
        "band_voxels", "triangles", "peak_mb", "planned_mb", "fixed_mb", "seen", "decoded",
        "above", "faces")},
    **{f"gap_{key}": Column("gap", f"gap_{key}", 100, 0) for key in ("f1", "nc", "p2s",
        "p2s_back")},
    **{name: Column(name, name, 1, 2) for name in (
        "seconds", "slowest", "vertices", "ratio", "over_seconds", "over_peak_mb")},
    **{name: Column(name, name, 1, 1) for name in ("volume", "volume_most", "us_per_voxel")},
    "voxels": VOXELS,
    "largest": Column("largest", "largest", 1, 4),
    "found": Column("found", "found", 100, 0),
}  # fmt: skip
NETWORK_LABELS = {
    "fast": "`--quality fast`",
    "noisy": "the network for noise",
    "base": "`base`, the default",
    "base-float32": "`base` in float32",
    "best": "`--quality best`",
}
EDGE_COLUMNS = (F1, NC, THERE, BACK, *EDGES[:-1])
MESHER_LABELS = {
    "marching": "`--mesher marching`",
    "sharp": "`--mesher sharp`",
    "sharp/4": "sharp, simplified to 1/4",
    "sharp/16": "sharp, simplified to 1/16",
    "sharp-2": "sharp, factor 2",
    "bound": "bound, marching",
    "bound-sharp": "bound, sharp",
}
OPTION_LABELS = {
    "default": "default",
    "fast": "`--quality fast`",
    "best": "`--quality best`",
    "float32": "`--precision float32`",
    "sharp": "`--mesher sharp`",
}


def pick(rows: Iterable[Row], **words: Any) -> list[Row]:
    """Return the rows that have some words."""
    return [row for row in rows if all(row.get(key) == value for key, value in words.items())]


def values(rows: Iterable[Row], key: str) -> list[Any]:
    """Return the different entries of rows, in their order."""
    return list(dict.fromkeys(row[key] for row in rows if key in row))


def wide(
    rows: Sequence[Row],
    labels: Mapping[str, str],
    word: str,
    column: Column,
    among: str = "size",
    first: str = "",
) -> str:
    """Return a table of one figure: a row for each label, a column for each entry of ``among``."""
    rows = [row for row in rows if row.get(word) in labels]
    across, body = values(rows, among), []
    for name, label in labels.items():
        found = [pick(rows, **{word: name, among: each}) for each in across]
        if any(found):
            body.append([label, *(column.cell(r[0].get(column.key)) if r else "-" for r in found)])
    heads = [f"{each}^3" if among == "size" else str(each) for each in across]
    return markdown([first, *heads], body)


def closed_of(row: Row) -> str:
    """Return how many meshes are closed."""
    return f"{row['closed']} of {row.get('shapes', row.get('grids'))}"


def summary_table(rows: Sequence[Row]) -> str:
    """Return F1 and NC of the methods that a new user compares."""
    labels = {
        "mc": "marching cubes of the grid",
        "bspline": "cubic B-spline + marching cubes",
        "fast": "super-sdf `--quality fast`",
        "base": "**super-sdf**",
        "best": "super-sdf `--quality best`",
        "bound": "true distance at the same fine nodes",
    }
    sizes, whole = values(rows, "size"), pick(rows, half="")
    heads = [f"{n}^3: F1" if column is F1 else "NC" for n in sizes for column in (F1, NC)]
    body = []
    for name, label in labels.items():
        found = [pick(whole, size=n, method=name) for n in sizes]
        if all(found):
            body.append([label, *(cell for (row,) in found for cell in cells(row, (F1, NC)))])
    return markdown(["", *heads], body)


def size_table(rows: Sequence[Row], size: int) -> str:
    """Return all columns of all methods at a size, the published rows below ours."""
    body = [
        [NETWORK_LABELS.get(row["method"]) or label_of(row["method"]), *cells(row, SURFACE),
         closed_of(row)]
        for row in pick(rows, size=size, half="")
    ]  # fmt: skip
    titles = ["method", *(column.title for column in SURFACE), "closed"]
    return markdown(titles, [*body, *published_rows(size, SURFACE, 1)])


def network_table(rows: Sequence[Row]) -> str:
    """Return the networks at each size."""
    body = [
        [f"{row['size']}^3", NETWORK_LABELS[row["method"]], *cells(row, SHORT), closed_of(row)]
        for row in pick(rows, half="")
        if row["method"] in NETWORK_LABELS
    ]
    return markdown(["grid", "network", *(c.title for c in SHORT), "closed"], body)


def gap_table(rows: Sequence[Row]) -> str:
    """Return the gap closed by the networks, on all shapes and on each half."""
    halves = {"": "all", "choose": "those that networks were chosen on", "final": "the others"}
    keys = ("gap_f1", "gap_nc", "gap_p2s", "gap_p2s_back")
    body = [
        [f"{row['size']}^3", f"{halves[row['half']]} ({row['shapes']})",
         NETWORK_LABELS[row["method"]], *(percent(row[key]) for key in keys)]
        for half in halves
        for row in pick(rows, half=half)
        if row["method"] in ("fast", "base", "best")
    ]  # fmt: skip
    body.sort(key=lambda row: int(row[0][:-2]))
    titles = ["grid", "shapes", "network", "F1", "NC", "point to surface", "result to reference"]
    return markdown(titles, body)


def worse_line(rows: Sequence[Row]) -> str:
    """Return on how many shapes ours is better than B-spline, at each size."""
    lines = [f"At {row['size']}^3 {row['wins']}" for row in rows if row.get("wins") and
             row["half"] == ""]  # fmt: skip
    return " ".join(lines)


def edge_table(rows: Sequence[Row], name: str, size: int | None) -> str:
    """Return the meshers on a set of shapes, at a size or at all."""
    body = []
    for row in pick(rows, set=name, **({"size": size} if size else {})):
        label = MESHER_LABELS[row["method"]]
        label = label if size else f"{row['size']}^3, {label}"
        body.append([label, *cells(row, EDGE_COLUMNS), closed_of(row)])
    return markdown(["", *(column.title for column in EDGE_COLUMNS), "closed"], body)


def kind_table(rows: Sequence[Row], wanted: Callable[[Row], bool]) -> str:
    """Return a row for each kind of grid: the methods' mean distances in voxels."""
    chosen = [row for row in rows if row.get("set") in ("shapes", "parts") and wanted(row)]
    methods = values(chosen, "method")
    body = []
    for name, kind in dict.fromkeys((row["set"], row["kind"]) for row in chosen):
        found = {row["method"]: row for row in pick(chosen, set=name, kind=kind)}
        mine = found["ours"]
        label = kind if name == "shapes" else f"{kind}, CAD parts"
        taken = mine["taken_as"] + (f", told {mine['told']}" if mine["told"] else "")
        taken += f", refused {mine['refused']}" if mine["refused"] else ""
        distances = [VOXELS.cell(found[m]["voxels"]) if m in found else "-" for m in methods]
        volume = f"{found['mc']['volume_most']:.1f} %, {mine['volume_most']:.1f} %"
        pieces = f"{found['mc']['pieces']}, {mine['pieces']}"
        body.append([label, taken, *distances, volume, pieces, closed_of(mine)])
    titles = ["values", "taken as", *(KIND_LABELS[method] for method in methods)]
    return markdown([*titles, "volume off, at most: MC, super-sdf", "pieces", "closed"], body)


def form_table(rows: Sequence[Row]) -> str:
    """Return closed forms that are no distances, at their sizes."""
    chosen = pick(rows, set="forms")
    sizes, body = values(chosen, "size"), []
    for name in FORMS:
        found = pick(chosen, kind=name)
        line = [name]
        for method in ("mc", "bspline", "ours"):
            far = [row["voxels"] for row in pick(found, method=method)]
            line.append(", ".join(VOXELS.cell(value) for value in far))
        body.append([*line, ", ".join(dict.fromkeys(row["taken_as"] for row in found))])
    head = ", ".join(f"{n}^3" for n in sizes)
    return markdown([head, "marching cubes", "B-spline", "super-sdf", "taken as"], body)


def slice_table(rows: Sequence[Row]) -> str:
    """Return masks and truncated distances with thick slices."""
    chosen = pick(rows, set="slices")
    labels = {name: name for name in values(chosen, "method")}
    named = [{**row, "kind": f"1:1:{row['kind']}"} for row in chosen]
    return wide(named, labels, "method", VOXELS, among="kind")


def option_table(rows: Sequence[Row], column: Column) -> str:
    """Return the options of whole processes at each size."""
    return wide(rows, OPTION_LABELS, "option", column, first=column.title)


def dense_table(rows: Sequence[Row]) -> str:
    """Return ours and dense upsampling on one shape."""
    body = []
    for row in rows:
        if "ours_seconds" not in row:
            continue
        if row["option"] == "scipy":
            own = [f"{row['ours_seconds']:.2f}", f"{row['ours_peak_mb']:,.0f}", "1", "1"]
            body.append([f"{row['size']}^3, super-sdf", *own])
        kind = "cubic" if row["option"] == "scipy" else row["option"]
        over = [f"{row['over_seconds']:.1f}", f"{row['over_peak_mb']:.1f}"]
        figures = [f"{row['seconds']:.2f}", f"{row['peak_mb']:,.0f}"]
        body.append([f"{row['size']}^3, SciPy zoom, {kind}, and marching cubes", *figures, *over])
    return markdown(["", "s", "peak MB", "time over ours", "memory over ours"], body)


def large_table(rows: Sequence[Row]) -> str:
    """Return a large torus within several limits."""
    titles = ["grid", "--max-memory", "slabs", "band voxels", "triangles", "s", "peak MB",
              "planned MB"]  # fmt: skip
    body = []
    for row in rows:
        if "limit" in row and "slabs" in row:
            counts = [f"{row[key]:,}" for key in ("slabs", "band_voxels", "triangles")]
            costs = [f"{row['seconds']:.1f}", f"{row['peak_mb']:,.0f}", f"{row['planned_mb']:,.0f}"]
            body.append([f"{row['size']}^3", row["limit"], *counts, *costs])
        elif "limit" in row:
            body.append([f"{row['size']}^3", row["limit"], "refused", *["-"] * 5])
    return markdown(titles, body)


def stage_table(rows: Sequence[Row]) -> str:
    """Return the seconds of each stage, and its share, at each size."""
    found = pick(rows, option="network base int8")
    body = []
    for stage in found[0]["stages"] if found else ():
        line = [stage]
        for row in found:
            seconds, total = row["stages"][stage], sum(row["stages"].values())
            line.append(f"{seconds:.3f} ({seconds / total:.0%})")
        body.append(line)
    return markdown(["seconds", *(f"{row['size']}^3" for row in found)], body)


def rate_table(rows: Sequence[Row]) -> str:
    """Return the microseconds per voxel of the networks, at the largest size."""
    found = [row for row in rows if row["option"].startswith("network")]
    found = pick(found, size=max(values(found, "size"), default=0))
    body: dict[str, list[str]] = {}
    for row in found:
        body.setdefault(row["option"].split()[1], []).append(f"{row['us_per_voxel']:.1f}")
    lines = [[f"`{name}`", *both] for name, both in body.items()]
    return markdown(["microseconds per voxel of the band", "int8", "float32"], lines)


def noise_table(rows: Sequence[Row]) -> str:
    """Return F1 by noise, beside the published F1."""
    body = []
    for share in values(rows, "noise"):
        mc, spline, ours = (
            pick(rows, noise=share, method=m)[0]["f1"] for m in ("mc", "bspline", "base")
        )
        theirs = published.NOISE_F1[share / 100]
        figures = [mc, spline, ours, ours - mc, *theirs, theirs[1] - theirs[0]]
        body.append([f"{share} %", *(F1.cell(figure) for figure in figures)])
    titles = ["noise", "MC", "B-spline + MC", "super-sdf", "gain on MC", "*MC, published*"]
    return markdown([*titles, f"*{published.PAPER}*", "*its gain*"], body)


def setting_table(rows: Sequence[Row], word: str, paper: Mapping[Any, Sequence[float]]) -> str:
    """Return the rows of a setting, with the paper's figures where it has some."""
    columns, body = (CD, F1, NC, P2S, BACK), []
    for row in rows:
        label = "super-sdf" if row["method"] == "base" else label_of(row["method"])
        gap = percent(row["gap_f1"]) if row["method"] == "base" else "-"
        line = [f"{row[word]:g}", label, *cells(row, columns), gap]
        if paper:
            theirs = paper.get(row[word]) if row["method"] == "base" else None
            line += ["-"] * 3 if theirs is None else [f"{figure:.3f}" for figure in theirs]
        body.append(line)
    titles = [word, "method", *(column.title for column in columns), "F1 gap closed"]
    titles += [f"*{column.title}, paper*" for column in (CD, F1, NC)] if paper else []
    return markdown(titles, body)


def simplify_table(rows: Sequence[Row]) -> str:
    """Return meshes before and after they were simplified."""
    columns = (F1, NC, BY_KEY["efv"], P2S, BY_KEY["slivers"])
    body = []
    for name, mesher in dict.fromkeys((row["set"], row["mesher"]) for row in rows):
        before, after = (pick(rows, set=name, mesher=mesher, simplified=s)[0] for s in (0, 1))
        share = percent(after["faces"] / before["faces"], 1)
        pairs = [f"{a}, {b}" for a, b in zip(cells(before, columns), cells(after, columns))]
        shapes = {"parts": "CAD parts", "validation": "validation"}[name]
        body.append([f"{shapes}, {mesher}", share, *pairs, closed_of(after)])
    heads = [f"{column.title}: before, after" for column in columns]
    return markdown(["", "triangles left", *heads, "closed"], body)


def check_table(rows: Sequence[Row]) -> str:
    """Return how well residuals predict the true error."""
    lines = {
        "mean residual and mean error, both ways": lambda r: f"{r['shapes']:.2f}",
        "mean residual and mean distance of vertices to the truth": lambda r: f"{r['one_way']:.2f}",
        "largest residual and largest error": lambda r: f"{r['largest']:.2f}",
        "shapes whose largest residual is above their largest error": lambda r: f"{r['above']}",
        "vertices of a shape: median (tenth, ninetieth percentile)": lambda r: (
            f"{r['vertices']:.2f} ({r['vertices_low']:.2f}, {r['vertices_high']:.2f})"
        ),
        "worst 5 % of the vertices, found among the worst 5 % by residual": lambda r: (
            f"{r['found']:.0%}"
        ),
        "mean error, both ways, over mean residual": lambda r: (
            f"{r['ratio']:.1f} ({r['ratio_low']:.1f}, {r['ratio_high']:.1f})"
        ),
    }
    known = [{key: float("nan") if v is None else v for key, v in row.items()} for row in rows]
    body = [[name, *(cell(row) for row in known)] for name, cell in lines.items()]
    return markdown(["", *(f"{row['size']}^3" for row in rows)], body)


def memory_table(rows: Sequence[Row]) -> str:
    """Return bytes per voxel, fitted to the peaks of processes."""
    body = [
        [str(row["factor"]), f"{row['seen']:,.0f}", f"{row['decoded']:,.0f}",
         f"{row['fixed_mb']:.0f}", f"{row['off']:.0%}", f"{row['of_plan']:.2f}"]
        for row in rows
    ]  # fmt: skip
    titles = ["factor", "bytes per seen voxel", "per decoded voxel", "fixed MB", "fit off by",
              "peak over plan, at most"]  # fmt: skip
    return markdown(titles, body)


def peer_table(rows: Sequence[Row]) -> str:
    """Return another method, and ours with as many triangles."""
    columns = (*EDGE_COLUMNS, Column("mean s", "seconds", 1, 1))
    body = [[label_of(row["method"]), *cells(row, columns), closed_of(row)] for row in rows]
    return markdown(["", *(column.title for column in columns), "closed"], body)


SECONDS, PEAK = Column("seconds", "seconds", 1, 2), Column("peak MB", "peak_mb", 1, 0)
TABLES: dict[str, Callable[[list[Row]], str]] = {
    "quality.summary": summary_table,
    **{f"quality.{n}": lambda rows, n=n: size_table(rows, n) for n in (32, 64, 128)},
    "quality.networks": network_table,
    "quality.gaps": gap_table,
    "quality.worse": worse_line,
    **{f"edges.{n}": lambda rows, n=n: edge_table(rows, "parts", n) for n in (32, 64)},
    "edges.validation": lambda rows: edge_table(rows, "validation", None),
    "peers.table": peer_table,
    "kinds.distances": lambda rows: kind_table(
        rows, lambda row: row["kind"] != "mask" and not row["kind"].startswith("spacing")
    ),
    "kinds.masks": lambda rows: kind_table(rows, lambda row: row["kind"] == "mask"),
    "kinds.unequal": lambda rows: kind_table(rows, lambda row: row["kind"].startswith("spacing")),
    "kinds.forms": form_table,
    "kinds.slices": slice_table,
    "speed.process": lambda rows: option_table(rows, SECONDS),
    "speed.memory": lambda rows: option_table(rows, PEAK),
    "speed.warm": lambda rows: wide(rows, {"warm": "warm"}, "option", SECONDS, first="seconds"),
    "speed.dense": dense_table,
    "speed.large": large_table,
    "speed.stages": stage_table,
    "speed.networks": rate_table,
    "noise.table": noise_table,
    "scale.table": lambda rows: setting_table(rows, "scale", published.SCALED),
    "factors.table": lambda rows: setting_table(rows, "factor", {}),
    "simplify.table": simplify_table,
    "check.table": check_table,
    "memory.table": memory_table,
}


def about(figure: Mapping[str, Any]) -> str:
    """Return where the numbers of a figure come from, in a sentence."""
    on = figure["machine"]
    networks = ", ".join(f"`{name}` {digest}" for name, digest in figure["networks"].items())
    flags = ", ".join(on["instructions"])
    return (
        f"Measured {figure['date']} at commit {figure['commit']} on {on['cores']} cores of "
        f"{on['processor']} ({flags}), Python {on['python']}, NumPy {on['numpy']}, onnxruntime "
        f"{on['onnxruntime']}; networks: {networks}."
    )


def read(path: Path) -> dict[str, Any]:
    """Return the content of a figure's file."""
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        content["rows"], content["networks"], content["machine"]["processor"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FileError(f"{path} is no file of python -m lab figures: {error}") from error
    return content


def tables_of(path: Path) -> dict[str, str]:
    """Return the tables of a figure's file by name."""
    content = read(path)
    of_figure = {n: make for n, make in TABLES.items() if n.partition(".")[0] == path.stem}
    return {name: make(content["rows"]) for name, make in of_figure.items()}


def shown(marker: str, folder: Path) -> str:
    """Return what a marker stands for: ``NAME.TABLE``, ``NAME.about``, or ``NAME.COLUMN WORDS``."""
    name, _, rest = marker.partition(".")
    path = folder / f"{name}.json"
    known = {table.partition(".")[0] for table in TABLES}
    if name not in known:
        raise FileError(f"there is no figure {name!r}: give one of {', '.join(sorted(known))}")
    what, *words = rest.split()
    if not words and what != "about" and marker not in TABLES:
        raise FileError(f"there is no table {marker!r}: give one of {', '.join(TABLES)}")
    if not path.exists():
        return UNKNOWN
    content = read(path)
    if what == "about":
        return about(content)
    if not words:
        return TABLES[marker](content["rows"])
    return number(content["rows"], what, words)


def number(rows: Sequence[Row], name: str, words: Sequence[str]) -> str:
    """Return one number of a figure, or of two rows with "over", "above" or "below" between."""
    if name not in COLUMNS:
        raise FileError(f"there is no column {name!r}: give one of {', '.join(COLUMNS)}")
    column = COLUMNS[name]
    between = next((word for word in words if word in ONE_OF), None)
    if between is None:
        cell = column.cell(row_of(rows, words)[column.key])
        return cell.removeprefix("0") if column in (F1, NC) else cell
    cut = list(words).index(between)
    one, other = (float(row_of(rows, w)[column.key]) for w in (words[:cut], words[cut + 1 :]))
    if between == "over":
        return f"{one / other:.0f}" if one >= 10 * other else f"{one / other:.1f}"
    share = one / other - 1 if between == "above" else 1 - one / other
    return f"{100 * share:.0f} %" if share >= 0.095 else f"{100 * share:.1f} %"


def row_of(rows: Sequence[Row], words: Sequence[str]) -> Row:
    """Return the first row in which every word stands; of quality that is of all shapes first."""
    found = [row for row in rows if set(words) <= {spelt(value) for value in row.values()}]
    found.sort(key=lambda row: row.get("half", "") not in ("", *words))
    if not found:
        raise FileError(f"no row has {' '.join(words)}")
    return found[0]


def spelt(value: Any) -> str:
    """Return an entry of a row as one word."""
    return f"{value}".replace(" of ", " ").replace(" at ", " ").replace(" ", "-")
