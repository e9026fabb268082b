"""Runs the tasks of an evaluation, each in a process of its own.

So a task that crashes, or runs out of memory or time, harms no other, and its memory is its own.
"""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from ..machine.pool import Death, Pool, PoolOptions
from ..machine.serving import ClockStarted, Tell, Work
from .cases import Shape
from .measuring import Measurement, Task, failed_row, measure_task, reason_of
from .store import Store

OnTask = Callable[[int, int, str, float], None]
"""Called after each task: (tasks done, tasks in all, name of the task, share of the work done)."""


@dataclass(frozen=True)
class LeftOut:
    """A shape that could not be measured, or not everywhere, and why."""

    shape: str
    reason: str


Result = tuple[Task, Measurement | LeftOut | None]
"""A row of a task; or why its shape is left out; or None when the task is finished."""


def prepare() -> Work:
    """Return what works at a task: each worker process calls this once."""
    return work


def work(task: Task, tell: Tell) -> LeftOut | None:
    """Read a task's shape and tell a row for each method; return why the shape is left out, if so.

    The time limit counts from when the shape was read.
    """
    try:
        shape = Shape.read(task.path, task.turned)
    except Exception as problem:  # the other shapes still count
        return LeftOut(task.path.stem, reason_of(problem))
    tell(ClockStarted())
    for row in measure_task(task, shape):
        tell(row)
    return None


class Runner:
    """Measures tasks, several at a time; iterate over ``results``.

    Attributes
    ----------
    waiting : deque of Task
        What is still to be started.
    started : set of Task
        The tasks whose shapes were read.
    unmeasured : dict of lists
        The methods of each task under way that have no row yet, in the order of measuring.
    tried : set of Task
        The tasks whose process died before it had read the shape.
    left_out : set of Path
        The shapes that are left out.
    """

    def __init__(self, tasks: Sequence[Task], jobs: int) -> None:
        self.waiting, self.jobs = deque(tasks), jobs
        self.started: set[Task] = set()
        self.unmeasured: dict[Task, list[str]] = {}
        self.tried: set[Task] = set()
        self.left_out: set[Path] = set()

    def results(self) -> Generator[Result, None, None]:
        """Yield each row as it arrives, and None when a task is finished."""
        options: PoolOptions[Task] = PoolOptions(
            time_limit=lambda task: task.limit, start_method=make_context(), is_reused=False
        )
        with closing(Pool(self.waiting, prepare, options).results(self.jobs)) as results:
            for task, result in results:
                if isinstance(result, ClockStarted):
                    self.started.add(task)
                elif isinstance(result, Death):
                    yield from self._take_death(task, result)
                elif isinstance(result, LeftOut):
                    yield from self._leave_out(task, result.reason)
                elif result is None:
                    yield task, None
                else:
                    self._methods_left(task).remove(result["method"])
                    yield task, result

    def _methods_left(self, task: Task) -> list[str]:
        """Return the methods of a task that have no row yet; the first one is under way."""
        return self.unmeasured.setdefault(task, list(task.methods))

    def _take_death(self, task: Task, death: Death) -> Iterator[Result]:
        """Yield the failure of the method that was under way; queue the methods after it.

        At a time limit, all that are left fail: the limit is for a peer and what needs its mesh.
        """
        reason = death.cause if death.is_late else f"its process {death.cause}"
        if task not in self.started:
            yield from self._try_again(task, f"while it was read {reason}")
            return
        methods = self._methods_left(task)
        failed = methods if death.is_late else methods[:1]
        limit = task.limit if death.is_late else None
        for method in failed:
            yield task, {**failed_row(task, method, reason), "limit": limit}
        if len(methods) > len(failed):
            self.waiting.appendleft(replace(task, methods=tuple(methods[1:])))
        else:
            yield task, None

    def _try_again(self, task: Task, reason: str) -> Iterator[Result]:
        """Queue a task again whose process died before it had read the shape; but only once.

        The first time somebody may have killed it. The second time the shape is to blame.
        """
        if task in self.tried:
            yield from self._leave_out(task, reason)
        else:
            self.tried.add(task)
            self.waiting.appendleft(task)

    def _leave_out(self, task: Task, reason: str) -> Iterator[Result]:
        """Leave out a shape: name it once, and finish this task and those that wait for it."""
        if task.path not in self.left_out:
            self.left_out.add(task.path)
            yield task, LeftOut(task.path.stem, reason)
        dropped = [other for other in self.waiting if other.path == task.path]
        for other in dropped:
            self.waiting.remove(other)
        for finished in [task, *dropped]:
            yield finished, None


def make_context() -> multiprocessing.context.BaseContext:
    """Return how processes are started: forked from a server that has this module, where possible.

    A fork takes milliseconds, and there is one for each task.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    return context


def missing_tasks(tasks: Sequence[Task], store: Store) -> list[Task]:
    """Return the tasks that have methods without a final row in the store, cut to those methods."""
    cut = [
        replace(task, methods=tuple(m for m in task.methods if not store.is_final(task, m)))
        for task in tasks
    ]
    return [task for task in cut if task.methods]


def expected_work(task: Task) -> float:
    """Return about how long a task takes: each method grows with the fine lattice's axis."""
    each = 1 + task.setting.size * task.setting.factor**task.setting.passes / 40
    return each * len(task.methods)


def complete(
    tasks: Sequence[Task], store: Store, jobs: int, on_task: OnTask | None = None
) -> list[LeftOut]:
    """Measure what the store lacks and keep it there; return the shapes that were left out."""
    missing = missing_tasks(tasks, store)
    left_out: list[LeftOut] = []
    done, work_done, whole_work = 0, 0.0, sum(map(expected_work, missing))
    with closing(Runner(missing, jobs).results()) as results:  # that ends the processes
        for task, result in results:
            if isinstance(result, LeftOut):
                left_out.append(result)
            elif result is not None:
                store.add(result)
            else:
                done += 1
                work_done += expected_work(task)
                if on_task:
                    on_task(done, len(missing), str(task), work_done / whole_work)
    return left_out
