"""Quality against reference meshes, the baselines and the upper bound: tables, plots, pictures.

    python -m lab evaluate meshes/ --out report/
    python -m lab evaluate a.ply b.ply --sizes 32 --methods mc ours --model new.onnx --out report/

Each mesh is scaled to a box diagonal of 1 and sampled at every size; the surface that a method
reconstructs from the samples is compared with the mesh. OUT is a new or empty folder, or that of an
earlier evaluation, which is resumed:

    OUT/report.md      the tables
    OUT/shapes.md      every figure of every shape
    OUT/results.jsonl  the rows they are made from, a line for each shape, size and method
    OUT/plots, OUT/pictures
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from super_sdf.errors import FileError, OptionError, SuperSdfError, seen
from super_sdf.files.output import replacing
from super_sdf.machine.resources import count_cores
from super_sdf.mesh import Mesh
from super_sdf.options import AUTO_PRECISION, DEFAULT_QUALITY, PRECISIONS

from .measuring import NO_SETTING, Task, network_of
from .methods import FLOOR, METHODS, OURS, make_surface
from .plots import draw_plots
from .processes import describe_machine
from .rows import Row, Rows
from .runner import LeftOut, OnTask, complete
from .shapes import Case, Setting, Shape, find_meshes, spread
from .tables import (
    cost_table,
    edge_table,
    empty_lines,
    gap_line,
    shape_table,
    surface_table,
    win_line,
)

ROWS = "results.jsonl"
EXTREMES = 5  # number of best shapes shown, and of worst
ERROR_TOP = 0.25  # upper end of the colour bar in the pictures, in voxels
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
shapes of the smallest. "Shapes" counts those with edges that were measured."""


class Results:
    """The measurements of tasks, by setting and method, in the order of the shapes.

    A failure is not a score, and methods are compared on the same shapes: if a method failed on a
    shape in a setting, the shape is left out of that setting for all methods, and named.

    Attributes
    ----------
    left_out : list of LeftOut
        Shapes that could not be read, or failed in some setting.
    floors : dict of rows
        The reference against itself, by shape; shapes without it are nowhere.
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


def write_report(
    results: Results, like: Task, sizes: Sequence[int], out: Path, up: str | None
) -> Path:
    """Write report.md, shapes.md, plots and pictures; return the path of report.md.

    ``up`` is the axis that points up in the pictures; None: none are drawn.
    """
    settings = [replace(like.setting, size=size) for size in sizes]
    by_setting = {s: results.by_method(s, (*like.methods, FLOOR)) for s in settings}
    parts = [f"# Quality of super-sdf on {len(results.floors)} shapes", PROTOCOL_LINES]
    if like.turned is not None:
        parts.append(f"The shapes are turned at random, by seed {like.turned}.")
    parts += [f"Left out, {entry.shape}: {entry.reason}." for entry in results.left_out]
    for setting, by_method in by_setting.items():
        wins = ()
        if {OURS, "bspline"} <= set(by_method):
            wins = (win_line(by_method[OURS], by_method["bspline"]),)
        lines = [*wins, gap_line(by_method), *empty_lines(by_method)]
        parts += [f"## {setting}", surface_table(by_method, setting.size), *filter(None, lines)]
    parts += ["## Edges and triangles", EDGE_LINES]
    parts += [f"**{s}**\n\n{edge_table(found)}" for s, found in by_setting.items()]
    parts += ["## Time and memory", describe_machine(), COST_LINES]
    parts += [f"**{s}**\n\n{cost_table(found)}" for s, found in by_setting.items()]
    plots = draw_plots({s.size: found for s, found in by_setting.items()}, out / "plots")
    parts += ["## Plots", *(f"![{text}](plots/{name})" for name, text in plots.items())]
    if up and OURS in like.methods:
        parts += picture_lines(results, like, settings[0], out, up)
    notes = [
        f"- {name}: {'; '.join(row['notes'])}."
        for name, row in results.floors.items()
        if row["notes"]
    ]
    parts += ["## Notes on the shapes", "\n".join(notes)] if notes else []
    shapes = [f"## {s}\n\n{shape_table(found)}" for s, found in by_setting.items()]
    write_page(out / "shapes.md", shapes)
    return write_page(out / "report.md", parts)


def write_page(path: Path, parts: Sequence[str]) -> Path:
    """Write a page of Markdown, whole or not at all; return its path."""
    with replacing(path) as part:
        part.write_text("\n\n".join(parts) + "\n", encoding="utf-8", errors="backslashreplace")
    return path


def picture_lines(results: Results, like: Task, setting: Setting, out: Path, up: str) -> list[str]:
    """Draw the shapes on which ours is best and worst; return the lines that show them.

    They are ranked by F1 over the floor's F1, which is low on large surfaces: there 100,000 points
    are far apart.
    """
    floors = results.floors
    ranked = results.of(setting, OURS)
    ranked.sort(key=lambda row: row["f1"] / floors[row["shape"]]["f1"], reverse=True)
    shown = ranked if len(ranked) < 2 * EXTREMES else [*ranked[:EXTREMES], *ranked[-EXTREMES:]]
    paths, folder = {task.path.stem: task.path for task in results.tasks}, out / "pictures"
    folder.mkdir(exist_ok=True)
    lines = [f"## {len(shown)} of {len(ranked)} shapes at {setting.size}^3, best and worst F1 over "
             "the floor's"]  # fmt: skip
    for row in shown:
        name, floor = row["shape"], floors[row["shape"]]["f1"]
        lines.append(f"**{name}**, F1 {row['f1']:.3f} (floor {floor:.3f}), NC {row['nc']:.3f}")
        try:
            draw_shape(replace(like, path=paths[name], setting=setting), folder, up)
            lines.append(f"![{name}](pictures/{name}.png)")
        except SuperSdfError as problem:  # the tables matter more than a picture
            lines.append(f"Not drawn: {problem}.")
    return lines


def draw_shape(task: Task, folder: Path, up: str) -> None:
    """Draw a picture of coarse marching cubes, ours, the reference, and the error of ours."""
    from .drawing import Panel, render_panels, vertex_errors

    shape = Shape.read(task.path, task.turned)
    case, network = Case(shape, task.setting), network_of(*task.network(OURS), task.threads)
    coarse, ours = (make_surface(name, case, network).mesh for name in ("mc", OURS))
    panels = [
        Panel(coarse, titled(coarse, f"marching cubes of {task.setting.size}^3")),
        Panel(ours, titled(ours, "super-sdf")),
        Panel(shape.mesh, "reference"),
        Panel(ours, "error of super-sdf", vertex_errors(ours, shape.solid)),
    ]
    target, top = folder / f"{shape.name}.png", ERROR_TOP * case.spacing
    render_panels(panels, target, colour="error", up=up, top=top, unit="box diagonal 1")


def titled(mesh: Mesh, title: str) -> str:
    """Return the title of a panel, which says so if the mesh is empty."""
    return title if len(mesh.faces) else f"{title}: no surface"


def progress_lines() -> OnTask:
    """Return a function that prints one line per task, with the time that was spent."""
    start = time.monotonic()

    def show(done: int, total: int, what: str) -> None:
        spent = time.monotonic() - start
        left = spent / done * (total - done)
        print(f"{done} of {total}: {what}, {spent:.0f} s, {left:.0f} s left", file=sys.stderr)

    return show


def add_jobs(parser: argparse.ArgumentParser) -> None:
    """Add the option of the number of processes."""
    parser.add_argument(
        "--jobs", type=int, default=count_cores(), help="processes at a time; 0: in this one"
    )


def main() -> int:
    """Measure what is missing and report; exit code 1 if a shape was left out."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("meshes", type=Path, nargs="+", help="mesh files, or folders of them")
    parser.add_argument("--out", type=Path, required=True, help="folder for the report")
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 64, 128])
    parser.add_argument("--factor", type=int, default=4)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--limit", type=int, help="use only this many meshes, spread over the list")
    parser.add_argument(
        "--turned", type=int, metavar="SEED", help="turn every mesh at random first"
    )
    parser.add_argument("--model", default=DEFAULT_QUALITY, help="shipped network or ONNX file")
    parser.add_argument("--precision", choices=PRECISIONS, default=AUTO_PRECISION)
    parser.add_argument("--up", choices=("x", "y", "z"), default="z", help="upward in pictures")
    parser.add_argument("--no-pictures", action="store_true")
    parser.add_argument("--quiet", action="store_true", help="print errors only")
    add_jobs(parser)
    words = parser.parse_args()
    if words.turned is not None and words.turned < 0:
        raise OptionError(f"turned is {seen(words.turned)}: give a seed of 0 or more")
    paths = find_meshes(words.meshes)
    paths = spread(paths, words.limit or len(paths))
    settings = [Setting(size, words.factor) for size in dict.fromkeys(words.sizes)]
    for setting in settings:
        setting.check()
    network_of(words.model, words.precision, 1)  # raises before anything is measured
    methods = tuple(name for name in METHODS if name in words.methods)
    threads = max(1, count_cores() // max(words.jobs, 1))
    like = Task(paths[0], settings[0], methods, words.model, words.precision, threads, words.turned)
    check_folder(words.out)
    tasks, rows = tasks_of(paths, settings, like), Rows(words.out / ROWS)
    left_out = complete(tasks, rows, words.jobs, None if words.quiet else progress_lines())
    results = Results(tasks, rows, left_out)
    for entry in results.left_out:
        print(f"Left out: {entry.shape}: {entry.reason}", file=sys.stderr)
    if not results.floors:
        raise FileError("no shape could be measured")
    sizes = [setting.size for setting in settings]
    up = None if words.no_pictures else words.up
    path = write_report(results, like, sizes, words.out, up)
    if not words.quiet:
        print(path.read_text(encoding="utf-8"))
    return int(bool(results.left_out))
