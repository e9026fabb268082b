"""Quality against reference meshes, the baselines and the upper bound.

    python -m lab evaluate meshes/ --out report/
    python -m lab evaluate a.ply b.ply --sizes 32 --methods mc ours --model new.onnx --out report/

Each mesh is scaled to a box diagonal of 1 and sampled at every size; the surface that a method
reconstructs from the samples is compared with the mesh. OUT is a new or empty folder, or that of an
earlier evaluation, which is resumed; there another model is compared without measuring the rest
again:

    OUT/report.md      the tables
    OUT/results.jsonl  the rows they are made from, a line for each shape, size and method
"""

from __future__ import annotations

import sys
import time
from argparse import ArgumentParser
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from super_sdf.errors import FileError, OptionError, seen
from super_sdf.options import DEFAULT_QUALITY, OPTIONS
from super_sdf.threads import count_cores

from . import parser_of
from .measuring import NO_SETTING, Task, network_of
from .methods import BY_NAME, FLOOR, METHODS, OURS
from .metrics import METRICS, shown_in
from .ndc import add_ndc
from .rows import OnTask, Row, Rows, complete
from .shapes import Setting, find_meshes, spread
from .tables import gaps_closed, listed, meanings, summary, surface_table

ROWS = "results.jsonl"
PROTOCOL_LINES = """\
Lengths are in units of the reference's box diagonal; voxels are those of the coarse grid. 100,000
points are sampled on each surface. Figures are means over the shapes. The bound is marching cubes
of the true distances at the fine nodes; the floor compares two independent samplings of the
reference. A result without a surface counts as a dot at the origin; a shape on which a method
failed is left out of that table for all methods, and named. Shapes without sharp edges do not count
in figures of edges. Published rows are of other shapes (Thingi30)."""


class Results:
    """The measurements of tasks, by setting and method, in the order of the shapes.

    A failure is not a score, and methods are compared on the same shapes: if a method failed on a
    shape in a setting, the shape is left out of that setting for all methods, and named.
    ``floors`` are the references against themselves, by shape.
    """

    def __init__(self, tasks: Sequence[Task], rows: Rows, left_out: Sequence[str] = ()) -> None:
        self.tasks, self.rows, self.left_out = tasks, rows, list(left_out)
        self.failed: dict[Setting, set[str]] = {}
        self.floors: dict[str, Row] = {}
        for task in tasks:
            found = {method: rows.get(task.key(method)) or {} for method in task.methods}
            errors: dict[str, list[str]] = {}
            for method, row in found.items():
                if row.get("error") is not None:
                    errors.setdefault(row["error"], []).append(method)
            for reason, names in errors.items():
                what = f"{', '.join(names)} ({task.setting}): {reason}"
                self.left_out.append(f"{task.path.stem}: {what}")
            if errors:
                self.failed.setdefault(task.setting, set()).add(task.path.stem)
            if found.get(FLOOR) and not errors:
                self.floors[task.path.stem] = found[FLOOR]

    def of(self, setting: Setting, method: str) -> list[Row]:
        """Return the measurements of a method, in the order of the tasks.

        ``excess_cd`` is added: CD less the CD of two samplings of the reference.
        """
        failed = self.failed.get(setting, set())
        found: list[Row] = []
        for task in self.tasks:
            is_meant = method in task.methods and task.setting in (setting, NO_SETTING)
            row = self.rows.get(task.key(method)) if is_meant else None
            if row and row["error"] is None and row["shape"] not in failed:
                floor = self.floors.get(row["shape"], {}).get("cd", 0.0)
                found.append({**row, "excess_cd": row["cd"] - floor} if "cd" in row else row)
        return found


def results_of(
    paths: Sequence[Path],
    settings: Sequence[Setting],
    like: Task,
    rows: Rows,
    jobs: int,
    on_task: OnTask | None = None,
) -> Results:
    """Measure what the rows lack; return the results, and name on stderr what was left out."""
    tasks = [replace(like, path=p, setting=NO_SETTING, methods=(FLOOR,)) for p in paths]
    tasks += [replace(like, path=p, setting=s) for s in settings for p in paths]
    results = Results(tasks, rows, complete(tasks, rows, jobs, on_task))
    for entry in results.left_out:
        print(f"Left out: {entry}", file=sys.stderr)
    return results


def report(results: Results, like: Task) -> str:
    """Return the tables of all settings as Markdown, with what was left out."""
    parts = [f"# Quality of super-sdf on {len(results.floors)} shapes", PROTOCOL_LINES]
    parts.append(meanings("surface edges"))
    if like.turned is not None:
        parts.append(f"The shapes are turned at random, by seed {like.turned}.")
    parts += [f"Left out, {entry}." for entry in results.left_out]
    for setting in dict.fromkeys(t.setting for t in results.tasks if t.setting != NO_SETTING):
        found = {method: results.of(setting, method) for method in (*like.methods, FLOOR)}
        means = [{"method": method, **summary(rows)} for method, rows in found.items()]
        parts += [f"## {setting}", surface_table(means, setting.size)]
        ends = found.get("bspline", []), found.get("bound", [])
        if closed := gaps_closed(found.get(OURS, []), *ends):
            gaps = (f"{METRICS[key[4:]].gap} {share:.0%}" for key, share in closed.items())
            parts.append(f"Of the gap from B-spline to the bound closed: {', '.join(gaps)}.")
        parts += ["### Edges and triangles", listed(means, shown_in("edges"))]
    return "\n\n".join(parts) + "\n"


def progress_lines() -> OnTask:
    """Return a function that prints one line per task, with the time that was spent."""
    start = time.monotonic()

    def show(done: int, total: int, what: str) -> None:
        spent = time.monotonic() - start
        left = spent / done * (total - done)
        print(f"{done} of {total}: {what}, {spent:.0f} s, {left:.0f} s left", file=sys.stderr)

    return show


def add_jobs(parser: ArgumentParser) -> None:
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
    parser.add_argument("--turned", type=int, metavar="SEED", help="turn meshes at random first")
    parser.add_argument("--model", default=DEFAULT_QUALITY, help="shipped network or ONNX file")
    parser.add_argument("--precision", choices=OPTIONS["precision"].kind.choices, default="auto")
    parser.add_argument("--quiet", action="store_true", help="print errors only")
    add_jobs(parser)
    add_ndc(parser)
    words = parser.parse_args()
    if words.turned is not None and words.turned < 0:
        raise OptionError(f"turned is {seen(words.turned)}: give a seed of 0 or more")
    paths = find_meshes(words.meshes)
    paths = spread(paths, words.limit or len(paths))
    settings = [Setting(size, words.factor) for size in dict.fromkeys(words.sizes)]
    for setting in settings:
        setting.check()
    network_of(words.model, words.precision, 1)  # raises before anything is measured
    methods = tuple(name for name in BY_NAME if name in words.methods)
    threads = max(1, count_cores() // max(words.jobs, 1))
    like = Task(paths[0], settings[0], methods, words.model, words.precision, threads, words.turned)
    rows = Rows(words.out / ROWS)
    on_task = None if words.quiet else progress_lines()
    results = results_of(paths, settings, like, rows, words.jobs, on_task)
    if not results.floors:
        raise FileError("no shape could be measured")
    text = report(results, like)
    (words.out / "report.md").write_text(text, encoding="utf-8", errors="backslashreplace")
    if not words.quiet:
        print(text)
    return int(bool(results.left_out))
