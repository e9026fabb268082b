"""Several processes that work at tasks, any of which may die without harm to the others.

Processes are spawned: that works on every system, and beside the threads of onnxruntime, which a
fork does not survive. Each is given a task at a time, once it is ready for one, so that who dies is
known by its task.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from ..errors import SuperSdfError
from .serving import Prepare, Ready, Refusal, ending_signals_blocked, serve

Task = TypeVar("Task")
Given = TypeVar("Given", covariant=True)
MOST_FALSE_STARTS = 5  # processes in a row that end before they are ready


class Death(NamedTuple):
    """The answer of a process that ended at its task: how."""

    cause: str


class Tasks(Protocol[Given]):
    """What is to be done, such as a deque; how many, and which, may change with every answer."""

    def __len__(self) -> int:
        """Return how many tasks may be begun now."""

    def popleft(self) -> Given:
        """Return the next one, which is begun with that."""


@dataclass(eq=False)
class Worker(Generic[Task]):
    """A process, the pipe to it, and its task; ``ready`` once it can take one."""

    process: SpawnProcess
    pipe: Connection
    task: Task | None = None
    ready: bool = False


class Pool(Generic[Task]):
    """Several processes; iterate over ``results``.

    Parameters
    ----------
    tasks : Tasks
        What is to be done. A task is taken when a process begins it.
    prepare : callable
        Called without arguments in each process, it returns the function that answers a task. Both
        it and what the function is given and returns go from process to process by pickle.
    clean : callable
        Called with a task and the number of the process that ended at it, to remove what it left.
    """

    def __init__(
        self, tasks: Tasks[Task], prepare: Prepare, clean: Callable[[Task, int], None]
    ) -> None:
        self.tasks, self.prepare, self.clean = tasks, prepare, clean
        self.workers: dict[Connection, Worker[Task]] = {}
        self.false_starts = 0

    def results(self, count: int) -> Iterator[tuple[Task, Any]]:
        """Run the tasks in ``count`` processes; yield each when done, with its answer or a Death.

        Raises
        ------
        SuperSdfError
            If no process can be started, or what ``prepare`` raised.
        """
        try:
            while self._fill(count):
                for pipe in wait(list(self.workers)):
                    yield from self._receive(self.workers[pipe])  # type: ignore[index]
        finally:
            for worker in list(self.workers.values()):
                self._end(worker)

    def _fill(self, count: int) -> bool:
        """Start what processes are wanting; say whether there is something to wait for."""
        while len(self.workers) < count and self._count_loading() < len(self.tasks):
            try:
                self._start()
            except OSError as error:  # too many files, or processes: those that run do the work
                if not self.workers:
                    raise SuperSdfError(
                        f"no process can be started: {error.strerror}: try --jobs 1"
                    ) from error
                break
        busy = any(worker.task is not None for worker in self.workers.values())
        return busy or len(self.tasks) > 0

    def _count_loading(self) -> int:
        return sum(not worker.ready for worker in self.workers.values())

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=serve, args=(theirs, self.prepare), daemon=True)
        try:
            with ending_signals_blocked():  # so that no process is started and not known
                process.start()
                self.workers[ours] = Worker(process, ours)
        except OSError:
            ours.close()
            raise
        finally:
            theirs.close()

    def _receive(self, worker: Worker[Task]) -> Iterator[tuple[Task, Any]]:
        """Take what a process has sent: that it is ready, that it cannot be, or an answer."""
        try:
            said = worker.pipe.recv()
        except Exception:  # the pipe's end, half a pickle, or one that cannot be read
            yield from self._bury(worker)
            return
        if isinstance(said, Refusal):
            raise said.error
        if isinstance(said, Ready):
            worker.ready, self.false_starts = True, 0
        elif worker.task is not None:
            task, worker.task = worker.task, None
            yield task, said
        self._give(worker)

    def _give(self, worker: Worker[Task]) -> None:
        """Give a process its next task, or see it off if there is none."""
        if not len(self.tasks):
            self._end(worker)
            return
        worker.task = self.tasks.popleft()
        with suppress(OSError):  # it has died: the pipe will say so to who listens
            worker.pipe.send(worker.task)

    def _bury(self, worker: Worker[Task]) -> Iterator[tuple[Task, Death]]:
        """Note what a dead process was at."""
        self._end(worker)
        cause = describe_end(worker.process.exitcode)
        if not worker.ready:
            self.false_starts += 1
            if self.false_starts == MOST_FALSE_STARTS:
                raise SuperSdfError(
                    f"{MOST_FALSE_STARTS} processes in a row ended before they were ready, the "
                    f"last {cause}: try --jobs 1"
                )
        elif worker.task is not None:
            yield worker.task, Death(cause)

    def _end(self, worker: Worker[Task]) -> None:
        """See a process off, with what it leaves."""
        worker.process.kill()
        worker.process.join()
        if self.workers.pop(worker.pipe, None):
            worker.pipe.close()
        if worker.process.pid and worker.task is not None:
            self.clean(worker.task, worker.process.pid)


def describe_end(code: int | None) -> str:
    """Say how a process ended that should not have."""
    if code is None or code >= 0:
        return f"ended with exit code {code}"
    with suppress(ValueError):  # a signal without a name
        name = signal.Signals(-code).name
        hint = " (for want of memory, mostly)" if name == "SIGKILL" else ""
        return f"died of {name}{hint}"
    return f"died of signal {-code}"
