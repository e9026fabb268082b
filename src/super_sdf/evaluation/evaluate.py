"""The whole evaluation on a page: measure what is missing, time whole processes, report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import FileError, SuperSdfError
from .cases import Shape
from .folder import ROWS, check_folder, make_folder
from .measuring import Measurement, Task, failed_row, reason_of
from .names import PROCESS
from .report import write_report
from .results import Results
from .runner import LeftOut, OnTask, complete
from .scope import Scope
from .store import Store
from .timing import time_shape


@dataclass(frozen=True)
class Outcome:
    """Path of the report, and the shapes that are missing in some or all of its tables."""

    report: Path
    left_out: Sequence[LeftOut]


def evaluate(
    scope: Scope,
    out: Path,
    *,
    up: str = "z",
    pictures: bool = True,
    on_task: OnTask | None = None,
) -> Outcome:
    """Measure everything in a scope and write the report.

    Measurements are kept in ``out/results.jsonl`` as they come: called again, after a kill or with
    a larger scope, only what is missing is measured. All random numbers are seeded by the name of
    the shape, so the quality is the same in every run.

    Parameters
    ----------
    scope : Scope
        Shapes, sizes, methods, experiments and peers.
    out : Path
        Folder of the report: new, empty, or of an earlier evaluation.
    up : {"x", "y", "z"}
        The axis that points up in the pictures.
    pictures : bool
        Whether to draw the best and worst shapes.
    on_task : callable, optional
        Called after each task: see ``OnTask``.

    Raises
    ------
    OptionError
        If the scope is not valid.
    FileError
        If the folder cannot be made or was not made by an evaluation, or no shape could be
        measured.
    ModelError
        If the network cannot be loaded.
    """
    scope.check()
    check_folder(out)
    tasks = scope.tasks()
    store = Store(make_folder(out) / ROWS)
    left_out = complete(tasks, store, scope.jobs, on_task)
    results = Results(scope, tasks, store, left_out)
    if not results.floors:
        first = results.left_out[0]
        raise FileError(f"no shape could be measured; {first.shape}: {first.reason}")
    timings = time_processes(results, on_task) if "timings" in scope.experiments else {}
    report = write_report(results, out, timings, up=up, pictures=pictures)
    return Outcome(report, results.left_out)


def time_processes(results: Results, on_task: OnTask | None) -> dict[int, list[Measurement]]:
    """Return the times of the command on each shape, by size; nothing else runs meanwhile.

    Failures are added to ``results.left_out``.
    """
    scope, timings = results.scope, dict[int, list[Measurement]]()
    names = results.names(scope.experiment_paths())
    settings = scope.settings()
    tasks = [t for t in results.tasks if t.setting in settings and t.path.stem in names]
    tasks = [task for task in tasks if task.limit is None]
    for done, task in enumerate(tasks, 1):
        if not results.store.is_final(task, PROCESS):
            results.store.add(time_task(task))
        row = results.store.get(task, PROCESS) or {}
        if row["error"] is None:
            timings.setdefault(task.setting.size, []).append(row)
        else:
            reason = f"timing ({task.setting}): {row['error']}"
            results.left_out.append(LeftOut(task.path.stem, reason))
        if on_task:
            on_task(done, len(tasks), f"timing {task}", done / len(tasks))
    return timings


def time_task(task: Task) -> Measurement:
    """Return the time of the command on a task's grid, or a failure."""
    try:
        options = ["--model", task.model, "--precision", task.precision]
        row = time_shape(Shape.read(task.path, task.turned), task.setting, options)
    except SuperSdfError as problem:
        return failed_row(task, PROCESS, reason_of(problem))
    return {**task.key(PROCESS), **row}
