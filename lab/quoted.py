"""What documents show of the measured figures: tables by name, and single numbers in sentences.

``TABLES`` is the list: NAME.TABLE is made from the rows of NAME.json, and only of that file, so no
table mixes two networks or machines.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from super_sdf.errors import FileError

from . import published
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
    THERE,
    Column,
    cells,
    closed_of,
    label_of,
    listed,
    markdown,
    percent,
    surface_table,
)

UNKNOWN = "(not measured)"
SHORT = (F1, NC, THERE, BACK, EF1, BY_KEY["field_mae"])
VOXELS = Column("mean distance", "voxels", 1, 4)
SECONDS, PEAK = Column("seconds", "seconds", 1, 2), Column("peak MB", "peak_mb", 1, 0)
EDGE_COLUMNS = (F1, NC, THERE, BACK, *EDGES[:-1])
PEER_COLUMNS = (*EDGE_COLUMNS, Column("mean s", "seconds", 1, 1))
DENSE = (SECONDS, PEAK, Column("time over ours", "over_seconds", 1, 1),
         Column("memory over ours", "over_peak_mb", 1, 1))  # fmt: skip
LARGE = (Column("tiles", "tiles", 1, 0), Column("band voxels", "band_voxels", 1, 0),
         Column("triangles", "triangles", 1, 0), SECONDS, PEAK)  # fmt: skip
COLUMNS = {**BY_KEY, "seconds": SECONDS, "peak_mb": PEAK}  # of numbers in sentences
SUMMARY_LABELS = {
    "mc": "marching cubes",
    "bspline": "B-spline + marching cubes",
    "default": "super-sdf",
    "base": "super-sdf, `--mesher marching`",
    "bound": "true distance at the same nodes",
}
MODEL_LABELS = {
    "fast": "`fast`",
    "noisy": "`noisy`",
    "base": "`base` (default)",
    "base-float32": "`base` in float32",
    "best": "`best`",
}
NETWORK_LABELS = {
    "default": "super-sdf",
    **{name: f"{label}, marching cubes" for name, label in MODEL_LABELS.items()},
    "base": "`base`, marching cubes",
}
MESHER_LABELS = {
    "marching": "marching",
    "sharp": "**sharp (default)**",
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
    "marching": "`--mesher marching`",
    "simplify": "`--simplify 0.02`",
}


def pick(rows: Iterable[Row], **words: Any) -> list[Row]:
    """Return the rows that have some words."""
    return [row for row in rows if all(row.get(key) == value for key, value in words.items())]


def values(rows: Iterable[Row], key: str) -> list[Any]:
    """Return the different entries of rows, in their order."""
    return list(dict.fromkeys(row[key] for row in rows if key in row))


def wide(
    rows: Sequence[Row], labels: Mapping[str, str], word: str, column: Column, among: str = "size"
) -> str:
    """Return a table of one figure: a row for each label, a column for each entry of ``among``."""
    rows = [row for row in rows if row.get(word) in labels]
    across, body = values(rows, among), []
    for name in values(rows, word):
        found = [pick(rows, **{word: name, among: each}) for each in across]
        figures = (column.cell(r[0].get(column.key)) if r else "-" for r in found)
        body.append([labels[name], *figures])
    heads = [f"{each}^3" if among == "size" else str(each) for each in across]
    return markdown(["", *heads], body)


def summary_table(rows: Sequence[Row]) -> str:
    """Return F1 and NC of the methods that a new user compares."""
    sizes, body = values(rows, "size"), []
    for name, label in SUMMARY_LABELS.items():
        found = [pick(rows, size=n, method=name) for n in sizes]
        if any(found):
            figures = [cells(row[0] if row else {}, (F1, NC)) for row in found]
            body.append([label, *(cell for pair in figures for cell in pair)])
    heads = [f"{n}^3: F1" if column is F1 else "NC" for n in sizes for column in (F1, NC)]
    return markdown(["", *heads], body)


def size_table(rows: Sequence[Row], size: int) -> str:
    """Return all columns of all methods at a size."""

    def words(row: Row) -> list[str]:
        return [NETWORK_LABELS.get(row["method"]) or label_of(row["method"])]

    return surface_table(pick(rows, size=size), size, words)


def network_table(rows: Sequence[Row]) -> str:
    """Return the networks at each size, meshed by marching cubes."""
    chosen = (row for row in rows if row["method"] in MODEL_LABELS)
    heads, labels = ["grid", "network"], MODEL_LABELS
    return listed(chosen, SHORT, lambda row: [f"{row['size']}^3", labels[row["method"]]], heads)


def edge_table(rows: Sequence[Row], name: str, size: int | None = None) -> str:
    """Return the meshers on a set of shapes, at a size or at all."""
    chosen = (row for row in pick(rows, set=name) if size in (None, row["size"]))

    def words(row: Row) -> list[str]:
        label = MESHER_LABELS[row["method"]]
        return [label if size else f"{row['size']}^3, {label}"]

    return listed(chosen, EDGE_COLUMNS, words, [""])


def kind_table(rows: Sequence[Row], wanted: Callable[[str], bool]) -> str:
    """Return a row for each kind of grid: the methods' mean distances in voxels."""
    chosen = [row for row in rows if row["set"] in ("shapes", "parts") and wanted(row["kind"])]
    methods, body = values(chosen, "method"), []
    for name, kind in dict.fromkeys((row["set"], row["kind"]) for row in chosen):
        found = {row["method"]: row for row in pick(chosen, set=name, kind=kind)}
        mine, mc = found["ours"], found["mc"]
        label = kind if name == "shapes" else f"{kind}, CAD parts"
        taken = mine["taken_as"] + (f", told {mine['told']}" if mine["told"] else "")
        taken += f", refused {mine['refused']}" if mine["refused"] else ""
        distances = [VOXELS.cell(found[m]["voxels"]) if m in found else "-" for m in methods]
        volume = f"{mc['volume_most']:.1f} %, {mine['volume_most']:.1f} %"
        pieces = f"{mc['pieces']}, {mine['pieces']}"
        body.append([label, taken, *distances, volume, pieces, closed_of(mine)])
    titles = ["values", "taken as", *(KIND_LABELS[method] for method in methods)]
    titles += ["volume off, at most: MC, super-sdf", "pieces: MC, super-sdf", "closed"]
    return markdown(titles, body)


def dense_table(rows: Sequence[Row]) -> str:
    """Return dense upsampling and marching cubes on one shape, beside ours."""
    names = {"scipy": "cubic", "trilinear": "trilinear"}
    chosen = (row for row in rows if row["option"] in names)
    heads = ["SciPy's zoom and marching cubes"]
    return listed(chosen, DENSE, lambda r: [f"{r['size']}^3, {names[r['option']]}"], heads)


def large_table(rows: Sequence[Row]) -> str:
    """Return a large torus within several limits."""
    chosen = ({"tiles": "refused", **row} for row in rows if "limit" in row)
    heads = ["grid", "`--max-memory`"]
    return listed(chosen, LARGE, lambda row: [f"{row['size']}^3", row["limit"]], heads)


def noise_table(rows: Sequence[Row]) -> str:
    """Return F1 by noise, beside the published F1."""
    body = []
    for share in values(rows, "noise"):
        found = (pick(rows, noise=share, method=m)[0] for m in ("mc", "bspline", "default"))
        mc, spline, ours = (row["f1"] for row in found)
        theirs = published.NOISE_F1[share / 100]
        figures = [mc, spline, ours, ours - mc, *theirs, theirs[1] - theirs[0]]
        body.append([f"{share} %", *(F1.cell(figure) for figure in figures)])
    titles = ["noise", "MC", "B-spline + MC", "super-sdf", "gain on MC", "*MC, published*"]
    return markdown([*titles, f"*{published.PAPER}*", "*its gain*"], body)


def setting_table(rows: Sequence[Row], word: str, paper: Mapping[Any, Sequence[float]]) -> str:
    """Return the rows of a setting, with the paper's figures where it has some."""
    columns, body = (CD, F1, NC, P2S, BACK), []
    for row in rows:
        is_ours = row["method"] == "default"
        label = "super-sdf" if is_ours else label_of(row["method"])
        gap = percent(row["gap_f1"]) if is_ours else "-"
        line = [f"{row[word]:g}", label, *cells(row, columns), gap]
        theirs = paper.get(row[word]) if is_ours else None
        line += [f"{figure:.3f}" for figure in theirs] if theirs else ["-"] * 3 * bool(paper)
        body.append(line)
    titles = [word, "method", *(column.title for column in columns), "F1 gap closed"]
    titles += [f"*{column.title}, paper*" for column in (CD, F1, NC)] if paper else []
    return markdown(titles, body)


def simplify_table(rows: Sequence[Row]) -> str:
    """Return the triangles that are left of meshes simplified within an error."""
    names = {"parts": "CAD parts", "validation": "validation"}
    heads, line = [""], ["triangles left"]
    for name, mesher in dict.fromkeys((row["set"], row["mesher"]) for row in rows):
        before, after = (pick(rows, set=name, mesher=mesher, simplified=s)[0] for s in (0, 1))
        heads.append(f"{names[name]}, {mesher}")
        line.append(percent(after["faces"] / before["faces"], 1))
    return markdown(heads, [line])


def peer_table(rows: Sequence[Row]) -> str:
    """Return dual contouring of distances, and ours with as many triangles."""
    return listed([row for row in rows if "size" not in row], PEER_COLUMNS, heads=[""])


def ndc_table(rows: Sequence[Row]) -> str:
    """Return neural dual contouring, and ours with as many triangles, at each size."""
    chosen = [row for row in rows if "size" in row]
    return listed(
        chosen, PEER_COLUMNS, lambda row: [f"{row['size']}^3, {label_of(row['method'])}"], [""]
    )


def is_unequal(kind: str) -> bool:
    """Return whether a kind of grid has unequal spacings."""
    return kind.startswith("spacing")


TABLES: dict[str, Callable[[list[Row]], str]] = {
    "quality.summary": summary_table,
    "quality.networks": network_table,
    **{f"quality.{n}": partial(size_table, size=n) for n in (32, 64, 128)},
    **{f"edges.{n}": partial(edge_table, name="parts", size=n) for n in (32, 64)},
    "edges.validation": partial(edge_table, name="validation"),
    "peers.table": peer_table,
    "peers.ndc": ndc_table,
    "kinds.distances": lambda rows: kind_table(rows, lambda k: k != "mask" and not is_unequal(k)),
    "kinds.masks": lambda rows: kind_table(rows, lambda kind: kind == "mask"),
    "kinds.unequal": lambda rows: kind_table(rows, is_unequal),
    "speed.process": lambda rows: wide(rows, OPTION_LABELS, "option", SECONDS),
    "speed.memory": lambda rows: wide(rows, OPTION_LABELS, "option", PEAK),
    "speed.dense": dense_table,
    "speed.large": large_table,
    "noise.table": noise_table,
    "scale.table": lambda rows: setting_table(rows, "scale", published.SCALED),
    "factors.table": lambda rows: setting_table(rows, "factor", {}),
    "simplify.table": simplify_table,
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
    rows = read(path)["rows"]
    return {name: make(rows) for name, make in TABLES.items() if name.startswith(f"{path.stem}.")}


def shown(marker: str, folder: Path) -> str:
    """Return what a marker stands for: ``NAME.TABLE``, ``NAME.about``, or ``NAME.COLUMN WORDS``."""
    name, _, rest = marker.partition(".")
    path, known = folder / f"{name}.json", {table.partition(".")[0] for table in TABLES}
    if name not in known:
        raise FileError(f"there is no figure {name!r}: give one of {', '.join(sorted(known))}")
    what, *words = rest.split()
    if not words and what != "about" and marker not in TABLES:
        raise FileError(f"there is no table {marker!r}: give one of {', '.join(TABLES)}")
    if not path.exists():
        return UNKNOWN
    content = read(path)
    if words:
        return number(content["rows"], what, words)
    return about(content) if what == "about" else TABLES[marker](content["rows"])


def number(rows: Sequence[Row], name: str, words: Sequence[str]) -> str:
    """Return one number of a figure, or of two rows with "over" between."""
    if name not in COLUMNS:
        raise FileError(f"there is no column {name!r}: give one of {', '.join(COLUMNS)}")
    column = COLUMNS[name]
    if "over" not in words:
        return column.cell(row_of(rows, words)[name])
    cut = list(words).index("over")
    one, other = (float(row_of(rows, w)[name]) for w in (words[:cut], words[cut + 1 :]))
    return f"{one / other:.0f}" if one >= 10 * other else f"{one / other:.1f}"


def row_of(rows: Sequence[Row], words: Sequence[str]) -> Row:
    """Return the first row in which every word stands."""
    found = [row for row in rows if set(words) <= {f"{value}" for value in row.values()}]
    if not found:
        raise FileError(f"no row has {' '.join(words)}")
    return found[0]
