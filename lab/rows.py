"""The rows of a measurement, in a file of JSON lines, and the processes that make them.

Rows are appended as they come, so a kill costs only the tasks under way. A row is valid as long as
its key is asked for; a line that is damaged is measured again. A process that crashes, or runs out
of memory, fails the method that it was at, and harms no other.
"""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from .measuring import Measurement, Task, measure_task, measures, reason_of
from .shapes import Shape

Key = Mapping[str, Any]
Row = dict[str, Any]
OnTask = Callable[[int, int, str], None]
"""Called after each task: (tasks done, tasks in all, name of the shape)."""


class Rows:
    """The rows of a file, by key."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path, self.rows = path, dict[str, Row]()
        for line in path.read_bytes().splitlines() if path.exists() else ():
            with suppress(ValueError, KeyError, TypeError):  # a line that was torn
                record = json.loads(line)
                self.rows[name_of(record["key"])] = record

    def add(self, key: Key, figures: Row) -> None:
        record = {"key": dict(key), **figures}
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")
        self.rows[name_of(key)] = record

    def get(self, key: Key) -> Row | None:
        """Return the row of a key, its entries among the figures; None if there is none."""
        record = self.rows.get(name_of(key))
        if record is None:
            return None
        return {**record["key"], **{name: v for name, v in record.items() if name != "key"}}

    def is_final(self, key: Key, figures: Iterable[str] = ()) -> bool:
        """Return whether a row has figures and no error; the cause of a failure may have passed."""
        row = self.get(key) or {"error": ""}
        return row["error"] is None and row.keys() >= set(figures)


def name_of(key: Key) -> str:
    return json.dumps(key, sort_keys=True)


def complete(
    tasks: Sequence[Task], rows: Rows, jobs: int, on_task: OnTask | None = None
) -> list[str]:
    """Measure what the rows lack and keep it there; return the shapes that could not be read."""
    left = [
        replace(
            task,
            methods=tuple(m for m in task.methods if not rows.is_final(task.key(m), measures(m))),
            triangles=tuple((m, row["faces"]) for m in task.methods
                            if "faces" in (row := rows.get(task.key(m)) or {})),
        )
        for task in tasks
    ]  # fmt: skip
    left = sorted((task for task in left if task.methods), key=lambda t: (t.path, t.turned or 0))
    unreadable = []
    for done, (task, outcome) in enumerate(outcomes(left, jobs), 1):
        if isinstance(outcome, str):
            unreadable.append(f"{task.path.stem}: {outcome}")
        else:
            for method, figures in outcome.items():
                rows.add(task.key(method), figures)
        if on_task:
            on_task(done, len(left), task.path.stem)
    return unreadable


def outcomes(
    tasks: Sequence[Task], jobs: int
) -> Iterator[tuple[Task, dict[str, Measurement] | str]]:
    """Yield each task with the figures of its methods, or why its shape cannot be read.

    When a process dies, the tasks under way are done again, one at a time and a method at a time.
    """
    if not jobs:
        yield from ((task, measured(task)) for task in tasks)
        return
    context, waiting = multiprocessing.get_context("spawn"), list(tasks)
    with suppress(BrokenProcessPool), ProcessPoolExecutor(jobs, context) as pool:
        for future in as_completed(found := {pool.submit(measured, task): task for task in tasks}):
            outcome = future.result()
            waiting.remove(found[future])
            yield found[future], outcome
    for task in waiting:
        figures: dict[str, Measurement] = {}
        for method in task.methods:
            try:
                with ProcessPoolExecutor(1, context) as pool:
                    outcome = pool.submit(measured, replace(task, methods=(method,))).result()
                figures |= {method: {"error": outcome}} if isinstance(outcome, str) else outcome
            except BrokenProcessPool:
                figures[method] = {"error": "its process died"}
        yield task, figures


def measured(task: Task) -> dict[str, Measurement] | str:
    """Return the figures of each method of a task, or why its shape cannot be read."""
    try:
        return dict(measure_task(task, shape_of(task.path, task.turned)))
    except Exception as problem:  # the other shapes still count
        return reason_of(problem)


@lru_cache(maxsize=1)
def shape_of(path: Path, turned: int | None) -> Shape:
    """Read a shape, once for tasks that follow one another."""
    return Shape.read(path, turned)
