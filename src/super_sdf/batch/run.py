"""Runs a batch.

To resume after a kill, or with new inputs or other options, run it again: it does only what is not
done yet with the same content and options. A failure caused by the input stands until the input
changes; others, such as a killed process or a full disk, are tried again.

Meshes are made in a folder within the output folder. When one is complete, its row is added to the
report, and then it is moved to its place: so whatever is killed, a file that is there and that the
report does not know is not the batch's. What a killed batch left in that folder is removed.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from .. import __version__
from ..files.output import naming
from ..network.network import find_model
from ..network.onnx import available_devices
from ..threads import allot_each, count_cores, free_memory
from .job import Job, Result, Settings, convert_job
from .pool import Death, work_in_processes
from .record import STAGE_NAME, Record, Row, file_state, fingerprint, is_unchanged, outputs_of

# In units of ``expected_work``: done in the time that worker processes would take to start.
SMALL_BATCH = 30_000
BYTES_PER_WORKER = 10**9  # for the network and a grid of 128^3, where --jobs is not given
MIN_BYTES_PER_WORKER = 3 * 10**8  # with less a worker cannot convert anything


class Batch:
    """A batch as it stands: the jobs to be done, and the results so far.

    Results of earlier runs that still hold are ``done_before`` and ``failed_before``, also outputs
    that may not be replaced.
    """

    def __init__(
        self, jobs: Sequence[Job], settings: Settings, unread: Sequence[tuple[str, str]] = ()
    ) -> None:
        self.jobs, self.settings, self.unread = jobs, settings, list(unread)
        self.waiting: list[Job] = []  # not started yet; the largest first
        self.changed: dict[str, list[str]] = {}  # options of meshes that are made again
        self.done_before, self.failed_before = list[Result](), list[Result]()
        self.done, self.failed = list[Result](), list[Result]()
        self.notes: list[str] = []  # for the user, on how the batch is run
        self.seconds = 0.0  # of the run, for those who measure it
        self.record = Record(settings.folder)
        self.written: dict[str, str] = {}  # in this run: the output of each file
        path, symmetries = find_model(settings.model, settings.precision)
        self.network = (fingerprint(path) or {}).get("sha256"), symmetries
        self.inputs = {os.path.realpath(job.source) for job in jobs}
        for job in jobs:
            self._plan(job)
        self.waiting.sort(key=lambda job: -expected_work(job))
        self.work = sum(map(expected_work, self.waiting))

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

    def run(self, on_file: Callable[[Batch], None] | None = None) -> None:
        """Convert what is to be converted; call ``on_file`` after each file is in the report."""
        for job, row in self.failed_before:  # refused outputs that the report does not have
            if row["reason"] != self.record.rows.get(job.target, {}).get("reason"):
                self.record.add(row)
        if not self.waiting or (self.settings.fail_fast and self.failures()):
            return
        died = set[str]()  # outputs whose worker died once
        parts = self.settings.folder / STAGE_NAME
        stage = parts / secrets.token_hex(4)  # orphans on a cluster write into another one
        shutil.rmtree(parts, ignore_errors=True)
        with naming(parts):
            stage.mkdir(parents=True)
        try:
            for job, row in self._results(stage):
                if isinstance(row, Death) and job.target not in died:
                    died.add(job.target)
                    self.waiting.append(job)  # once more, after the others
                    continue
                if isinstance(row, Death):
                    row = job.failed(f"the process that converted it {row.cause}, twice")
                result = Result(job, self._keep(job, row, stage))
                (self.done if result.row["status"] == "ok" else self.failed).append(result)
                if on_file:
                    on_file(self)
        finally:
            shutil.rmtree(parts, ignore_errors=True)

    def _results(self, stage: Path) -> Generator[tuple[Job, Any], None, None]:
        """Convert in this process, in processes or on a cluster; yield jobs with their rows."""
        settings, threads, count = self.settings, self.settings.threads, len(self.waiting)
        memory = self.waiting[0].options.max_memory
        if not (settings.workers or settings.cluster) and self.work < SMALL_BATCH:
            count = 1
        count = count_workers(settings.workers, settings.device, count, memory)
        if count > 1 and not settings.cluster:  # before the workers fill the memory
            threads, memory = allot_each(count, threads, memory)
        work = partial(convert_job, settings=settings, stage=stage, threads=threads)

        def take() -> Job | None:
            if not self.waiting or (settings.fail_fast and self.failed):
                return None
            job = self.waiting.pop(0)
            return replace(job, options=replace(job.options, max_memory=memory))

        if settings.cluster:
            from .cluster import convert_on_cluster

            yield from convert_on_cluster(self.jobs, settings, stage, take, count)
        elif count > 1:
            with closing(work_in_processes(take, work, count)) as results:
                yield from results
        else:
            while (job := take()) is not None:
                yield job, work(job)

    def _keep(self, job: Job, row: Row, stage: Path) -> Row:
        """Add the row of a finished job to the report, and move its files to their places.

        If they may not be written, the row that is returned says why.
        """
        folder, names = self.settings.folder, list(outputs_of(row))
        if why := self._why_not(job, names):
            row = job.failed(why, content=row["content"])
        if "labels" in row:
            others = self.record.made.get(job.target, {}).keys() - set(names)
            row["beside"] = sorted(name for name in others if os.path.lexists(folder / name))
        self.record.add(row | self._how(job))
        try:
            for name in names if row["status"] == "ok" else ():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                os.replace(stage / name, folder / name)
                self.written[name] = job.target
        except OSError as error:
            why = f"{folder / name} cannot be written: {error.strerror}"
            self.record.add(job.failed(why, content=row["content"]) | self._how(job))
        return self.record.rows[job.target]

    def _why_not(self, job: Job, names: Iterable[str]) -> str | None:
        """Return why a job may not write some files, None if it may."""
        for name in names:
            path, owner = self.settings.folder / name, self.written.get(name, job.target)
            if owner != job.target:
                way_out = "give its inputs other names (out)"
                return f"{path} was written while this batch ran: {way_out}"
            if os.path.islink(path):
                return f"{path} is a link: remove it"
            if os.path.realpath(path) in self.inputs:
                return f"{path} is an input: give another folder, or another name (out)"
            if os.path.exists(path) and not self.settings.force:
                known = self.record.made.get(job.target, {}).get(name, set())
                if (fingerprint(path) or {}).get("sha256") not in known:
                    why = "changed after a batch made it" if known else "not made by a batch"
                    return f"{path} exists and was {why}: remove it or use --force"
        return None

    def _plan(self, job: Job) -> None:
        """Put a job among those that are done, failed for good, refused, or to be done."""
        row, how = self.record.rows.get(job.target), json.loads(json.dumps(self._how(job)))
        if row and self._holds(job, row, how["options"]):
            before = self.done_before if row["status"] == "ok" else self.failed_before
            before.append(Result(job, row))
            return
        # of files of labels those of the row are known; others show when the job has made its own
        names = [job.target] if not job.has_label_files else outputs_of(row) if row else []
        if why := self._why_not(job, names):
            self.failed_before.append(Result(job, job.failed(why) | how))
            return
        self.waiting.append(job)
        if row and row["status"] == "ok" and row["options"] != how["options"]:
            others = ("version", "model", "precision", "network")
            now, old = ({**r["asked"], **{key: r.get(key) for key in others}} for r in (how, row))
            changed = [name for name in {**now, **old} if now.get(name) != old.get(name)]
            self.changed[job.target] = changed or ["version"]

    def _holds(self, job: Job, row: Row, digest: str) -> bool:
        """Return whether the row of an earlier run still holds."""
        settings, is_ok = self.settings, row["status"] == "ok"
        if settings.force or row["options"] != digest or row["retry"]:
            return False
        if (settings.retry and not is_ok) or (is_ok and settings.check and "check" not in row):
            return False
        same_path = row["in"] == os.path.abspath(job.source)
        return is_unchanged(job.source, row["content"], same_path=same_path) and all(
            is_unchanged(settings.folder / name, known) for name, known in outputs_of(row).items()
        )

    def _how(self, job: Job) -> Row:
        """Return what a row says of how a mesh was made: enough to make it again.

        The digest is of all that a mesh depends on, besides its grid. Device, threads and memory do
        not count: the mesh asked for is the same. If the precision follows the device, the network
        for the CPU counts.
        """
        asked, names = job.options.digest(), self.settings.names
        if job.options.labels is not None and names:  # a hash stands for the table
            asked["names"] = hashlib.sha256(json.dumps(names).encode()).hexdigest()
        digest = hashlib.sha256(json.dumps([asked, self.network, __version__]).encode())
        return {
            "version": __version__,
            "network": self.network[0],
            "model": self.settings.model,
            "precision": self.settings.precision,
            "asked": asked,
            "options": digest.hexdigest(),
        }


def expected_work(job: Job) -> float:
    """Return the estimated work of a job: proportional to its surface, plus a constant."""
    try:
        size = file_state(job.source)[0]
    except OSError:
        size = 0
    return 1000 + float(size ** (2 / 3))


def count_workers(asked: int, device: str, jobs: int, max_memory: int | None = None) -> int:
    """Return how many processes to use: those asked for, or one per core, but one on a GPU.

    There are no more than cores, jobs, and what the memory allows.
    """
    if not asked and (device == "cuda" or (device == "auto" and "cuda" in available_devices())):
        return 1
    free = max_memory or free_memory()
    each = MIN_BYTES_PER_WORKER if asked else BYTES_PER_WORKER
    room = count_cores() if free is None else free // each
    return max(1, min(asked or count_cores(), count_cores(), room, jobs))
