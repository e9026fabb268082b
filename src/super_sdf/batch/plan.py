"""What a batch has to do, and what it need not: the plan, before anything is begun."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from .. import __version__
from ..network.network import find_model
from .fingerprint import fingerprint, is_unchanged
from .job import Job, Result, Row, failed_row
from .journal import Journal, read_journal
from .ledger import Ledger


@dataclass(frozen=True)
class Settings:
    """How a batch is run; ``workers`` and ``threads`` (of each) 0: chosen from the cores."""

    folder: Path
    model: str = "base"
    precision: str = "float32"
    device: str = "auto"
    threads: int = 0
    workers: int = 0
    force: bool = False
    retry: bool = False
    fail_fast: bool = False


@dataclass
class Batch:
    """What stands to be done, and what came of it, as it comes.

    Attributes
    ----------
    waiting : list of Job
        Not begun, in the order in which they will be.
    done_before, failed_before : list of Result
        What a run before left, so that there is nothing to do; refused outputs too.
    done, failed : list of Result
        What this run did.
    work, work_done : float
        How long it all takes about, in no unit.
    unread : list of (str, str)
        Folders that could not be looked into, and why.
    notes : list of str
        What a user should know of how it is run.
    """

    settings: Settings
    waiting: list[Job] = field(default_factory=list)
    done_before: list[Result] = field(default_factory=list)
    failed_before: list[Result] = field(default_factory=list)
    done: list[Result] = field(default_factory=list)
    failed: list[Result] = field(default_factory=list)
    work: float = 0.0
    work_done: float = 0.0
    seconds: float = 0.0
    unread: list[tuple[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def failures(self) -> list[Result]:
        """Return all that failed, now or before."""
        return self.failed_before + self.failed

    def results(self) -> list[Result]:
        """Return all meshes that are there, made now or before."""
        return self.done_before + self.done


class Planner:
    """Tells what is to be done from what was done before with the same content and options."""

    def __init__(self, settings: Settings, ledger: Ledger, journal: Journal) -> None:
        self.settings, self.ledger, self.journal = settings, ledger, journal
        path, symmetries = find_model(settings.model, settings.precision)
        network = fingerprint(path)
        self.network = network and network["sha256"], symmetries

    def plan(self, jobs: Sequence[Job]) -> Batch:
        """Sort the jobs into done, failed for good, refused, and to be done.

        The largest go first, so that no process is left with one when the others are through; but
        those last that were begun and never finished, for they may have been what ended the run.
        """
        batch = Batch(self.settings)
        for job in jobs:
            row = self._known(job) or self._refused(job)
            if row is None:
                batch.waiting.append(job)
            else:
                before = batch.done_before if row["status"] == "ok" else batch.failed_before
                before.append(Result(job, row))
        last = self.journal.started - self.ledger.written
        batch.waiting.sort(key=lambda job: (job.target in last, -expected_work(job)))
        batch.work = sum(map(expected_work, batch.waiting))
        return batch

    def digest(self, job: Job) -> str:
        """Return the hash of all that a mesh depends on, beside its grid.

        Device, threads and memory are left out: they do not change what is asked.
        """
        asked = [asdict(replace(job.options, max_memory=None)), self.network, __version__]
        return hashlib.sha256(json.dumps(asked).encode()).hexdigest()

    def _known(self, job: Job) -> Row | None:
        """Return the row of a run before, if it still holds."""
        row = self.ledger.rows.get(job.target)
        if row is None or self.settings.force or row["options"] != self.digest(job):
            return None
        if row["retry"] or (row["status"] != "ok" and self.settings.retry):
            return None
        same_path = row["in"] == os.path.abspath(job.source)
        if not is_unchanged(job.source, row["content"], same_path=same_path):
            return None
        if row["status"] == "ok" and not is_unchanged(self._path(job), row["output"]):
            return None
        return row

    def _refused(self, job: Job) -> Row | None:
        """Return why an output may not be written: something is there that no batch made."""
        if not os.path.lexists(self._path(job)) or self.may_replace(job):
            return None
        reason = f"{self._path(job)} exists and was not made by a batch: remove it or use --force"
        return {**failed_row(job, reason), "options": self.digest(job)}

    def may_replace(self, job: Job) -> bool:
        """Say whether a job may replace the file that is there.

        Its content tells: a mesh that took its name, and whose process was killed before its row
        was written, is in the journal.
        """
        if self.settings.force or job.target in self.ledger.written:
            return True
        digests = self.journal.made.get(job.target)
        now = fingerprint(self._path(job)) if digests else None
        return digests is not None and now is not None and now["sha256"] in digests

    def _path(self, job: Job) -> Path:
        return self.settings.folder / job.target


def preview(jobs: Sequence[Job], settings: Settings) -> Batch:
    """Return what would be done; write nothing."""
    folder = settings.folder
    return Planner(settings, Ledger(folder), read_journal(folder)).plan(jobs)


def expected_work(job: Job) -> float:
    """Return about how long a job takes: as its surface, and something for every file."""
    try:
        size = job.source.stat().st_size
    except OSError:
        size = 0
    return 1000 + float(size ** (2 / 3))
