"""Runs a batch.

To resume after a kill, or with new inputs or other options, run it again: it does only what is not
done yet with the same content and options. A failure caused by the input stands until the input
changes; others, such as a killed process or a full disk, are tried again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial

from ..errors import OptionError
from ..machine.memory import free_memory
from .pool import Death, Pool, Work
from ..threads import allot_each, count_cores
from ..network.device import available_devices
from .job import Job, Result, Settings, attempt, failed_row
from .ledger import Ledger, Row
from .plan import Batch, Planner, expected_work

# In units of ``expected_work``: done in the time that worker processes would take to start.
SMALL_BATCH = 30_000
BYTES_PER_WORKER = 10**9  # for the network and a grid of 128^3, where --jobs is not given
MIN_BYTES_PER_WORKER = 3 * 10**8  # with less a worker cannot convert anything

OnFile = Callable[[Batch], None]
"""Called after each file, with the batch as it stands."""

Results = Generator[tuple[Job, Row | Death], None, None]
"""Jobs as they end, each with its row, or with a Death if its process ended."""


class Run:
    """A batch that runs in its output folder, which is locked meanwhile."""

    def __init__(self, jobs: Sequence[Job], settings: Settings) -> None:
        self.settings = settings
        self.ledger = Ledger(settings.folder)
        self.planner = Planner(jobs, settings, self.ledger)
        self.batch = self.planner.plan()
        self.died: set[str] = set()  # outputs whose worker died once

    def complete(
        self, on_file: OnFile | None = None, warn: Callable[[str], None] | None = None
    ) -> None:
        """Convert what is to be converted; call ``on_file`` after each file is in the ledger.

        ``warn`` is called with what may be wrong with the workers of a cluster; without it, that is
        among the notes.
        """
        start = time.perf_counter()
        for job, row in self.batch.failed_before:  # refused outputs that the ledger does not have
            known = self.ledger.rows.get(job.target, {})
            if row is not known and row["reason"] != known.get("reason"):
                self.ledger.add(row)
        self.ledger.remove_parts()
        try:
            with closing(self._convert(warn or self.batch.notes.append)) as results:
                for job, result in results:
                    self._take(job, result)
                    self.batch.seconds = time.perf_counter() - start
                    if on_file:
                        on_file(self.batch)
        finally:  # also what the workers of a killed batch wrote for a moment more
            self.ledger.close()

    def _convert(self, warn: Callable[[str], None]) -> Results:
        """Convert in this process, in processes or on a cluster."""
        settings = self.settings
        if not self.batch.waiting or self.is_over():
            return
        workers = self._count_workers()
        memory = self.batch.waiting[0].options.max_memory
        if settings.cluster is not None:
            raise OptionError("--cluster is not there yet: leave it out")
        elif workers > 1:  # decided once, before the workers fill the memory
            share = allot_each(workers, settings.threads, memory)
            prepare = partial(prepare_worker, settings, share.threads)
            yield from Pool(Queue(self, share.memory), prepare).results(workers)
        else:
            work, queue = prepare_worker(settings, settings.threads), Queue(self)
            while len(queue):
                job = queue.popleft()
                yield job, work(job)

    def _count_workers(self) -> int:
        """Return how many processes convert files; on a cluster of this machine also for few."""
        settings, jobs = self.settings, len(self.batch.waiting)
        memory = self.batch.waiting[0].options.max_memory
        if not settings.workers:
            jobs = jobs if settings.cluster or self.batch.work > SMALL_BATCH else 1
            return choose_workers(settings.device, jobs, memory)
        workers, note = useful_workers(settings.workers, jobs, memory)
        self.batch.notes += [note] if note else []
        return workers

    def is_over(self) -> bool:
        """Return whether no further job may be started."""
        return self.settings.fail_fast and bool(self.batch.failures())

    def _take(self, job: Job, result: Row | Death) -> None:
        """Keep the row of a job; if its worker died, try the job once more, after the others."""
        if not isinstance(result, Death):
            self._keep(job, result)
            return
        self.ledger.remove_parts()
        if job.target in self.died:
            reason = f"the process that converted it {result.cause}, twice"
            self._keep(job, failed_row(job, reason))
        else:
            self.died.add(job.target)
            self.batch.waiting.append(job)

    def _keep(self, job: Job, row: Row) -> None:
        """Put the row of a finished job into the ledger and count it."""
        row |= self.planner.record(job)
        if "labels" in row:
            row["beside"] = self.ledger.others(row)
        self.ledger.add(row)
        (self.batch.done if row["status"] == "ok" else self.batch.failed).append(Result(job, row))
        self.batch.work_done += expected_work(job)


class Queue:
    """The jobs of a run that were not started yet, and the bytes that each may hold, if limited.

    Whether a job may replace its output is decided when it starts: that may have changed meanwhile.
    """

    def __init__(self, run: Run, memory: int | None = None) -> None:
        self.run, self.memory = run, memory

    def __len__(self) -> int:
        return 0 if self.run.is_over() else len(self.run.batch.waiting)

    def popleft(self) -> Job:
        """Note in the ledger that the next job starts, and return it."""
        run = self.run
        job = run.batch.waiting.pop(0)
        run.ledger.start(job.target)
        job = replace(job, replace=run.planner.replaceable(job))
        if self.memory is None:
            return job
        return replace(job, options=replace(job.options, max_memory=self.memory))


def prepare_worker(settings: Settings, threads: int) -> Work:
    """Load the network; return the function that converts a job and returns its row."""
    network = settings.load_network(threads)
    return lambda job: attempt(job, settings, network)


def choose_workers(device: str, jobs: int, max_memory: int | None = None) -> int:
    """Return how many processes to use: one per core if memory allows; one on a GPU."""
    if device == "cuda" or (device == "auto" and "cuda" in available_devices()):
        return 1
    free = max_memory or free_memory()
    room = count_cores() if free is None else free // BYTES_PER_WORKER
    return max(1, min(count_cores(), room, jobs))


def useful_workers(asked: int, jobs: int, max_memory: int | None = None) -> tuple[int, str | None]:
    """Return how many of the processes asked for are useful, and a note if that is fewer."""
    limits = [
        (jobs, "there is no more to do"),
        (count_cores(), "this process may use no more cores"),
    ]
    if max_memory is not None:
        room = max(1, max_memory // MIN_BYTES_PER_WORKER)
        limits.append((room, "--max-memory has no room for more"))
    most, cause = min(limits)
    return min(asked, most), None if asked <= most else f"--jobs {asked} is cut to {most}: {cause}"
