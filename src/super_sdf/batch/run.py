"""Runs a batch.

To resume after a kill, or with new inputs or other options, run it again: it does only what is not
done yet with the same content and options. A failure caused by the input stands until the input
changes; others, such as a killed process or a full disk, are tried again.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any

from ..files.output import remove_abandoned_parts
from ..machine.memory import held_memory, memory_bound
from ..machine.pool import Death, Pool, PoolOptions
from ..machine.threads import count_cores
from .job import Job, Outputs, Result, Row, failed_row
from .journal import read_journal
from .ledger import Ledger
from .lock import FolderLock
from .plan import Batch, Planner, Settings, expected_work
from .workers import Loading, choose_workers, convert_here, prepare_worker, useful_workers

# In units of ``expected_work``: done in the time that worker processes would take to start.
SMALL_BATCH = 30_000

OnFile = Callable[[Batch], None]
"""Called after each file, with the batch as it stands."""

Warn = Callable[[str], None]
"""Called with a sentence that the user should read before the work goes on."""

Results = Generator[tuple[Job, Row | Death], None, None]
"""Jobs as they end, each with its row, or with a Death if its process ended.

What converts the jobs of a ``Queue`` yields this: this process, processes, or a cluster.
"""


class Run:
    """A batch that runs in its output folder, which is locked meanwhile."""

    def __init__(self, jobs: Sequence[Job], settings: Settings, lock: FolderLock) -> None:
        self.settings, self.lock = settings, lock
        self.ledger = Ledger(settings.folder)
        lock.started.difference_update(self.ledger.written)
        self.planner = Planner(settings, self.ledger, read_journal(settings.folder))
        self.batch = self.planner.plan(jobs)
        self.died: set[str] = set()  # outputs whose worker died once

    def complete(self, on_file: OnFile | None = None, warn: Warn | None = None) -> None:
        """Convert what is to be converted; call ``on_file`` after each file is in the ledger.

        ``warn`` is called with what may be wrong with the workers of a cluster; without it, that is
        among the notes.
        """
        start = time.perf_counter()
        self._note_refused()
        with closing(self._convert(warn or self.batch.notes.append)) as results:
            for job, result in results:
                self._take(job, result)
                self.batch.seconds = time.perf_counter() - start
                if on_file:
                    on_file(self.batch)

    def _convert(self, warn: Warn) -> Results:
        """Convert in this process, in processes or on a cluster."""
        settings = self.settings
        if not self.batch.waiting or self.is_over():
            return
        workers = self._count_workers()
        if settings.cluster is not None:
            yield from self._convert_on_cluster(workers, warn)
            return
        threads = settings.threads or (max(1, count_cores() // workers) if workers > 1 else 0)
        loading = Loading(settings.model, settings.precision, settings.device, threads)
        outputs = Outputs(settings.folder, settings.check, settings.items)
        queue = Queue(self, workers)
        if workers == 1:
            yield from convert_here(queue, loading, outputs)
        else:
            prepare = partial(prepare_worker, loading, outputs)
            yield from Pool(queue, prepare, PoolOptions(self._clean_up)).results(workers)

    def _convert_on_cluster(self, workers: int, warn: Warn) -> Results:
        """Convert on a cluster, which determines threads and memory of each worker itself."""
        from .on_cluster import Handling, convert_on_cluster

        handling = Handling(self._clean_up, lambda job: job.target in self.died, warn)
        jobs = list(self.batch.waiting)
        return convert_on_cluster(Queue(self, 1), jobs, self.settings, workers, handling)

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

    def _clean_up(self, job: Job, pid: int) -> None:
        """Remove what a dead worker left of a job's output."""
        remove_abandoned_parts([self.settings.folder / job.target], pid)

    def is_over(self) -> bool:
        """Return whether no further job may be started."""
        return self.settings.fail_fast and bool(self.batch.failures())

    def start(self, job: Job) -> Job:
        """Note in the journal that a job starts; return it with ``replace`` decided.

        It is decided now because the output may have appeared since the plan was made, written by
        a worker that died, or by one that outlived a killed batch.
        """
        self.lock.start(job.target)
        if not os.path.lexists(self.settings.folder / job.target):
            return job
        self.planner.journal = read_journal(self.settings.folder)
        return replace(job, replace=self.planner.may_replace(job))

    def _take(self, job: Job, result: Row | Death) -> None:
        """Keep the row of a job; if its worker died, try the job once more, after the others."""
        if not isinstance(result, Death):
            self._keep(job, result)
        elif job.target in self.died:
            reason = f"the process that converted it {result.cause}, twice"
            self._keep(job, failed_row(job, reason))
        else:
            self.died.add(job.target)
            self.batch.waiting.append(job)

    def _keep(self, job: Job, row: Row) -> None:
        """Put the row of a finished job into the ledger and count it."""
        row["options"] = self.planner.digest(job)
        self.ledger.add(row)
        is_ok = row["status"] == "ok"
        if is_ok or not os.path.lexists(self.settings.folder / job.target):
            self.lock.finish(job.target)  # otherwise only the journal knows who made the file
        (self.batch.done if is_ok else self.batch.failed).append(Result(job, row))
        self.batch.work_done += expected_work(job)

    def _note_refused(self) -> None:
        """Put the refused outputs into the ledger, unless they are there with the same reason."""
        for job, row in self.batch.failed_before:
            known: dict[str, Any] = self.ledger.rows.get(job.target, {})
            if row is not known and row["reason"] != known.get("reason"):
                self.ledger.add(row)


class Queue:
    """The jobs of a run that were not started yet, each with its share of the memory.

    The memory bound is determined once, before the workers fill the memory, and divided by them.
    """

    def __init__(self, run: Run, workers: int) -> None:
        self.run, self.workers = run, workers
        self.bound = memory_bound(run.batch.waiting[0].options.max_memory)
        if self.bound is not None and workers > 1:
            self.bound = max(1, self.bound - (held_memory() or 0)) // workers

    def __len__(self) -> int:
        return 0 if self.run.is_over() else len(self.run.batch.waiting)

    def popleft(self) -> Job:
        """Start the next job and return it."""
        job = self.run.start(self.run.batch.waiting.pop(0))
        if self.workers == 1:
            return job
        return replace(job, options=replace(job.options, max_memory=self.bound))
