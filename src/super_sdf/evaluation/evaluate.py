"""The whole evaluation on a page: measure what is missing, time whole processes, report.

scope -> tasks -> rows (kept) -> report
"""

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
    """Where the report is, and which shapes are not in it, or not in all of its tables."""

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
    """Measure a scope and write its report.

    Rows are kept in ``out/results.jsonl`` as they come: called again, after a kill or with a
    larger scope, only what is missing is measured. Every random number is seeded by the shape's
    name, so figures of quality are the same in every run.

    Parameters
    ----------
    scope : Scope
        What is asked for.
    out : Path
        Folder of the report: a new one, an empty one, or that of an earlier evaluation.
    up : {"x", "y", "z"}
        The axis that points up in the pictures.
    pictures : bool
        Whether the best and worst shapes are drawn.
    on_task : callable, optional
        Called after each task: see ``OnTask``.

    Raises
    ------
    OptionError
        If the scope makes no sense.
    FileError
        If the folder cannot be made or holds what no evaluation wrote, or no shape could be
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
    """Return the times of the command by size, each shape's kept; nothing else runs meanwhile.

    What fails is added to what the results leave out.
    """
    scope, timings = results.scope, dict[int, list[Measurement]]()
    names = results.names(scope.experiment_paths())
    settings = scope.settings()
    tasks = [t for t in results.tasks if t.setting in settings and t.path.stem in names]
    tasks = [task for task in tasks if task.limit is None]
    for done, task in enumerate(tasks, 1):
        if not results.store.is_final(task, PROCESS):
            results.store.add(time_task(task, scope.model))
        row = results.store.get(task, PROCESS) or {}
        if row["error"] is None:
            timings.setdefault(task.setting.size, []).append(row)
        else:
            said = f"timing ({task.setting}): {row['error']}"
            results.left_out.append(LeftOut(task.path.stem, said))
        if on_task:
            on_task(done, len(tasks), f"timing {task}", done / len(tasks))
    return timings


def time_task(task: Task, model: str) -> Measurement:
    """Return the row of the command's time on a task's grid, or why there is none."""
    try:
        row = time_shape(Shape.read(task.path), task.setting, ["--model", model])
    except SuperSdfError as problem:
        return failed_row(task, PROCESS, reason_of(problem))
    return {**task.key(PROCESS), **row}
