"""Quality against reference meshes, the baselines and the upper bound.

    python -m lab evaluate meshes/ --out report/
    python -m lab evaluate a.ply b.ply --sizes 32 --methods mc ours --model new.onnx --out report/

Each mesh is scaled to a box diagonal of 1 and sampled at every size; the surface that a method
reconstructs from the samples is compared with the mesh. OUT is a new or empty folder, or that of an
earlier evaluation, which is resumed; there another model is compared without measuring the rest
again:

    OUT/report.md      the tables
    OUT/shapes.md      every figure of every shape
    OUT/results.jsonl  the rows they are made from, a line for each shape, size and method
"""

from __future__ import annotations

import sys
import time
from argparse import ArgumentParser
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from super_sdf.errors import FileError, OptionError, seen
from super_sdf.files.output import replacing
from super_sdf.threads import count_cores
from super_sdf.options import AUTO_PRECISION, DEFAULT_QUALITY, PRECISIONS

from . import parser_of
from .measuring import NO_SETTING, Task, network_of
from .methods import BY_NAME, FLOOR, METHODS, OURS
from .ndc import add_ndc
from .costs import describe_machine
from .rows import LeftOut, OnTask, Row, Rows, complete
from .shapes import HALVES, Setting, draw_halves, find_meshes, spread
from .tables import (
    BY_KEY,
    COST,
    EDGES,
    GAPS,
    gap_closed,
    label_of,
    listed,
    markdown,
    mean_of,
    percent,
    summary,
    surface_table,
    win_line,
)

Halves = Mapping[str, Sequence[str]]
"""Names of shapes: all, and each half."""
ByMethod = Mapping[str, Sequence[Row]]

ROWS = "results.jsonl"
COST_LINES = """\
From the samples in memory to the mesh in memory, several at a time on one machine: to compare
methods, not to quote. The peak is what the process held beyond what it held before."""
PROTOCOL_LINES = """\
Lengths are in units of the reference's box diagonal. 100,000 points are sampled on each surface; CD
is the sum of the mean squared distances both ways, F1 at 0.003, NC the normal consistency. p2s is
the mean exact point-to-triangle distance of both directions ("ref to res", "res to ref"); ECD and
EF1 (at 0.005) compare sharp edges. Field errors are those at the fine nodes of the band. The bound
is marching cubes of the true distances at the same nodes; the floor compares two independent
samplings of the reference. A result without a surface counts as a dot at the origin; a shape on
which a method failed is left out of that table for all methods, and named. Published rows are of
other shapes (Thingi30)."""

EDGE_LINES = """\
EFv is the F1 of points on the sharp edges (over 30 degrees) of both meshes, at a tenth of a coarse
voxel. The edge distance is that of points on the reference's edges to the result's triangles, in
coarse voxels: its mean. The angles, in degrees, are those between the result's normals and that of
the nearest triangle of the reference, within a coarse voxel of the reference's edges ("near") and
beyond. Slivers are triangles with an angle under 5 degrees; the min angle is the mean over the
shapes of the smallest. Shapes without edges do not count."""


class Results:
    """The measurements of tasks, by setting and method, in the order of the shapes.

    A failure is not a score, and methods are compared on the same shapes: if a method failed on a
    shape in a setting, the shape is left out of that setting for all methods, and named.
    ``floors`` are the references against themselves, by shape.
    """

    def __init__(self, tasks: Sequence[Task], rows: Rows, left_out: Sequence[LeftOut] = ()) -> None:
        self.tasks, self.rows, self.left_out = tasks, rows, list(left_out)
        self.failed: dict[Setting, set[str]] = {}
        self.floors: dict[str, Row] = {}
        for task in tasks:
            found = {method: rows.get(task.key(method)) for method in task.methods}
            errors: dict[str, list[str]] = {}
            for method, row in found.items():
                if row is not None and row["error"] is not None:
                    errors.setdefault(row["error"], []).append(method)
            for reason, names in errors.items():
                what = f"{', '.join(names)} ({task.setting}): {reason}"
                self.left_out.append(LeftOut(task.path.stem, what))
            if errors and task.limit is None:
                self.failed.setdefault(task.setting, set()).add(task.path.stem)
            if FLOOR in found and not errors and found[FLOOR]:
                self.floors[task.path.stem] = found[FLOOR] or {}

    def of(self, setting: Setting, method: str, names: Sequence[str] | None = None) -> list[Row]:
        """Return the measurements of a method, in the order of the tasks; ``names``: of shapes.

        ``excess_cd`` is added: CD less the CD of two samplings of the reference.
        """
        failed = self.failed.get(setting, set())
        found: list[Row] = []
        for task in self.tasks:
            is_meant = method in task.methods and task.setting in (setting, NO_SETTING)
            is_wanted = names is None or task.path.stem in names
            row = self.rows.get(task.key(method)) if is_meant and is_wanted else None
            if row and row["error"] is None and row["shape"] not in failed:
                floor = self.floors.get(row["shape"], {}).get("cd", 0.0)
                found.append({**row, "excess_cd": row["cd"] - floor})
        return found

    def by_method(self, setting: Setting, methods: Sequence[str]) -> dict[str, list[Row]]:
        """Return the measurements of methods."""
        return {method: self.of(setting, method) for method in methods}


def tasks_of(paths: Sequence[Path], settings: Sequence[Setting], like: Task) -> list[Task]:
    """Return a task for each shape and setting, and for the floor of each shape."""
    floors = [replace(like, path=p, setting=NO_SETTING, methods=(FLOOR,)) for p in paths]
    return floors + [replace(like, path=p, setting=s) for s in settings for p in paths]


def results_of(
    tasks: Sequence[Task], rows: Rows, jobs: int, on_task: OnTask | None = None
) -> Results:
    """Measure what the rows lack; return the results, and name on stderr what was left out."""
    results = Results(tasks, rows, complete(tasks, rows, jobs, on_task))
    for entry in results.left_out:
        print(f"Left out: {entry.shape}: {entry.reason}", file=sys.stderr)
    return results


def check_folder(out: Path) -> None:
    """Raise FileError unless a folder is new, empty or made by an evaluation."""
    if out.exists() and not out.is_dir():
        raise FileError(f"{out} is no folder: give a new one")
    names = sorted(path.name for path in out.iterdir()) if out.exists() else []
    if names and ROWS not in names:
        raise FileError(
            f"{out} holds {names[0]!r} and no {ROWS}, so no evaluation made it: give a new or an "
            "empty folder"
        )
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"{out} cannot be made: {error.strerror}") from error


def write_report(results: Results, like: Task, halves: Halves, out: Path) -> Path:
    """Write report.md and shapes.md; return the path of report.md."""
    settings = dict.fromkeys(t.setting for t in results.tasks if t.setting != NO_SETTING)
    by_setting = {s: results.by_method(s, (*like.methods, FLOOR)) for s in settings}
    means = {setting: [{"method": method, **summary(rows)} for method, rows in found.items()]
             for setting, found in by_setting.items()}  # fmt: skip
    parts = [f"# Quality of super-sdf on {len(results.floors)} shapes", PROTOCOL_LINES]
    if like.turned is not None:
        parts.append(f"The shapes are turned at random, by seed {like.turned}.")
    parts += [f"Left out, {entry.shape}: {entry.reason}." for entry in results.left_out]
    for setting, found in by_setting.items():
        parts += [f"## {setting}", surface_table(means[setting], setting.size)]
        parts += [*comparisons(found, halves), *odd_meshes(found)]
    for title, text, columns in (
        ("Edges and triangles", EDGE_LINES, EDGES),
        ("Time and memory", f"{describe_machine()}\n\n{COST_LINES}", COST),
    ):
        parts += [f"## {title}", text]
        parts += [f"**{setting}**\n\n{listed(rows, columns)}" for setting, rows in means.items()]
    notes = {name: "; ".join(row["notes"]) for name, row in results.floors.items()}
    lines = [f"- {name}: {said}." for name, said in notes.items() if said]
    parts += ["## Notes on the shapes", "\n".join(lines)] if lines else []
    shapes = [f"## {setting}\n\n{shape_table(found)}" for setting, found in by_setting.items()]
    write_page(out / "shapes.md", shapes)
    return write_page(out / "report.md", parts)


def comparisons(by_method: ByMethod, halves: Halves) -> list[str]:
    """Return on how many shapes ours beats B-spline, and the gap to the bound that it closes."""
    if not {OURS, "bspline"} <= set(by_method):
        return []
    lines = [win_line(by_method[OURS], by_method["bspline"])]
    if "bound" in by_method:
        body = []
        for half, names in halves.items():
            three = [[row for row in by_method[method] if row["shape"] in names]
                     for method in (OURS, "bspline", "bound")]  # fmt: skip
            if three[0]:
                cells = (f"{mean_of(three[0], key):.4g}, {percent(gap_closed(*three, key), 1)}"
                         for key in GAPS)  # fmt: skip
                body.append([f"{half} ({len(three[0])})", *cells])
        title = "super-sdf, and what it closes of the gap between B-spline and the bound"
        lines.append(markdown([title, *GAPS.values()], body))
    return lines


def odd_meshes(by_method: ByMethod) -> list[str]:
    """Return a line for each method that found no surface on some shapes, or one inside out."""
    lines = []
    for method, rows in by_method.items():
        empty = [row["shape"] for row in rows if not row["faces"]]
        turned = [row["shape"] for row in rows if row["faces"] and not row["outward"]]
        odd = {"No surface (a dot stands in)": empty, "Inside out": turned}
        named = {what: names for what, names in odd.items() if names}
        lines += [f"{what}, {label_of(method)}: {', '.join(n)}." for what, n in named.items()]
    return lines


def shape_table(by_method: ByMethod) -> str:
    """Return the table of all shapes, with a row for each shape and method."""
    rows = [
        {**row, "method": name}
        for measured in zip(*by_method.values())
        for name, row in zip(by_method, measured)
    ]

    def words(row: Row) -> list[str]:
        return [f"{row['shape']}, {label_of(row['method'])}"]

    return listed(rows, list(BY_KEY.values()), words, ["shape, method"])


def write_page(path: Path, parts: Sequence[str]) -> Path:
    """Write a page of Markdown, whole or not at all; return its path."""
    with replacing(path) as part:
        part.write_text("\n\n".join(parts) + "\n", encoding="utf-8", errors="backslashreplace")
    return path


def progress_lines() -> OnTask:
    """Return a function that prints one line per task, with the time that was spent."""
    start = time.monotonic()

    def show(done: int, total: int, what: str) -> None:
        spent = time.monotonic() - start
        left = spent / done * (total - done)
        print(f"{done} of {total}: {what}, {spent:.0f} s, {left:.0f} s left", file=sys.stderr)

    return show


def add_jobs(parser: ArgumentParser) -> None:
    """Add the option of the number of processes."""
    parser.add_argument(
        "--jobs", type=int, default=count_cores(), help="processes at a time; 0: in this one"
    )


def main() -> int:
    """Measure what is missing and report; exit code 1 if a shape was left out."""
    parser = parser_of(__doc__)
    parser.add_argument("meshes", type=Path, nargs="+", help="mesh files, or folders of them")
    parser.add_argument("--out", type=Path, required=True, help="folder for the report")
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 64, 128])
    parser.add_argument("--factor", type=int, default=4)
    parser.add_argument("--methods", nargs="+", choices=BY_NAME, default=list(METHODS))
    parser.add_argument("--limit", type=int, help="use only this many meshes, spread over the list")
    parser.add_argument("--half", choices=("all", *HALVES), default="all",
                        help="networks are chosen on one half of the meshes")  # fmt: skip
    parser.add_argument("--turned", type=int, metavar="SEED", help="turn meshes at random first")
    parser.add_argument("--model", default=DEFAULT_QUALITY, help="shipped network or ONNX file")
    parser.add_argument("--precision", choices=PRECISIONS, default=AUTO_PRECISION)
    parser.add_argument("--quiet", action="store_true", help="print errors only")
    add_jobs(parser)
    add_ndc(parser)
    words = parser.parse_args()
    if words.turned is not None and words.turned < 0:
        raise OptionError(f"turned is {seen(words.turned)}: give a seed of 0 or more")
    paths = find_meshes(words.meshes)
    names = [path.stem for path in paths]
    halves = {"all": names, **draw_halves(names)}
    paths = [path for path in paths if path.stem in halves[words.half]]
    paths = spread(paths, words.limit or len(paths))
    settings = [Setting(size, words.factor) for size in dict.fromkeys(words.sizes)]
    for setting in settings:
        setting.check()
    network_of(words.model, words.precision, 1)  # raises before anything is measured
    methods = tuple(name for name in BY_NAME if name in words.methods)
    threads = max(1, count_cores() // max(words.jobs, 1))
    like = Task(paths[0], settings[0], methods, words.model, words.precision, threads, words.turned)
    check_folder(words.out)
    tasks, rows = tasks_of(paths, settings, like), Rows(words.out / ROWS)
    results = results_of(tasks, rows, words.jobs, None if words.quiet else progress_lines())
    if not results.floors:
        raise FileError("no shape could be measured")
    path = write_report(results, like, halves, words.out)
    if not words.quiet:
        print(path.read_text(encoding="utf-8"))
    return int(bool(results.left_out))
