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
from typing import Any, NamedTuple, TypeVar

from ..errors import SuperSdfError

Task = TypeVar("Task")
MOST_DEATHS = 5  # in a row, without any result between them
EXIT_SECONDS = 10.0  # that a broken process may take to end
SPAWN = multiprocessing.get_context("spawn")  # forking harms the threads of onnxruntime


class Death(NamedTuple):
    """The result of a task whose worker died."""

    cause: str  # a verb: "was killed by SIGKILL"


class Worker:
    """A process that works at one task at a time."""

    def __init__(self) -> None:
        os.environ.setdefault("PYTHONSAFEPATH", "1")  # import nothing from the current folder
        before = set(multiprocessing.active_children())
        self.executor = ProcessPoolExecutor(1, SPAWN, _prepare)
        self.executor.submit(int)  # starts the process
        (self.process,) = set(multiprocessing.active_children()) - before

    def submit(self, work: Callable[[Task], Any], task: Task) -> Future[Any]:
        """Start a task; if the process has died since the last one, the future says so."""
        try:
            return self.executor.submit(work, task)
        except BrokenProcessPool as error:
            broken: Future[Any] = Future()
            broken.set_exception(error)
            return broken

    def end(self, seconds: float = 0.0) -> Death:
        """Kill the process if it does not end by itself in time; return how it ended."""
        self.process.join(seconds)
        self.process.kill()
        self.process.join()
        self.executor.shutdown(wait=False, cancel_futures=True)
        code = self.process.exitcode or 0
        if code >= 0:
            return Death(f"ended with exit code {code}")
        hint = " (most likely out of memory)" * (code == -9)
        return Death(f"was killed by {signal.Signals(-code).name}{hint}")


def work_in_processes(
    take: Callable[[], Task | None], work: Callable[[Task], Any], count: int
) -> Generator[tuple[Task, Any], None, None]:
    """Yield tasks with their results, or a Death, as ``count`` processes complete them.

    ``take`` returns the next task, None while there is none; ``work`` is a function that can be
    pickled. What it raises is raised here. SuperSdfError if processes only die.
    """
    idle, running, deaths = list[Worker](), dict[Future[Any], tuple[Worker, Task]](), 0
    try:
        while True:
            while len(running) < count and (task := take()) is not None:
                worker = idle.pop() if idle else Worker()
                running[worker.submit(work, task)] = worker, task
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                worker, task = running[future]
                try:
                    result = future.result()
                    idle.append(worker)
                    deaths = 0
                except BrokenProcessPool:
                    result, deaths = worker.end(EXIT_SECONDS), deaths + 1
                    if deaths == MOST_DEATHS:
                        last = f"{deaths} processes in a row ended; the last one {result.cause}"
                        raise SuperSdfError(f"{last}: try --jobs 1") from None
                del running[future]
                yield task, result
    finally:
        for worker in (*idle, *(worker for worker, _ in running.values())):
            worker.end()


def _prepare() -> None:
    """Leave Ctrl-C to the parent, and end with it, even by a kill: an orphan would go on."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def follow() -> None:
        if parent:
            parent.join()
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
