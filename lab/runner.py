"""Runs tasks in processes: one that crashes, or runs out of memory or time, harms no other."""

from __future__ import annotations

import signal
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from super_sdf.batch.pool import Death, work_in_processes

from .measuring import Measurement, Task, measure_task, reason_of
from .rows import Rows
from .shapes import Shape

OnTask = Callable[[int, int, str], None]
"""Called after each task: (tasks done, tasks in all, name of the shape)."""


Outcome = dict[str, Measurement] | str


@dataclass(frozen=True)
class LeftOut:
    """A shape that could not be measured, or not everywhere, and why."""

    shape: str
    reason: str


def complete(
    tasks: Sequence[Task], rows: Rows, jobs: int, on_task: OnTask | None = None
) -> list[LeftOut]:
    """Measure what the rows lack and keep it there; return the shapes that could not be read.

    When a process dies, the methods of its task are measured again, each on its own, so that only
    those that end a process fail. At a time limit all methods of the task fail.
    """
    left = [
        replace(task, methods=missing(task, rows), triangles=triangles_of(task, rows))
        for task in tasks
    ]
    queue = deque(task for task in sorted(left, key=shape_key) if task.methods)
    done, total, unreadable = 0, len(queue), {}
    results = (
        work_in_processes(lambda: queue.popleft() if queue else None, measured_in_time, jobs)
        if jobs
        else ((task, measured(task)) for task in queue)
    )
    for task, outcome in results:
        if isinstance(outcome, Death) and len(task.methods) > 1 and not task.limit:
            queue.extendleft(replace(task, methods=(method,)) for method in task.methods)
            total += len(task.methods) - 1
            continue
        if isinstance(outcome, Death):
            outcome = dict.fromkeys(task.methods, failure(task, outcome))
        if isinstance(outcome, str):
            unreadable[task.path.stem] = outcome
        else:
            for method, figures in outcome.items():
                rows.add(task.key(method), figures)
        done += 1
        if on_task:
            on_task(done, total, task.path.stem)
    return [LeftOut(shape, reason) for shape, reason in unreadable.items()]


def missing(task: Task, rows: Rows) -> tuple[str, ...]:
    """Return the methods of a task that have to be measured."""
    return tuple(m for m in task.methods if not rows.is_final(task.key(m), task.limit))


def triangles_of(task: Task, rows: Rows) -> tuple[tuple[str, int], ...]:
    """Return how many triangles the methods made that are measured: others are to have as many."""
    found = ((method, rows.get(task.key(method)) or {}) for method in task.methods)
    return tuple((method, row["faces"]) for method, row in found if "faces" in row)


def shape_key(task: Task) -> tuple[Path, int]:
    """Return by what tasks are sorted: those of a shape follow one another, see ``shape_of``."""
    return task.path, -1 if task.turned is None else task.turned


def failure(task: Task, death: Death) -> Measurement:
    """Return the figures of a method that ended its process."""
    if signal.SIGALRM.name in death.cause:
        return {"error": f"over the limit of {task.limit:g} s", "limit": task.limit}
    return {"error": f"its process {death.cause}"}


def measured_in_time(task: Task) -> Outcome:
    """Return ``measured`` in a process of its own, which ends at the task's limit."""
    signal.setitimer(signal.ITIMER_REAL, task.limit or 0)  # 0: none
    outcome = measured(task)
    signal.setitimer(signal.ITIMER_REAL, 0)
    return outcome


def measured(task: Task) -> Outcome:
    """Return the figures of each method of a task, or why its shape cannot be read."""
    try:
        shape = shape_of(task.path, task.turned)
    except Exception as problem:  # the other shapes still count
        return reason_of(problem)
    return dict(measure_task(task, shape))


@lru_cache(maxsize=1)
def shape_of(path: Path, turned: int | None) -> Shape:
    """Read a shape, once for tasks that follow one another."""
    return Shape.read(path, turned)
