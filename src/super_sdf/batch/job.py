"""One file of a batch: the job, and the row of the report with its outcome."""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from ..convert import convert
from ..errors import FileError, GridError, OptionError, WriteError
from ..files.meshes import format_of
from ..files.output import naming
from ..files.regular import check_grid_file
from ..labels.files import Names, convert_labels
from ..network.network import Network, load_network
from ..options import AUTO, Device, Options, Precision
from .record import Row, fingerprint

load_once = lru_cache(maxsize=1)(load_network)


@dataclass(frozen=True)
class Settings:
    """How a batch is run; the network is named as for ``load_network``."""

    folder: Path  # of the outputs
    model: str = "base"
    precision: Precision = AUTO
    device: Device = AUTO
    threads: int = 0  # of each worker process; 0: chosen by the number of cores
    workers: int = 0
    force: bool = False  # convert everything again; replace files that are not as a batch made them
    retry: bool = False  # try inputs again that failed before
    fail_fast: bool = False  # start nothing more after the first failure
    check: bool = False  # against the samples; meshes without a certificate are made again
    items: Path | None = None  # the folder for what a page shows of each mesh
    cluster: str | None = None  # "local", or the address of a scheduler: where files are converted
    names: Names | None = None  # of labels


@dataclass(frozen=True)
class Job:
    """A grid to convert: the path as it was given, the mesh below the output folder, and how."""

    source: Path
    mesh: str
    options: Options

    @property
    def has_label_files(self) -> bool:
        """Whether each label has its own file, of a name that is known when it is written."""
        return self.options.labels is not None and not format_of(self.mesh).has_scene

    @property
    def target(self) -> str:
        """The name of the output: of the mesh, or for files of labels a pattern, ``a-*.stl``."""
        path = PurePath(self.mesh)
        if not self.has_label_files:
            return self.mesh
        return path.with_name(f"{path.stem}-*{path.suffix}").as_posix()

    def failed(self, reason: str, *, retry: bool = True, content: Any = None) -> Row:
        """Return the row of the job if it failed."""
        row: Row = {"in": os.path.abspath(self.source), "out": self.target, "status": "failed"}
        row |= {"reason": reason, "retry": retry, "content": content}
        return row | {"output": None, "seconds": 0.0}


class Result(NamedTuple):
    """A job and its row, of this run or an earlier one."""

    job: Job
    row: Row

    def failure(self) -> str:
        """Return which file failed and why, in one line."""
        source, reason = str(self.job.source), str(self.row["reason"])
        return one_line(reason if source in reason else f"{source}: {reason}")


def convert_job(job: Job, settings: Settings, stage: Path, threads: int) -> Row:
    """Convert a file to meshes in the folder ``stage``, by the names that they will have.

    An error becomes a row, too. The network is loaded once in each process; what that raises is
    raised here.
    """
    start, content, precision = time.perf_counter(), fingerprint(job.source), settings.precision
    network = load_once(
        settings.model, device=settings.device, threads=threads, precision=precision
    )
    row = job.failed("", content=content)
    try:
        check_grid_file(job.source)
        with naming(settings.folder / job.mesh):
            (stage / job.mesh).parent.mkdir(parents=True, exist_ok=True)
        make = _make_mesh if job.options.labels is None else _make_labels
        row |= make(job, settings, stage, network)
        row |= {"status": "ok", "reason": None, "retry": False}
    except Exception as error:  # a bug that one file shows must not cost the others
        by_input = isinstance(error, (GridError, OptionError, FileError))
        row["retry"] = not by_input or isinstance(error, WriteError)
        row["reason"] = _reason(error)
    row["seconds"] = round(time.perf_counter() - start, 4)
    # sentences may name files, which will be in the output folder
    staged, final = (json.dumps(str(path))[1:-1] for path in (stage, settings.folder))
    moved: Row = json.loads(json.dumps(row).replace(staged, final))
    return moved


def _make_mesh(job: Job, settings: Settings, stage: Path, network: Network) -> Row:
    """Convert a file; return what its row says of the mesh."""
    target = stage / job.mesh
    keep = settings.check or settings.items is not None
    done = convert(job.source, target, network, job.options, force=True)
    stages = {stage: round(seconds, 4) for stage, seconds in done.seconds.items()}
    row = {"output": fingerprint(target), **done.report(), "stages": stages}
    if not keep:
        return row
    from ..check.check import check_mesh, read_for_check

    try:
        if settings.items is None:
            found = check_mesh(*read_for_check(target, job.source, job.options, done), job.options)
            return {**row, "check": found.report()}
        from ..pages.items import item_of_files, keep_item

        item = item_of_files(target, job.source, job.options, done)
        keep_item(item, settings.items, job.target, row["output"]["sha256"])
        return {**row, "check": item.certificate or {}}
    except Exception as error:  # the mesh is good all the same
        return {**row, "check": {"error": _reason(error)}}


def _make_labels(job: Job, settings: Settings, stage: Path, network: Network) -> Row:
    """Convert the labels of a file; return what its row says of their meshes."""
    target, names = stage / job.mesh, settings.names
    made = convert_labels(job.source, target, network, job.options, names=names, force=True)
    labels = [
        {**row, "output": Path(row["output"]).relative_to(stage).as_posix()} for row in made.labels
    ]
    files = {row["output"]: fingerprint(stage / row["output"]) for row in labels}
    output = files if job.has_label_files else files[job.mesh]
    facts = {"labels": labels, "closed": made.closed, "warnings": []}
    return {"output": output, **made.report(), **facts}


def _reason(error: Exception) -> str:
    """Return what went wrong, in one line; the package's own messages are for users as they are."""
    first = one_line(next(iter(str(error).splitlines()), ""))
    if type(error).__module__ == GridError.__module__:
        return first
    if isinstance(error, MemoryError):
        return "out of memory: use a smaller --factor or grid"
    if isinstance(error, OSError):  # no bug: a name too long, say
        return f"the system refuses it: {error.strerror or error}"
    return f"{type(error).__name__}: {first}"


def one_line(text: str) -> str:
    """Return a text as one printable line; other characters, as in file names, are escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
