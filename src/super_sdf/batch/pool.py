"""Worker processes, of which any may die without harm to the others.

Each worker is an executor of one process, which gets one task at a time: so the task of a worker
that dies is known, and a new worker takes its place.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from typing import Any, NamedTuple, TypeVar

from ..errors import SuperSdfError

Task = TypeVar("Task")
MOST_DEATHS = 5  # in a row, without any result between them
EXIT_SECONDS = 10.0  # that a broken process may take to end
SPAWN = multiprocessing.get_context("spawn")  # forking harms the threads of onnxruntime


class Death(NamedTuple):
    """The result of a task whose worker died."""

    cause: str


class Worker:
    """A process that works at one task at a time."""

    def __init__(self) -> None:
        os.environ.setdefault("PYTHONSAFEPATH", "1")  # import nothing from the current folder
        before = set(multiprocessing.active_children())
        self.executor = ProcessPoolExecutor(1, SPAWN, _prepare)
        self.executor.submit(int)  # starts the process
        (self.process,) = set(multiprocessing.active_children()) - before

    def end(self, seconds: float = 0.0) -> str:
        """Kill the process if it does not end by itself in time; return how it ended."""
        self.process.join(seconds)
        self.process.kill()
        self.process.join()
        self.executor.shutdown(wait=False, cancel_futures=True)
        return describe_exit(self.process.exitcode)


def work_in_processes(
    take: Callable[[], Task | None], work: Callable[[Task], Any], count: int
) -> Generator[tuple[Task, Any], None, None]:
    """Yield tasks with their results, or a Death, as ``count`` processes complete them.

    ``take`` returns the next task, None while there is none; ``work`` is a function that can be
    pickled. What it raises is raised here. SuperSdfError if processes only die.
    """
    workers: list[Worker] = []
    idle: list[Worker] = []
    running: dict[Future[Any], tuple[Worker, Task]] = {}
    deaths = 0
    try:
        while True:
            while len(running) < count and (task := take()) is not None:
                if not idle:
                    idle.append(Worker())
                    workers.append(idle[-1])
                worker = idle.pop()
                running[_submit(worker, work, task)] = worker, task
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                worker, task = running.pop(future)
                try:
                    result = future.result()
                    idle.append(worker)
                    deaths = 0
                except BrokenProcessPool:
                    result, deaths = Death(worker.end(EXIT_SECONDS)), deaths + 1
                    if deaths == MOST_DEATHS:
                        raise SuperSdfError(
                            f"{deaths} processes in a row ended; the last one {result.cause}: try "
                            "--jobs 1"
                        ) from None
                yield task, result
    finally:
        for worker in workers:
            worker.end()


def _submit(worker: Worker, work: Callable[[Task], Any], task: Task) -> Future[Any]:
    """Give a task to a worker; one that died since its last task is found out as the others are."""
    try:
        return worker.executor.submit(work, task)
    except BrokenProcessPool as error:
        broken: Future[Any] = Future()
        broken.set_exception(error)
        return broken


def describe_exit(code: int | None) -> str:
    """Return how a process ended, as a verb: "was killed by SIGTERM"."""
    if code is None or code >= 0:
        return f"ended with exit code {code}"
    name = f"signal {-code}"
    with suppress(ValueError):  # a signal without a name
        name = signal.Signals(-code).name
    return f"was killed by {name}{' (most likely out of memory)' * (name == 'SIGKILL')}"


def _prepare() -> None:
    """Leave Ctrl-C to the parent, and end with it, even by a kill: an orphan would go on."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
