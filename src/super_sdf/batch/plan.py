"""The plan of a batch: which jobs are to be done and which are done already."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from .. import __version__
from ..files.regular import files_of
from ..network.network import find_model
from .job import Job, Result, Settings, failed_row
from .ledger import (Fingerprint, Ledger, Row, asked_of, file_state, fingerprint, is_unchanged, outputs_of)


@dataclass
class Batch:
    """The state of a batch: jobs to be done, and the results so far.

    Results of earlier runs that still hold are ``done_before`` and ``failed_before``, also outputs
    that may not be replaced.
    """

    settings: Settings
    waiting: list[Job] = field(default_factory=list)  # not started yet, in their order
    changed: dict[str, list[str]] = field(default_factory=dict)  # options of meshes made again
    done_before: list[Result] = field(default_factory=list)
    failed_before: list[Result] = field(default_factory=list)
    done: list[Result] = field(default_factory=list)
    failed: list[Result] = field(default_factory=list)
    work: float = 0.0  # estimated, of all jobs, in arbitrary units
    work_done: float = 0.0
    seconds: float = 0.0  # since the start of the run
    unread: list[tuple[str, str]] = field(default_factory=list)  # folders, and why
    notes: list[str] = field(default_factory=list)  # for the user, on how the batch is run

    def failures(self) -> list[Result]:
        """Return the failures of this run and of earlier ones."""
        return self.failed_before + self.failed

    def results(self) -> list[Result]:
        """Return the meshes that exist, of this run and of earlier ones."""
        return self.done_before + self.done

    def made_again(self) -> dict[str, Any]:
        """Return how many outputs are made again since options changed, and which options."""
        options = dict.fromkeys(name for names in self.changed.values() for name in names)
        return {"outputs": len(self.changed), "options": list(options)}


class Planner:
    """Decides which jobs are to be done: those not done with the same content and options."""

    def __init__(self, jobs: Sequence[Job], settings: Settings, ledger: Ledger) -> None:
        self.jobs, self.settings, self.ledger = jobs, settings, ledger
        path, symmetries = find_model(settings.model, settings.precision)
        network = fingerprint(path)
        self.network = network and network["sha256"], symmetries

    def plan(self) -> Batch:
        """Return the jobs sorted into done, failed for good, refused, and to be done.

        The largest come first, so that no worker starts one when the others have finished. Jobs
        that an earlier run started and never finished come last: they may have killed it.
        """
        batch = Batch(self.settings)
        for job in self.jobs:
            row = self._known(job) or self._refused(job)
            if row is None:
                batch.waiting.append(job)
                if names := self._changed(job):
                    batch.changed[job.target] = names
            else:
                before = batch.done_before if row["status"] == "ok" else batch.failed_before
                before.append(Result(job, row))
        last = self.ledger.left.difference(self.ledger.written)
        batch.waiting.sort(key=lambda job: (job.target in last, -expected_work(job)))
        batch.work = sum(map(expected_work, batch.waiting))
        return batch

    def digest(self, job: Job) -> str:
        """Return the hash of all that a mesh depends on, besides its grid.

        Device, threads and memory do not count: the mesh asked for is the same. If the precision
        follows the device, the network for the CPU counts.
        """
        settings = [self._asked(job), self.network, __version__]
        return hashlib.sha256(json.dumps(settings).encode()).hexdigest()

    def record(self, job: Job) -> Row:
        """Return what a row says of how a mesh was made: enough to make it again."""
        return {
            "version": __version__,
            "network": self.network[0],
            "model": self.settings.model,
            "precision": self.settings.precision,
            "asked": self._asked(job),
            "options": self.digest(job),
        }

    def _asked(self, job: Job) -> Row:
        """Return the options of a job; of names of labels, a hash stands for the table."""
        asked, names = job.options.digest(), self.settings.names
        if job.options.labels is None or not names:
            return asked
        return {**asked, "names": hashlib.sha256(json.dumps(names).encode()).hexdigest()}

    def _changed(self, job: Job) -> list[str]:
        """Return by which options, or what else, a mesh differs from the one that is there."""
        row = self.ledger.rows.get(job.target, {})
        if row.get("status") != "ok" or row["options"] == self.digest(job):
            return []
        now = json.loads(json.dumps(self.record(job)))  # as rows are read: without tuples
        before, asked = asked_of(row), now["asked"]
        names = [name for name in {**asked, **before} if asked.get(name) != before.get(name)]
        others = ("version", "model", "precision", "network")
        return names + [key for key in others if now[key] != row.get(key)] or ["version"]

    def replaceable(self, job: Job) -> frozenset[str]:
        """Return the existing files that a job may replace: those that are as a batch made them."""
        known = self.ledger.written.get(job.target, {})
        return frozenset(name for name in known if self._is_as_made(name, known[name]))

    def _is_as_made(self, name: str, known: Fingerprint | None) -> bool:
        return bool(known and is_unchanged(self.settings.folder / name, known))

    def _known(self, job: Job) -> Row | None:
        """Return the row of an earlier run, None if there is none that still holds."""
        row = self.ledger.rows.get(job.target)
        if row is None or self.settings.force or row["options"] != self.digest(job):
            return None
        is_ok = row["status"] == "ok"
        if row["retry"] or (not is_ok and self.settings.retry):
            return None
        same_path = row["in"] == os.path.abspath(job.source)
        if not is_unchanged(job.source, row["content"], same_path=same_path):
            return None
        if not all(self._is_as_made(name, known) for name, known in outputs_of(row).items()):
            return None
        return None if is_ok and self.settings.check and "check" not in row else row

    def _refused(self, job: Job) -> Row | None:
        """Return a failed row if a file exists and may not be replaced, else None.

        Of labels only the files of the row are known; others show when the job has made its own.
        """
        known = self.ledger.written.get(job.target, {})
        row = self.ledger.rows.get(job.target)
        names = [job.target] if not job.has_label_files else outputs_of(row) if row else []
        for name in names:
            if reason := self._why_not(job, name, known.get(name)):
                return {**failed_row(job, reason), **self.record(job)}
        return None

    def _why_not(self, job: Job, name: str, known: Fingerprint | None) -> str | None:
        """Return why a job may not write a file, None if it may."""
        path = self.settings.folder / name
        if not os.path.lexists(path):
            return None
        if os.path.exists(path) and (read := self._inputs.get(_identity(path))):
            return f"{path} is the same file as {read}: remove that link"
        if self.settings.force or job.target in self.ledger.left or self._is_as_made(name, known):
            return None
        why = "was changed after a batch made it" if known else "was not made by a batch"
        return f"{path} exists and {why}: remove it or use --force"

    @cached_property
    def _inputs(self) -> dict[tuple[int, int], Path]:
        """The files that the jobs read, by their identity."""
        files = (file for job in self.jobs for file in files_of(job.source))
        return {_identity(file): file for file in files if file.is_file()}


def _identity(path: Path) -> tuple[int, int]:
    state = path.stat()
    return state.st_dev, state.st_ino


def expected_work(job: Job) -> float:
    """Return the estimated work of a job: proportional to its surface, plus a constant."""
    try:
        size = file_state(job.source)[0]
    except OSError:
        size = 0
    return 1000 + float(size ** (2 / 3))
