"""Runs a batch; to go on after a kill, or with other inputs or options, it is run again.

Only what is not done yet with the same content and options is done. Failures caused by an input
stand until it changes; others, such as a killed process or a full disk, are tried again.

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
from collections.abc import Generator, Iterable, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

from .. import __version__
from ..files.formats import split_member
from ..files.output import naming
from ..network.network import find_model
from ..network.onnx import available_devices
from ..threads import Progress, count_cores, free_memory, held_memory, memory_bound
from .inputs import Job
from .record import STAGE_NAME, Record, Row, file_state, fingerprint, is_unchanged, outputs_of
from .work import Death, Settings, convert_job, work_in_processes

SMALL_BATCH, EACH = 4_000_000, 100_000  # bytes that are done while a process starts; for any file
BYTES_PER_WORKER = 10**9  # for the network and a grid of 128^3, where --jobs is not given
MIN_BYTES_PER_WORKER = 3 * 10**8  # with less a worker cannot convert anything


class Batch:
    """A batch as it stands, first as planned: each job has its state and, if there is one, a row.

    Jobs that are refused would replace what is not theirs.
    """

    def __init__(self, jobs: Sequence[Job], settings: Settings) -> None:
        self.jobs, self.settings, self.record = jobs, settings, Record(settings.folder)
        self.written: dict[str, str] = {}  # in this run: the output of each file
        self.inputs = {os.path.realpath(job.source) for job in jobs}
        chosen = settings.options.network()
        path, turns = find_model(chosen["model"], chosen["precision"])
        self.network = {"version": __version__, "turns": turns, "model": chosen["model"]}
        self.network["network"] = (fingerprint(path) or {}).get("sha256")
        for job in jobs:
            self._plan(job)

    def of(self, *states: str) -> list[Job]:
        """Return the jobs in some states."""
        return [job for job in self.jobs if job.state in states]

    def listed(self, *states: str) -> list[dict[str, Any]]:
        """Return the grids and the outputs of jobs in some states, and why they failed."""
        return [
            {"in": os.path.abspath(job.source), "out": job.target}
            | {key: job.row[key] for key in ("reason",) if job.row.get(key)}
            for job in self.of(*states)
        ]

    def run(self, progress: Progress | None = None) -> None:
        """Convert what is to be converted; call ``progress`` after each file is in the report."""
        for job in self.of("refused"):
            known = self.record.rows.get(job.target, {})
            if job.row["reason"] != known.get("reason"):
                self.record.add(job.row)
        left = sorted(self.of("to_do"), key=size_of, reverse=True)
        total, done, died = len(left), 0, set[str]()  # outputs whose worker died once
        if not left:
            return
        parts = self.settings.folder / STAGE_NAME
        stage = parts / secrets.token_hex(4)  # orphans on a cluster write into another one
        shutil.rmtree(parts, ignore_errors=True)
        with naming(parts):
            stage.mkdir(parents=True)
        try:
            for job, row in self._results(left, stage):
                if isinstance(row, Death):
                    if job.target not in died:
                        died.add(job.target)
                        left.append(job)  # once more, after the others
                        continue
                    row = job.failed(f"the process that converted it {row}, twice")
                self._keep(job, row, stage)
                done += 1
                if progress:
                    progress(done, total)
        finally:
            shutil.rmtree(parts, ignore_errors=True)

    def _results(self, left: list[Job], stage: Path) -> Generator[tuple[Job, Any], None, None]:
        """Convert in this process, in processes or on a cluster; yield jobs with their rows."""
        settings, options, count = self.settings, self.settings.options, len(left)
        if not (settings.workers or settings.cluster):  # small ones are sooner done here
            count = min(count, 1 + sum(map(size_of, left)) // SMALL_BATCH)
        count = count_workers(settings.workers, options.device, count, options.max_memory)
        threads, memory = options.threads, options.max_memory
        if count > 1:  # before the workers fill the memory
            threads = threads or max(1, count_cores() // count)
            memory = max(1, memory_bound(memory) - held_memory()) // count

        def take() -> Job | None:
            return left.pop(0) if left else None

        work = partial(convert_job, settings=settings, stage=stage, threads=threads, memory=memory)
        if settings.cluster:
            from .cluster import convert_on_cluster

            yield from convert_on_cluster(left[0], settings, stage, take, count)
        elif count > 1:
            with closing(work_in_processes(take, work, count)) as results:
                yield from results
        else:
            yield from ((job, work(job)) for job in iter(take, None))

    def _keep(self, job: Job, row: Row, stage: Path) -> None:
        """Add the row of a finished job to the report, then move its files to their places."""
        folder, names, how = self.settings.folder, list(outputs_of(row)), self._how(job)
        if why := self._why_not(job, names):
            row = job.failed(why, row["content"])
        if "labels" in row:
            others = self.record.made.get(job.target, {}).keys() - set(names)
            row["beside"] = sorted(name for name in others if os.path.lexists(folder / name))
        job.row = row | how
        self.record.add(job.row)
        try:
            for name in names if row["status"] == "ok" else ():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                os.replace(stage / name, folder / name)
                self.written[name] = job.target
        except OSError as error:
            why = f"{folder / name} cannot be written: {error.strerror}"
            job.row = job.failed(why, row["content"]) | how
            self.record.add(job.row)
        job.state = "done" if job.row["status"] == "ok" else "failed"

    def _why_not(self, job: Job, names: Iterable[str]) -> str:
        """Return why a job may not write some files, "" if it may."""
        for name in names:
            path = self.settings.folder / name
            known = self.record.made.get(job.target, {}).get(name, set())
            if self.written.get(name, job.target) != job.target:
                return f"{path} was written while this batch ran: give its inputs other names (out)"
            if os.path.islink(path):
                return f"{path} is a link: remove it"
            if os.path.realpath(path) in self.inputs:
                return f"{path} is an input: give another folder, or another name (out)"
            kept = os.path.exists(path) and not self.settings.force
            if kept and (fingerprint(path) or {}).get("sha256") not in known:
                why = "changed after a batch made it" if known else "not made by a batch"
                return f"{path} exists and was {why}: remove it or use --force"
        return ""

    def _plan(self, job: Job) -> None:
        """Say whether a job is done, has failed for good, is refused, or is to be done."""
        settings, how, row = self.settings, self._how(job), self.record.rows.get(job.target)
        if row:
            is_ok, same_path = row["status"] == "ok", row["in"] == os.path.abspath(job.source)
            again = self._lacks(job, row) if is_ok else settings.retry
            if (
                not (settings.force or row["retry"] or again)
                and all(row.get(key) == value for key, value in how.items() if key != "model")
                and split_member(row["in"])[1] == split_member(job.source)[1]
                and is_unchanged(job.source, row["content"], same_path=same_path)
                and all(is_unchanged(settings.folder / n, k) for n, k in outputs_of(row).items())
            ):
                job.row, job.state = row, "done_before" if is_ok else "failed_before"
                return
        # of files of labels those of the row are known; others show when the job has made its own
        targets = [job.target] if not job.has_label_files else outputs_of(row) if row else []
        if why := self._why_not(job, targets):
            job.row, job.state = job.failed(why) | how, "refused"

    def _lacks(self, job: Job, row: Row) -> bool:
        """Say whether what is asked for beside a mesh is missing: its check, or that of a page."""
        if self.settings.items is None:
            return self.settings.check and "check" not in row
        from ..pages.items import find_item

        return find_item(self.settings.items, job.target, row["output"]["sha256"]) is None

    def _how(self, job: Job) -> Row:
        """Return what a row says of how a mesh was made: enough to make it again."""
        asked, names = job.options.digest(), self.settings.names
        if job.options.labels is not None and names:  # a hash stands for the table
            asked["names"] = hashlib.sha256(json.dumps(names).encode()).hexdigest()
        return dict(json.loads(json.dumps({**self.network, "asked": asked})))

    def write_page(self, path: Path, lead: str) -> None:
        """Write the page of the batch, ``lead`` first; also of other runs' rows, not of labels."""
        from ..pages.html import write_batch_page

        folder, rows = self.settings.folder, {job.target: job.row for job in self.jobs}
        rows = self.record.rows | rows
        for name, row in list(rows.items()):
            is_gone = row.get("status") == "ok" and not is_unchanged(folder / name, row["output"])
            if is_gone or row.get("asked", {}).get("labels") is not None:
                del rows[name]
        facts = {"title": f"Batch: {folder}", "lead": lead}
        write_batch_page(path, facts, rows, force=self.settings.force)


def size_of(job: Job) -> int:
    """Return the bytes of an input, and what any file costs."""
    with suppress(OSError):
        return EACH + file_state(job.source)[0]
    return EACH


def count_workers(asked: int, device: str, jobs: int, max_memory: int | None = None) -> int:
    """Return how many processes to use: as asked, or one per core; no more than there is to do."""
    if not asked and device != "cpu" and (device == "cuda" or "cuda" in available_devices()):
        return 1  # on a GPU
    cores, each = count_cores(), MIN_BYTES_PER_WORKER if asked else BYTES_PER_WORKER
    room = (max_memory or free_memory()) // each
    return max(1, min(asked or cores, cores, room, jobs))
