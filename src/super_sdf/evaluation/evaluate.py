"""The whole evaluation on a page: measure what is missing, time whole processes, report.

plan -> tasks -> rows (kept) -> report
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import FileError
from .cases import Shape
from .measuring import PROCESS, Row, Task
from .plan import Plan
from .report import write_report
from .results import Results
from .runner import LeftOut, Store, complete
from .timing import time_shape

Progress = Callable[[int, int, str, float], None]
"""Called with (tasks done, tasks in all, what was just done, the share of the work done)."""


@dataclass(frozen=True)
class Outcome:
    """Where the report is, and which shapes are not in it."""

    report: Path
    left_out: Sequence[LeftOut]


def evaluate(
    plan: Plan,
    out: Path,
    *,
    up: str = "z",
    pictures: bool = True,
    progress: Progress | None = None,
) -> Outcome:
    """Measure a plan and write its report.

    Rows are kept in ``out/results.jsonl`` as they come: called again, after a kill or with a
    larger plan, only what is missing is measured. Every random number is seeded by the shape's
    name, so figures of quality are the same in every run.

    Parameters
    ----------
    plan : Plan
        What is asked for.
    out : Path
        Folder of the report; made if need be.
    up : {"x", "y", "z"}
        The axis that points up in the pictures.
    pictures : bool
        Whether the best and worst shapes are drawn.
    progress : callable, optional
        See ``Progress``.

    Raises
    ------
    OptionError
        If the plan makes no sense.
    FileError
        If the folder cannot be made, or no shape could be measured.
    ModelError
        If the network cannot be loaded.
    """
    plan.check()
    tasks = plan.tasks()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"{out} cannot be made: {error.strerror}") from error
    store = Store(out / "results.jsonl")
    tell = progress or (lambda done, total, what, share: None)
    left_out = complete(
        tasks,
        store,
        plan.jobs,
        lambda done, total, task, share: tell(done, total, name_of(task), share),
    )
    results = Results(plan, tasks, store, left_out)
    if not results.floors:
        raise FileError(f"no shape could be measured; {left_out[0].shape}: {left_out[0].reason}")
    timings = time_processes(results, tell) if "timings" in plan.experiments else {}
    return Outcome(write_report(results, out, timings, up=up, pictures=pictures), left_out)


def name_of(task: Task) -> str:
    """Return what a task is called while it goes on."""
    setting = task.setting
    noted = [f"{setting.size}^3, factor {setting.factor}"] if setting.size else ["reference"]
    noted += [f"noise {setting.noise:g}"] if setting.noise else []
    noted += [f"scale {setting.scale:g}"] if setting.scale else []
    noted += [f"{setting.passes} passes"] if setting.passes > 1 else []
    return f"{task.path.stem} ({', '.join([*noted, *(task.methods if task.limit else [])])})"


def time_processes(results: Results, tell: Progress) -> dict[int, list[Row]]:
    """Return the times of the command by size, each shape's kept; nothing else runs meanwhile."""
    plan, timings = results.plan, dict[int, list[Row]]()
    names = results.names(plan.experiment_paths())
    settings = plan.settings()
    tasks = [t for t in results.tasks if t.setting in settings and t.path.stem in names]
    tasks = [task for task in tasks if task.limit is None]
    for done, task in enumerate(tasks, 1):
        if not results.store.is_final(task, PROCESS):
            row = time_shape(Shape.read(task.path), task.setting, ["--model", plan.model])
            results.store.add({**task.key(PROCESS), **row})
        timings.setdefault(task.setting.size, []).append(results.store.get(task, PROCESS) or {})
        tell(done, len(tasks), f"timing {name_of(task)}", done / len(tasks))
    return timings
