"""A supervised pool of worker processes: any of them may die without harm to the others.

Each worker has a pipe of its own and gets one task at a time, when it is ready for it. So the task
of a worker that dies is known, and what it was sending when it died harms no other worker.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import util
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from multiprocessing.spawn import get_executable
from pathlib import Path
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from ..errors import SuperSdfError

Task = TypeVar("Task")
TaskOut = TypeVar("TaskOut", covariant=True)
MAX_FAILED_STARTS = 5  # workers in a row that end before they are ready
EXIT_SECONDS = 10.0  # that a worker has to exit after it closed its pipe
# It works on every system and beside the threads of onnxruntime, unlike forking this process.
SPAWN = multiprocessing.get_context("spawn")
# ``python -c``, which multiprocessing starts, imports from the current folder unless told not to.
# Python 3.10 knows only -I: what that leaves out, multiprocessing hands over with the path.
SAFE_PATH = "-P" if sys.version_info >= (3, 11) else "-I"

Work = Callable[[Any], Any]
"""Works at a task; returns its result."""

Prepare = Callable[[], Work]
"""Called once in each worker, to load a network, say; returns what works at the tasks."""


class Death(NamedTuple):
    """The result of a task whose worker died."""

    cause: str


class Tasks(Protocol[TaskOut]):
    """A queue of tasks, such as a deque; it may change whenever a result is yielded."""

    def __len__(self) -> int:
        """Return how many tasks can be started now."""

    def popleft(self) -> TaskOut:
        """Return the next task, which is started then."""


@dataclass(eq=False)
class Worker(Generic[Task]):
    """A worker process, the pipe to it, and its current task."""

    process: BaseProcess
    pipe: Connection
    is_ready: bool = False
    task: Task | None = None


class Pool(Generic[Task]):
    """Worker processes that share a queue of tasks; each is taken when a worker starts it.

    ``prepare`` is called in each worker, and returns the function that works at a task. Tasks and
    results are pickled.
    """

    def __init__(self, tasks: Tasks[Task], prepare: Prepare) -> None:
        self.tasks, self.prepare = tasks, prepare
        self.workers: dict[Connection, Worker[Task]] = {}
        self.failed_starts = 0

    def results(self, count: int) -> Generator[tuple[Task, Any], None, None]:
        """Run the tasks in ``count`` workers; yield each with its result, or a Death.

        SuperSdfError if no worker can be started, or what ``prepare`` raised.
        """
        try:
            while self._start_workers(count):
                for pipe in wait(list(self.workers)):
                    yield from self._receive(self.workers[pipe])  # type: ignore[index]
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
        ours, theirs = SPAWN.Pipe()
        process = SPAWN.Process(target=_serve, args=(theirs, self.prepare), daemon=True)
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
        """Take a message from a worker, see ``_serve``; yield the result, if it is one."""
        try:
            message = worker.pipe.recv()
        except Exception as error:
            if isinstance(error, (EOFError, OSError)):  # it has ended, perhaps while it was sending
                worker.process.join(EXIT_SECONDS)  # killed at once, it would lose its exit code
            yield from self._report_death(worker)  # else what it sent cannot be unpickled
            return
        if worker.task is not None:
            yield worker.task, message
        elif message is not None:
            raise message
        else:
            worker.is_ready, self.failed_starts = True, 0
        worker.task = None
        if not len(self.tasks):
            self._stop(worker)
            return
        worker.task = self.tasks.popleft()
        with suppress(OSError):  # it has died: the next read from its pipe will show that
            worker.pipe.send(worker.task)

    def _report_death(self, worker: Worker[Task]) -> Iterator[tuple[Task, Death]]:
        """Remove a dead worker; yield the task that it was working at."""
        self._stop(worker)
        cause = describe_exit(worker.process.exitcode)
        if worker.task is not None:
            yield worker.task, Death(cause)
        elif not worker.is_ready:
            self.failed_starts += 1
            if self.failed_starts == MAX_FAILED_STARTS:
                raise SuperSdfError(
                    f"{MAX_FAILED_STARTS} processes in a row ended before they were ready; the "
                    f"last one {cause}: try --jobs 1"
                )

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


def _serve(pipe: Connection, prepare: Prepare) -> None:
    """Run a worker process: take tasks from the pipe and send their results, until it closes.

    The first message is None if it is ready, or why no worker can be.
    """
    settle_signals()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(EOFError, ConnectionError):  # the parent has ended, or needs no more workers
        try:
            work = prepare()
        except Exception as error:  # even a bug is reported by the parent in one line
            line = f"{type(error).__name__}: {error}".split("\n")[0]
            pipe.send(error if isinstance(error, SuperSdfError) else SuperSdfError(line))
            return
        pipe.send(None)
        while True:
            pipe.send(work(pipe.recv()))


def _end_with_parent() -> None:
    """End this process when its parent ends, even by a kill: an orphan would go on writing."""
    if parent := multiprocessing.parent_process():
        wait([parent.sentinel])
        os._exit(1)


def settle_signals() -> None:
    """Ignore Ctrl-C, which the parent handles, and unblock what it had blocked at the start."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ending_signals())


def ending_signals() -> set[signal.Signals]:
    """Return the signals of this system that ask a process to end; Windows has no SIGHUP."""
    names = ("SIGINT", "SIGTERM", "SIGHUP")
    return {getattr(signal, name) for name in names if hasattr(signal, name)}


@contextmanager
def ending_signals_blocked() -> Iterator[None]:
    """Block the signals that end in this thread and in processes that it starts.

    Windows cannot block signals; nothing happens there.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # otherwise it lifts the block when it is first needed
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ending_signals())
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def python_flags(*flags: str) -> Iterator[None]:
    """Start Pythons within the block with ``SAFE_PATH`` and other flags, from whatever thread."""
    usual = util._args_from_interpreter_flags  # type: ignore[attr-defined]
    util._args_from_interpreter_flags = lambda: [*usual(), SAFE_PATH, *flags]  # type: ignore[attr-defined]
    try:
        yield
    finally:
        util._args_from_interpreter_flags = usual  # type: ignore[attr-defined]


def isolated_python(code: str) -> list[str]:
    """Return the command of a Python that runs ``code`` and finds modules where this one does.

    It takes nothing from the current folder.
    """
    own, here = str(Path(__file__).resolve().parents[2]), os.getcwd()
    folders = [own, *(path for path in sys.path if path and os.path.abspath(path) != here)]
    start = f"import sys; sys.path[:0] = sys.argv[1:]; {code}"
    return [get_executable(), "-I", "-c", start, *folders]
