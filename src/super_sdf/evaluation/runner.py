"""Processes that measure.

Each task runs in a process of its own, so that one that crashes, runs out of memory or out of time
takes nothing with it.
"""

from __future__ import annotations

import multiprocessing
import signal
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from . import measuring
from .cases import Shape
from .measuring import Row, Task, failed_row, measure_task, reason_of
from .store import Store

READ = "read"  # what a process sends once it has its shape
GRACE = 10.0  # seconds that a process has to end after its last row
POLL = 0.5  # seconds between looks at the clock where there is a limit
# Modules that every task wants, loaded once: processes are then forked in milliseconds.
PRELOAD = [measuring.__name__]

Progress = Callable[[int, int, Task, float], None]
"""Called with (tasks done, tasks in all, the task just done, the share of the work done)."""


@dataclass(frozen=True)
class LeftOut:
    """A shape that could not be measured, or not everywhere, and why."""

    shape: str
    reason: str


Found = tuple[Task, Row | LeftOut | None]
"""A row of a task, why its shape is left out, or None after the last of a task."""


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

    def end(self) -> None:
        """End the process, if it has not ended."""
        self.process.kill()
        self.process.join()
        self.rows.close()


class Runner:
    """Measures tasks, several at a time; iterate over ``results``."""

    def __init__(self, tasks: Sequence[Task], jobs: int) -> None:
        self.waiting, self.jobs = list(reversed(tasks)), jobs
        self.running: dict[Connection, Running] = {}
        self.left_out: set[Path] = set()
        self.tried: set[Task] = set()
        self.context = make_context()

    def results(self) -> Generator[Found, None, None]:
        """Yield each row as it comes, with None after the last one of a task."""
        try:
            while self.waiting or self.running:
                while self.waiting and len(self.running) < self.jobs:
                    yield from self._start(self.waiting.pop())
                for source in wait(list(self.running), POLL):
                    yield from self._receive(self.running[source])  # type: ignore[index]
                for late in [entry for entry in self.running.values() if entry.is_late()]:
                    yield from self._give_up(late, f"over the limit of {late.task.limit:g} s")
        finally:
            for entry in self.running.values():
                entry.process.kill()

    def _start(self, task: Task) -> Iterator[Found]:
        """Start a process for a task, unless its shape is left out by now."""
        if task.path in self.left_out:
            yield task, None
            return
        ours, theirs = self.context.Pipe(duplex=False)
        process = self.context.Process(target=work, args=(task, theirs), daemon=True)  # type: ignore[attr-defined]
        try:
            process.start()
        except OSError as error:  # no more processes or files, or it was killed in between
            ours.close()
            yield from self._try_again(task, f"its process did not start: {error.strerror}")
        else:
            self.running[ours] = Running(task, process, ours, list(task.methods))
        finally:
            theirs.close()

    def _receive(self, entry: Running) -> Iterator[Found]:
        """Take what a process has sent; if it ended owing rows, the first of them has failed."""
        try:
            found: Row | LeftOut | str = entry.rows.recv()
        except (EOFError, OSError):  # the latter if it was killed while it sent
            entry.process.join(GRACE)
            yield from self._give_up(entry, how_it_ended(entry.process.exitcode))
            return
        if isinstance(found, LeftOut):
            yield from self._leave_out(entry.task, found.reason)
            entry.owed = []
        elif isinstance(found, str):
            entry.began = time.monotonic()
        else:
            entry.owed.remove(found["method"])
            yield entry.task, found

    def _leave_out(self, task: Task, reason: str) -> Iterator[Found]:
        """Name the shape of a task as left out, once."""
        if task.path not in self.left_out:
            self.left_out.add(task.path)
            yield task, LeftOut(task.path.stem, reason)

    def _try_again(self, task: Task, reason: str) -> Iterator[Found]:
        """Put a task that did not come to its shape back in the queue; the second time, end it.

        Once may be somebody's kill. Twice, it is the shape that no process survives.
        """
        if task not in self.tried:
            self.tried.add(task)
            self.waiting.append(task)
            return
        yield from self._leave_out(task, reason)
        yield task, None

    def _give_up(self, entry: Running, reason: str) -> Iterator[Found]:
        """End a task's process; what it owes after the method under way goes back in the queue."""
        late, task = entry.is_late(), entry.task
        del self.running[entry.rows]
        entry.end()
        if entry.owed and entry.began is None:
            yield from self._try_again(task, f"while it was read {reason}")
            return
        if entry.owed:
            row = failed_row(task, entry.owed[0], reason)
            yield task, {**row, "limit": task.limit if late else None}
        if entry.owed[1:]:
            self.waiting.append(replace(task, methods=tuple(entry.owed[1:])))
        else:
            yield task, None


def how_it_ended(code: int | None) -> str:
    """Say how a process ended that still had to send something."""
    if code is None or code >= 0:
        return f"its process ended with exit code {code}"
    name = signal.Signals(-code).name
    hint = " (mostly for want of memory)" if name == "SIGKILL" else ""
    return f"its process died of {name}{hint}"


def make_context() -> multiprocessing.context.BaseContext:
    """Return how processes are started: forked from one that has the modules, where there is."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOAD)
    return context


def work(task: Task, rows: Connection) -> None:
    """Measure a task in a process of its own; send ``READ`` and rows, or why there are none."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent to handle
    with suppress(BrokenPipeError):  # nobody listens any more
        try:
            shape = Shape.read(task.path)
        except Exception as problem:  # the other shapes still count
            rows.send(LeftOut(task.path.stem, reason_of(problem)))
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
    with closing(Runner(missing, jobs).results()) as results:  # ends the processes, come what may
        for task, found in results:
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
