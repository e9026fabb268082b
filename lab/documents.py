"""Write the measured figures into README, the documents and the model cards.

    python -m lab documents            # rewrites what stands between the markers, and plots
    python -m lab documents --check    # exit code 1 if a document differs

A table stands between ``<!-- figures: NAME.TABLE -->`` and ``<!-- /figures -->``, each on a line; a
number in a sentence between ``<!-- figures: NAME.COLUMN WORDS -->`` and ``<!-- /figures -->``.
``TABLES`` is the list: NAME.TABLE is made from the rows of NAME.json, and only of that file, so no
table mixes two networks or machines.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from super_sdf.errors import FileError

from . import parser_of, plots, published, tables
from .metrics import METRICS, Column, shown_in
from .rows import Row
from .tables import label_of, listed, meanings, wide

FOLDER = Path(__file__).parent / "figures"
ROOT = Path(__file__).parents[1]
PLACES = ("README.md", "docs/**/*.md", "src/super_sdf/models/*.md")
MARKED = re.compile(r"(<!-- figures: ([^>]+?) -->)(.*?)(<!-- /figures -->)", re.DOTALL)
UNKNOWN = "(not measured)"
COLUMNS = {**METRICS, "peak_mb": tables.PEAK}  # of numbers in sentences
BY_SIZE = ("size", "method")
QUALITY = "surface summary networks settings"
SUMMARY = ("mc", "bspline", "ours", "ours-marching", "bound")


def pick(rows: Iterable[Row], **words: Any) -> list[Row]:
    """Return the rows that have some words; of a tuple, any."""
    return [row for row in rows if all(
        row.get(key) in (value if isinstance(value, tuple) else (value,))
        for key, value in words.items())]  # fmt: skip


def among(rows: Iterable[Row], key: str, part: str) -> list[Row]:
    return [row for row in rows if part in str(row.get(key, ""))]


def beside(rows: Sequence[Row], word: str, theirs: Sequence[Row] = ()) -> str:
    """Return the rows of a setting, each value with the published rows."""
    together = sorted([*rows, *theirs], key=lambda row: float(row[word]))
    return listed(together, shown_in("settings"), (word, "method"))


def kind_table(rows: Sequence[Row]) -> str:
    """Return a row for each kind of grid: the methods' mean distances in voxels."""
    methods, body = list(dict.fromkeys(row["method"] for row in rows)), []
    for kind in dict.fromkeys(row["kind"] for row in rows):
        found = {row["method"]: row for row in pick(rows, kind=kind)}
        mine, mc = found["ours"], found["mc"]
        taken = mine["taken_as"] + (f", refused {mine['refused']}" if mine["refused"] else "")
        voxels = Column("voxels", digits=4)
        body.append([
            *(kind, taken),
            *(voxels.cell(found.get(method, {})) for method in methods),
            f"{mc['volume_most']:.1f} %, {mine['volume_most']:.1f} %",
            f"{mine['pieces_of_reference']}, {mc['pieces']}, {mine['pieces']}",
            f"{mine['closed']} of {mine['grids']}",
        ])  # fmt: skip
    titles = ["values", "taken as", *map(label_of, methods), "volume off at most: MC, super-sdf"]
    return tables.markdown([*titles, "pieces: true, MC, super-sdf", "closed"], body)


TABLES: dict[str, Callable[[list[Row]], str]] = {
    "quality.summary": lambda rows: wide(pick(rows, method=SUMMARY), "method", shown_in("summary")),
    "quality.networks": lambda rows: listed(
        among(rows, "method", "ours-marching"), shown_in("networks"), BY_SIZE),
    **{f"quality.{n}": lambda rows, n=n: tables.surface_table(pick(rows, size=n), n)
       for n in (32, 64, 128)},
    "halves.table": lambda rows: listed(rows, tables.GAPS, ("size", "shapes", "method")),
    "quality.meaning": lambda rows: meanings(QUALITY),
    "edges.meaning": lambda rows: meanings("parts peers", but=QUALITY),
    "edges.parts": lambda rows: listed(
        pick(rows, set="parts"), shown_in("parts"), ("size", "factor", "method")),
    "edges.validation": lambda rows: listed(
        pick(rows, set="validation"), shown_in("parts"), BY_SIZE),
    "peers.contouring": lambda rows: listed(
        among(rows, "method", "dual-contouring"), shown_in("parts peers"), BY_SIZE),
    "peers.ndc": lambda rows: listed(
        among(rows, "method", "ndc"), shown_in("parts peers"), BY_SIZE),
    "kinds.distances": lambda rows: kind_table(
        [row for row in rows if "spacing 1" not in row["kind"]]),
    "kinds.unequal": lambda rows: kind_table(among(rows, "kind", "spacing 1")),
    **{f"masks.{column.key}-{n}": lambda rows, column=column, n=n: wide(
        [row for row in pick(rows, ratio=n) if row["set"] != "labels"], "method", (column,), "set")
       for column in tables.OF_MASKS for n in (1, 5)},
    "masks.costs": lambda rows: listed(
        pick(rows, set="all masks"), tables.MASKS, ("ratio", "method")),
    "masks.labels": lambda rows: listed(
        pick(rows, set="labels"), tables.WALLS, ("ratio", "method")),
    "speed.process": lambda rows: wide(
        [row for row in rows if row["option"] == "default" or "--" in row["option"]],
        "option", tables.COSTS),
    "speed.dense": lambda rows: listed(
        among(rows, "option", "zoom"), tables.DENSE, ("size", "option")),
    "speed.large": lambda rows: listed(
        [{"tiles": "refused", **row} for row in rows if "limit" in row],
        tables.LARGE, ("size", "limit")),
    "noise.table": lambda rows: beside(rows, "noise", published.NOISY),
    "scale.table": lambda rows: beside(rows, "scale", published.SCALED_ROWS),
    "factors.table": partial(beside, word="factor"),
    "simplify.table": lambda rows: listed(rows, shown_in("simplify"), ("set", "method")),
}  # fmt: skip


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
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        content["rows"], content["networks"], content["machine"]["processor"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FileError(f"{path} is no file of python -m lab figures: {error}") from error
    return content


def tables_of(path: Path) -> dict[str, str]:
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
    if "over" not in words:
        return COLUMNS[name].cell(row_of(rows, words))
    cut = list(words).index("over")
    one, other = (float(row_of(rows, w)[name]) for w in (words[:cut], words[cut + 1 :]))
    return f"{one / other:.0f}" if one >= 10 * other else f"{one / other:.1f}"


def row_of(rows: Sequence[Row], words: Sequence[str]) -> Row:
    """Return the first row in which every word stands."""
    found = [row for row in rows if set(words) <= {f"{value}" for value in row.values()}]
    if not found:
        raise FileError(f"no row has {' '.join(words)}")
    return found[0]


def documents() -> list[Path]:
    return sorted(path for place in PLACES for path in ROOT.glob(place))


def rendered(text: str, folder: Path = FOLDER) -> str:
    """Return a document with the figures as they were measured; others stay as they stand."""
    if len(MARKED.findall(text)) != len(re.findall(r"<!-- figures: ", text)):
        raise FileError("a marker of figures is not ended by <!-- /figures -->")

    def replace(match: re.Match[str]) -> str:
        found = shown(match[2].strip(), folder)
        if found == UNKNOWN and match[3].strip():
            return match[0]
        is_block = "\n" in match[3] or "\n" in found
        return match[1] + (f"\n\n{found}\n\n" if is_block else found) + match[4]

    return MARKED.sub(replace, text)


def main() -> int:
    """Rewrite the documents, or compare them."""
    parser = parser_of(__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing")
    parser.add_argument("--figures", type=Path, default=FOLDER, help="folder of the JSON files")
    words = parser.parse_args()
    differ = 0
    for path in documents():
        before = path.read_text(encoding="utf-8")
        try:
            after = rendered(before, words.figures)
        except FileError as error:
            raise FileError(f"{path.relative_to(ROOT)}: {error}") from error
        if after != before:
            differ += 1
            print(path.relative_to(ROOT))
            if not words.check:
                path.write_text(after, encoding="utf-8")
    for name in () if words.check else plots.PLOTS:  # their bytes depend on matplotlib's version
        text = plots.plot(name, read(words.figures / f"{name}.json")["rows"])
        (ROOT / "docs" / "images" / f"{name}.svg").write_text(text, encoding="utf-8")
    return int(words.check and differ > 0)
