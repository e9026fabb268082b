"""Several processes that convert, any of which may die without harm to the others.

Processes are spawned: that works on every system, and beside the threads of onnxruntime, which a
fork does not survive. Each is given a job at a time, so that who dies is known by its file.
"""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path

from ..errors import DeviceError, SuperSdfError
from .job import Job, Result, failed_row
from .lock import remove_parts
from .workers import Begin, Loading, serve


@dataclass(eq=False)
class Worker:
    """A process, the pipe to it, and the job that it is at; ``ready`` once it has its network."""

    process: SpawnProcess
    pipe: Connection
    job: Job
    ready: bool = False


class Pool:
    """Several processes; iterate over ``results``."""

    def __init__(self, jobs: Iterator[Job], folder: Path, loading: Loading, begin: Begin) -> None:
        self.jobs, self.folder, self.loading, self.begin = jobs, folder, loading, begin
        self.busy: dict[Connection, Worker] = {}

    def results(self, count: int) -> Iterator[Result]:
        """Convert with so many processes; yield each file as it is done.

        Raises
        ------
        SuperSdfError
            If a process cannot load the network.
        """
        try:
            for _ in range(count):
                self._start()
            while self.busy:
                for pipe in wait(list(self.busy)):
                    yield from self._receive(self.busy[pipe])  # type: ignore[index]
        finally:
            for worker in list(self.busy.values()):
                self._end(worker)

    def _start(self) -> None:
        """Start a process, if there is a job for it."""
        job = next(self.jobs, None)
        if job is None:
            return
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=serve, args=(theirs, self.folder, self.loading))
        with deaf_to_interrupts():  # children inherit it: Ctrl-C is for the parent to handle
            process.start()
        theirs.close()
        self.busy[ours] = Worker(process, ours, job)
        self._give(self.busy[ours], job)

    def _give(self, worker: Worker, job: Job) -> None:
        self.begin(job)
        worker.job = job
        with suppress(OSError):  # it has died: the pipe will say so to who listens
            worker.pipe.send(job)

    def _receive(self, worker: Worker) -> Iterator[Result]:
        """Take what a process has sent: that it is ready, that it cannot be, or a row."""
        try:
            said = worker.pipe.recv()
        except (EOFError, OSError):
            yield from self._bury(worker)
            return
        if isinstance(said, SuperSdfError):
            raise said
        if said is None:
            worker.ready = True
            return
        done, job = worker.job, next(self.jobs, None)
        if job is None:
            self._end(worker)
        else:
            self._give(worker, job)
        yield Result(done, said)

    def _bury(self, worker: Worker) -> Iterator[Result]:
        """Note what a dead process was at, and put another in its place."""
        self._end(worker)
        cause = describe_end(worker.process.exitcode)
        if not worker.ready:
            raise DeviceError(f"a worker {cause} before it had loaded the network: try --jobs 1")
        yield Result(worker.job, failed_row(worker.job, f"the process that converted it {cause}"))
        self._start()

    def _end(self, worker: Worker) -> None:
        """See a process off, with what it leaves."""
        del self.busy[worker.pipe]
        worker.process.kill()
        worker.process.join()
        worker.pipe.close()
        if worker.process.pid:
            remove_parts([self.folder / worker.job.target], worker.process.pid)


def describe_end(code: int | None) -> str:
    """Say how a process ended that should not have."""
    if code is None or code >= 0:
        return f"ended with exit code {code}"
    name = signal.Signals(-code).name
    hint = " (for want of memory, mostly)" if name == "SIGKILL" else ""
    return f"died of {name}{hint}"


@contextmanager
def deaf_to_interrupts() -> Iterator[None]:
    """Ignore Ctrl-C for a moment; only the main thread can, and need."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
