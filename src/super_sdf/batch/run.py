"""Many files: what is to be done, what was done before, and doing the rest.

A rerun is the way to go on, after a kill, with new inputs or other options: only what is not done
with the same content and the same options is done. Failures that the input is to blame for stand
until it changes; others, a killed process or a full disk, are tried again.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any

from ..files.parts import remove_abandoned_parts
from ..machine.memory import held_memory, memory_bound
from ..machine.pool import Death, Pool, PoolOptions
from ..machine.threads import count_cores
from .job import Job, Result, Row, failed_row
from .journal import read_journal
from .ledger import Ledger
from .lock import FolderLock
from .plan import Batch, Planner, Settings, expected_work
from .workers import Loading, choose_workers, convert_here, prepare_worker, useful_workers

# Of what ``expected_work`` counts: done in the time that several processes would take to start.
LITTLE = 30_000

OnFile = Callable[[Batch], None]
"""Called after each file, with the batch as it stands."""


class Run:
    """A batch under way in its folder, which no other may use meanwhile."""

    def __init__(self, jobs: Sequence[Job], settings: Settings, lock: FolderLock) -> None:
        self.settings, self.lock = settings, lock
        self.ledger = Ledger(settings.folder)
        lock.started -= self.ledger.written
        self.planner = Planner(settings, self.ledger, read_journal(settings.folder))
        self.batch = self.planner.plan(jobs)
        self.died: set[str] = set()  # outputs at which a process ended

    def complete(self, on_file: OnFile | None = None) -> None:
        """Do what is to be done; each file is in the ledger before the next is told of."""
        start = time.perf_counter()
        self._note_refused()
        with closing(self._convert()) as answers:
            for job, answer in answers:
                self._take(job, answer)
                self.batch.seconds = time.perf_counter() - start
                if on_file:
                    on_file(self.batch)

    def _convert(self) -> Generator[tuple[Job, Row | Death], None, None]:
        """Convert in this process or in several."""
        asked, folder = self.settings, self.settings.folder
        if not self.batch.waiting or self.is_over():
            return
        workers = self._count_workers()
        threads = asked.threads or (max(1, count_cores() // workers) if workers > 1 else 0)
        loading = Loading(asked.model, asked.precision, asked.device, threads)
        queue = Queue(self, workers)
        if workers == 1:
            yield from convert_here(queue, folder, loading)
        else:
            prepare = partial(prepare_worker, loading, folder)
            yield from Pool(queue, prepare, PoolOptions(self._clean_up)).results(workers)

    def _count_workers(self) -> int:
        """Return how many processes are to convert."""
        asked, jobs = self.settings, len(self.batch.waiting)
        memory = self.batch.waiting[0].options.max_memory
        if not asked.workers:
            return choose_workers(asked.device, jobs if self.batch.work > LITTLE else 1, memory)
        workers, note = useful_workers(asked.workers, jobs, memory)
        self.batch.notes += [note] if note else []
        return workers

    def _clean_up(self, job: Job, pid: int) -> None:
        """Remove what a dead worker left of a job's output."""
        remove_abandoned_parts([self.settings.folder / job.target], pid)

    def is_over(self) -> bool:
        """Say whether nothing more is to be begun."""
        return self.settings.fail_fast and bool(self.batch.failures())

    def begin(self, job: Job) -> Job:
        """Return a job as it is to be done now, after it was noted that it is.

        Whether it may replace what is there is asked now: what a process that died was at, or an
        orphan of a killed batch, may have taken its name meanwhile.
        """
        self.lock.start(job.target)
        if not os.path.lexists(self.settings.folder / job.target):
            return job
        self.planner.journal = read_journal(self.settings.folder)
        return replace(job, replace=self.planner.may_replace(job))

    def _take(self, job: Job, answer: Row | Death) -> None:
        """Keep what came of a job; one at which a process ended is tried once more, at the end."""
        if not isinstance(answer, Death):
            self._keep(job, answer)
        elif job.target in self.died:
            reason = f"the process that converted it {answer.cause}, twice"
            self._keep(job, failed_row(job, reason))
        else:
            self.died.add(job.target)
            self.batch.waiting.append(job)

    def _keep(self, job: Job, row: Row) -> None:
        row["options"] = self.planner.digest(job)
        self.ledger.add(row)
        is_ok = row["status"] == "ok"
        if is_ok or not os.path.lexists(self.settings.folder / job.target):
            self.lock.finish(job.target)  # else the journal may be all that knows what is there
        (self.batch.done if is_ok else self.batch.failed).append(Result(job, row))
        self.batch.work_done += expected_work(job)

    def _note_refused(self) -> None:
        """Put into the ledger what is refused, unless it says so already."""
        for job, row in self.batch.failed_before:
            known: dict[str, Any] = self.ledger.rows.get(job.target, {})
            if row is not known and row["reason"] != known.get("reason"):
                self.ledger.add(row)


class Queue:
    """The jobs of a run that are still to be begun, each with its share of the memory.

    The bound is read once, before processes fill it, and shared by those that convert.
    """

    def __init__(self, run: Run, workers: int) -> None:
        self.run, self.workers = run, workers
        self.bound = memory_bound(run.batch.waiting[0].options.max_memory)
        if self.bound is not None and workers > 1:
            self.bound = max(1, self.bound - (held_memory() or 0)) // workers

    def __len__(self) -> int:
        return 0 if self.run.is_over() else len(self.run.batch.waiting)

    def popleft(self) -> Job:
        """Begin the next job."""
        job = self.run.begin(self.run.batch.waiting.pop(0))
        if self.workers == 1:
            return job
        return replace(job, options=replace(job.options, max_memory=self.bound))
