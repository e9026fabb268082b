"""Processes that measure, and the file that remembers: killed at any moment, it goes on.

Each task runs in a process of its own, so that one that crashes, runs out of memory or out of time
takes nothing with it. Rows are appended to a file of JSON lines as they come.
"""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from ..errors import SuperSdfError
from .cases import Shape
from .measuring import PROTOCOL, Row, Task, failed_row, measure_task

# What a row is known by; the rest of it are figures.
KEY_NAMES = (
    *("shape", "mesh", "size", "factor", "noise", "scale", "passes"),
    *("method", "digest", "protocol"),
)
READ = "read"  # what a process sends once it has its shape
POLL = 0.5  # seconds between looks at the clock where there is a limit
# Modules that every task wants, loaded once: processes are then forked in milliseconds.
PRELOAD = ["super_sdf.evaluation.measuring"]

Progress = Callable[[int, int, Task, float], None]
"""Called with (tasks done, tasks in all, the task just done, the share of the work done)."""


@dataclass(frozen=True)
class LeftOut:
    """A shape that could not be measured at all, and why."""

    shape: str
    reason: str


class Store:
    """The rows of a file of JSON lines, by key."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: dict[tuple[Any, ...], Row] = {}
        text = path.read_text() if path.exists() else ""
        for line in text.splitlines():
            with suppress(ValueError):  # a line that was being written when the writer was killed
                self._take(json.loads(line))
        if text and not text.endswith("\n"):
            self._write("\n")

    def add(self, row: Row) -> None:
        """Keep a row, in memory and in the file."""
        self._take(row)
        self._write(json.dumps(row) + "\n")

    def get(self, task: Task, method: str) -> Row | None:
        """Return a method's row, if it was measured."""
        key = task.key(method)
        return self.rows.get(tuple(key[name] for name in KEY_NAMES))

    def is_final(self, task: Task, method: str) -> bool:
        """Say whether a row is there that another run would not better.

        A failure may have had a passing cause; one by the limit has not, unless given more time.
        """
        row = self.get(task, method)
        if row is None or row["error"] is None:
            return row is not None
        limit = row.get("limit")
        return limit is not None and task.limit is not None and limit >= task.limit

    def _take(self, row: Row) -> None:
        if row.get("protocol") == PROTOCOL:
            self.rows[tuple(row[name] for name in KEY_NAMES)] = row

    def _write(self, text: str) -> None:
        with self.path.open("a") as out:
            out.write(text)


@dataclass(eq=False)
class Running:
    """A task under way: its process, the pipe that its rows come by, what it has still to send.

    ``began`` is when it had read its shape; the limit counts from there.
    """

    task: Task
    process: BaseProcess
    rows: Connection
    owed: list[str]
    began: float | None = None

    def is_late(self) -> bool:
        """Say whether its time is over."""
        if self.began is None or self.task.limit is None:
            return False
        return time.monotonic() - self.began > self.task.limit


class Runner:
    """Measures tasks, so many at a time; iterate over ``results``."""

    def __init__(self, tasks: Sequence[Task], jobs: int) -> None:
        self.waiting, self.jobs = list(reversed(tasks)), jobs
        self.running: dict[Connection, Running] = {}
        self.left_out: set[Path] = set()
        self.context = make_context()

    def results(self) -> Iterator[tuple[Task, Row | LeftOut | None]]:
        """Yield each row as it comes, with None after the last one of a task."""
        try:
            while self.waiting or self.running:
                while self.waiting and len(self.running) < self.jobs:
                    task = self.waiting.pop()
                    if task.path in self.left_out:
                        yield task, None
                    else:
                        self._start(task)
                for source in wait(list(self.running), POLL):
                    yield from self._receive(self.running[source])  # type: ignore[index]
                for late in [entry for entry in self.running.values() if entry.is_late()]:
                    yield from self._give_up(late, f"over the limit of {late.task.limit:g} s")
        finally:
            for entry in self.running.values():
                entry.process.kill()

    def _start(self, task: Task) -> None:
        ours, theirs = self.context.Pipe(duplex=False)
        process = self.context.Process(target=work, args=(task, theirs), daemon=True)  # type: ignore[attr-defined]
        process.start()
        theirs.close()
        self.running[ours] = Running(task, process, ours, list(task.methods))

    def _receive(self, entry: Running) -> Iterator[tuple[Task, Row | LeftOut | None]]:
        """Take what a process has sent; if it ended owing rows, the first of them has failed."""
        try:
            found: Row | LeftOut | str = entry.rows.recv()
        except EOFError:
            entry.process.join()
            yield from self._give_up(entry, f"its process ended with {entry.process.exitcode}")
            return
        if isinstance(found, LeftOut):
            yield from self._leave_out(entry, found.reason)
        elif isinstance(found, str):
            entry.began = time.monotonic()
        else:
            entry.owed.remove(found["method"])
            yield entry.task, found

    def _leave_out(self, entry: Running, reason: str) -> Iterator[tuple[Task, LeftOut]]:
        """Drop what a task owes; name its shape, once."""
        entry.owed = []
        if entry.task.path not in self.left_out:
            self.left_out.add(entry.task.path)
            yield entry.task, LeftOut(entry.task.path.stem, reason)

    def _give_up(self, entry: Running, error: str) -> Iterator[tuple[Task, Row | LeftOut | None]]:
        """End a task; what it owes after the method under way is put back in the queue."""
        entry.process.kill()
        entry.process.join()
        del self.running[entry.rows]
        entry.rows.close()
        if entry.owed and entry.began is None:
            yield from self._leave_out(entry, f"while it was read {error}")
        if entry.owed:
            task, limit = entry.task, entry.task.limit if entry.is_late() else None
            row = failed_row(task, Shape.read(task.path), entry.owed[0], error)
            yield task, {**row, "limit": limit}
        if entry.owed[1:]:
            self.waiting.append(replace(entry.task, methods=tuple(entry.owed[1:])))
        else:
            yield entry.task, None


def make_context() -> multiprocessing.context.BaseContext:
    """Return how processes are started: forked from one that has the modules, where there is."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOAD)
    return context


def work(task: Task, rows: Connection) -> None:
    """Measure a task in a process of its own; send ``READ`` and rows, or why there are none."""
    try:
        shape = Shape.read(task.path)
    except SuperSdfError as error:
        rows.send(LeftOut(task.path.stem, str(error)))
        return
    rows.send(READ)
    for row in measure_task(task, shape):
        rows.send(row)


def missing_tasks(tasks: Sequence[Task], store: Store) -> list[Task]:
    """Return the tasks with the methods that are not in the store."""
    cut = [
        replace(task, methods=tuple(m for m in task.methods if not store.is_final(task, m)))
        for task in tasks
    ]
    return [task for task in cut if task.methods]


def expected_work(task: Task) -> float:
    """Return about how long a task takes: it grows with the fine lattice's axis."""
    return 1 + task.setting.size * task.setting.factor**task.setting.passes / 40


def complete(
    tasks: Sequence[Task], store: Store, jobs: int, progress: Progress | None = None
) -> list[LeftOut]:
    """Measure what is not in the store, and keep it; return the shapes that were left out."""
    missing = missing_tasks(tasks, store)
    left_out: list[LeftOut] = []
    done, work_done, work = 0, 0.0, sum(map(expected_work, missing))
    for task, found in Runner(missing, jobs).results():
        if isinstance(found, LeftOut):
            left_out.append(found)
        elif found is not None:
            store.add(found)
        else:
            done += 1
            work_done += expected_work(task)
            if progress:
                progress(done, len(missing), task, work_done / work)
    return left_out
