"""A supervised pool of worker processes: any of them may die without harm to the others.

Each worker has a pipe of its own and gets one task at a time, when it is ready for it. So the task
of a worker that dies is known, and what it was sending when it died harms no other worker.
"""

from __future__ import annotations

import multiprocessing
import signal
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import BaseContext
from multiprocessing.process import BaseProcess
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from ..errors import SuperSdfError
from .serving import (
    ClockStarted,
    Final,
    Prepare,
    PrepareFailed,
    Ready,
    ending_signals_blocked,
    python_flags,
    serve,
)

Task = TypeVar("Task")
TaskOut = TypeVar("TaskOut", covariant=True)
MAX_FAILED_STARTS = 5  # workers in a row that end before they are ready
EXIT_SECONDS = 10.0  # that a worker has to exit after it closed its pipe
SPAWN = multiprocessing.get_context("spawn")


class Death(NamedTuple):
    """The final result of a task whose worker died, or was killed at the task's time limit."""

    cause: str
    is_late: bool = False


class Tasks(Protocol[TaskOut]):
    """A queue of tasks, such as a deque; it may change whenever a result is yielded."""

    def __len__(self) -> int:
        """Return how many tasks can be started now."""

    def popleft(self) -> TaskOut:
        """Return the next task, which is started then."""


@dataclass(eq=False)
class Worker(Generic[Task]):
    """A worker process, the pipe to it, its current task, and when that has to be finished."""

    process: BaseProcess
    pipe: Connection
    is_ready: bool = False
    task: Task | None = None
    deadline: float | None = None


@dataclass(frozen=True)
class PoolOptions(Generic[Task]):
    """How a pool runs its workers.

    ``time_limit`` returns the seconds that a task may take from ``ClockStarted`` on. Spawning works
    on every system and is safe beside the threads of onnxruntime, unlike forking this process. A
    worker that is not reused takes one task alone.
    """

    time_limit: Callable[[Task], float | None] = lambda task: None
    start_method: BaseContext = SPAWN
    is_reused: bool = True


class Pool(Generic[Task]):
    """Worker processes that share a queue of tasks; each is taken when a worker starts it.

    ``prepare`` is called in each worker, and returns the function that works at a task. Tasks and
    results are pickled.
    """

    def __init__(
        self, tasks: Tasks[Task], prepare: Prepare, options: PoolOptions[Task] | None = None
    ) -> None:
        self.tasks, self.prepare = tasks, prepare
        self.options: PoolOptions[Task] = options or PoolOptions()
        self.workers: dict[Connection, Worker[Task]] = {}
        self.failed_starts = 0

    def results(self, count: int) -> Generator[tuple[Task, Any], None, None]:
        """Run the tasks in ``count`` workers.

        Yields the partial results of each task as they arrive, then its final result or a Death;
        SuperSdfError if no worker can be started, or what ``prepare`` raised.
        """
        try:
            while self._start_workers(count):
                deadlines = [w.deadline for w in self.workers.values() if w.deadline is not None]
                left = max(min(deadlines) - time.monotonic(), 0) if deadlines else None
                for pipe in wait(list(self.workers), left):
                    yield from self._receive(self.workers[pipe])  # type: ignore[index]
                yield from self._kill_late_workers()
        finally:
            for worker in list(self.workers.values()):
                self._stop(worker)

    def _start_workers(self, count: int) -> bool:
        """Start the workers that are missing; return whether there is anything to wait for."""
        while len(self.workers) < count:
            if sum(not worker.is_ready for worker in self.workers.values()) >= len(self.tasks):
                break
            try:
                self._start_worker()
            except OSError as error:  # too many open files or processes: make do with fewer
                if not self.workers:
                    raise SuperSdfError(
                        f"no process can be started: {error.strerror}: try --jobs 1"
                    ) from error
                break
        is_busy = any(worker.task is not None for worker in self.workers.values())
        return is_busy or len(self.tasks) > 0

    def _start_worker(self) -> None:
        context = self.options.start_method
        ours, theirs = context.Pipe()
        process = context.Process(  # type: ignore[attr-defined]
            target=serve, args=(theirs, self.prepare), daemon=True
        )
        try:
            # no process may start without being noted here
            with python_flags(), ending_signals_blocked():
                process.start()
                self.workers[ours] = Worker(process, ours)
        except OSError:
            ours.close()
            raise
        finally:
            theirs.close()

    def _receive(self, worker: Worker[Task]) -> Iterator[tuple[Task, Any]]:
        """Take a message from a worker; yield the result that it brings, if any."""
        try:
            message = worker.pipe.recv()
        except Exception as error:
            if isinstance(error, (EOFError, OSError)):  # it has ended, perhaps while it was sending
                worker.process.join(EXIT_SECONDS)  # killed at once, it would lose its exit code
            yield from self._report_death(worker)  # else what it sent cannot be unpickled
            return
        if isinstance(message, PrepareFailed):
            raise message.error
        if isinstance(message, Ready):
            worker.is_ready, self.failed_starts = True, 0
            self._assign_task(worker)
        elif worker.task is not None:
            if isinstance(message.value, ClockStarted):
                limit = self.options.time_limit(worker.task)
                worker.deadline = None if limit is None else time.monotonic() + limit
            yield worker.task, message.value
            if isinstance(message, Final):
                worker.task = worker.deadline = None
                if self.options.is_reused:
                    self._assign_task(worker)
                else:
                    self._stop(worker)

    def _assign_task(self, worker: Worker[Task]) -> None:
        """Give a worker the next task, or stop it if there is none."""
        if not len(self.tasks):
            self._stop(worker)
            return
        worker.task = self.tasks.popleft()
        with suppress(OSError):  # it has died: the next read from its pipe will show that
            worker.pipe.send(worker.task)

    def _kill_late_workers(self) -> Iterator[tuple[Task, Death]]:
        """Kill the workers whose tasks are over their time limits; yield those tasks."""
        now = time.monotonic()
        for worker in list(self.workers.values()):
            if worker.deadline is not None and worker.task is not None and worker.deadline <= now:
                self._stop(worker)
                limit = self.options.time_limit(worker.task)
                yield worker.task, Death(f"over the limit of {limit:g} s", is_late=True)

    def _report_death(self, worker: Worker[Task]) -> Iterator[tuple[Task, Death]]:
        """Remove a dead worker; yield the task that it was working at."""
        self._stop(worker)
        cause = describe_exit(worker.process.exitcode)
        if not worker.is_ready:
            self.failed_starts += 1
            if self.failed_starts == MAX_FAILED_STARTS:
                raise SuperSdfError(
                    f"{MAX_FAILED_STARTS} processes in a row ended before they were ready; the "
                    f"last one {cause}: try --jobs 1"
                )
        elif worker.task is not None:
            yield worker.task, Death(cause)

    def _stop(self, worker: Worker[Task]) -> None:
        """Kill a worker if it still runs."""
        worker.process.kill()
        worker.process.join()
        if self.workers.pop(worker.pipe, None):
            worker.pipe.close()


def describe_exit(code: int | None) -> str:
    """Return how a process ended, as a verb: "was killed by SIGTERM"."""
    if code is None or code >= 0:
        return f"ended with exit code {code}" if (code or 0) < 256 else f"crashed ({code:#x})"
    with suppress(ValueError):  # a signal without a name
        name = signal.Signals(-code).name
        hint = " (most likely out of memory)" if name == "SIGKILL" else ""
        return f"was killed by {name}{hint}"
    return f"was killed by signal {-code}"
