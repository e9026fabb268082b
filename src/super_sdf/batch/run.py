"""Many files: what is to be done, what was done before, and doing the rest.

A rerun is the way to go on, after a kill, with new inputs or other options: only what is not done
with the same content and the same options is done. Failures that the input is to blame for stand
until it changes; others, a killed process or a full disk, are tried again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any

from ..chunks import count_cores
from ..memory import memory_bound
from .job import Job, Result
from .ledger import Ledger
from .lock import FolderLock
from .plan import Batch, Planner, Settings, expected_work
from .pool import Pool
from .workers import Loading, choose_workers, convert_here

# Of what ``expected_work`` counts: done in the time that several processes would take to start.
LITTLE = 30_000

Progress = Callable[[Batch], None]
"""Called after each file."""


class Run:
    """A batch under way in its folder, which no other may use meanwhile."""

    def __init__(self, jobs: Sequence[Job], settings: Settings, lock: FolderLock) -> None:
        self.settings, self.lock = settings, lock
        self.ledger = Ledger(settings.folder)
        self.ledger.cut_torn_line()
        lock.begun -= self.ledger.written
        self.planner = Planner(settings, self.ledger, set(lock.begun))
        self.batch = self.planner.plan(jobs)

    def complete(self, progress: Progress | None = None) -> None:
        """Do what is to be done; each file is in the ledger before the next is told of."""
        start = time.perf_counter()
        self._note_refused()
        with closing(self._convert()) as results:
            for result in results:
                self._take(result)
                self.batch.seconds = time.perf_counter() - start
                if progress:
                    progress(self.batch)

    def _convert(self) -> Generator[Result, None, None]:
        """Convert in this process or in several."""
        asked = self.settings
        if not self.batch.waiting or self._is_over():
            return
        jobs = len(self.batch.waiting) if self.batch.work > LITTLE else 1
        workers = asked.workers or choose_workers(asked.device, jobs)
        threads = asked.threads or (max(1, count_cores() // workers) if workers > 1 else 0)
        loading = Loading(asked.model, asked.precision, asked.device, threads)
        queue = self._queue(workers)
        if workers == 1:
            yield from convert_here(queue, asked.folder, loading, self._begin)
        else:
            yield from Pool(queue, asked.folder, loading, self._begin).results(workers)

    def _queue(self, workers: int) -> Iterator[Job]:
        """Yield jobs as long as there are, and as they should be begun; memory is shared out."""
        while self.batch.waiting and not self._is_over():
            job = self.batch.waiting.pop(0)
            bound = memory_bound(job.options.max_memory)
            if workers > 1 and bound is not None:
                job = replace(job, options=replace(job.options, max_memory=bound // workers))
            yield job

    def _is_over(self) -> bool:
        return self.settings.fail_fast and bool(self.batch.failures())

    def _begin(self, job: Job) -> None:
        self.lock.begin(job.target)

    def _take(self, result: Result) -> None:
        """Keep what came of a job."""
        job, row = result
        row["options"] = self.planner.digest(job)
        self.ledger.add(row)
        self.lock.finish(job.target)
        (self.batch.done if row["status"] == "ok" else self.batch.failed).append(result)
        self.batch.work_done += expected_work(job)

    def _note_refused(self) -> None:
        """Put into the ledger what is refused, unless it says so already."""
        for job, row in self.batch.failed_before:
            known: dict[str, Any] = self.ledger.rows.get(job.target, {})
            if row is not known and row["reason"] != known.get("reason"):
                self.ledger.add(row)
