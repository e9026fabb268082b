"""One file of a batch: the job, and the row of the report with its outcome."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from ..convert import Conversion, ConvertOptions, convert
from ..errors import FileError, GridError, OptionError, WriteError
from ..files.meshes import format_of
from ..files.regular import check_grid_file
from ..labels.files import convert_labels
from ..labels.names import Names
from ..network.network import Network, load_network
from ..options import AUTO, AUTO_PRECISION, Device, Precision
from ..progress import Progress
from .ledger import Fingerprint, Row, fingerprint


@dataclass(frozen=True)
class Settings:
    """How a batch is run; the network is named as for ``load_network``."""

    folder: Path  # of the outputs
    model: str = "base"
    precision: Precision = AUTO_PRECISION
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
    began: float = field(default_factory=time.time)  # what is newer was not there before

    def load_network(self, threads: int) -> Network:
        """Return the network of a worker."""
        return load_network(
            self.model, device=self.device, threads=threads, precision=self.precision
        )


@dataclass(frozen=True)
class Job:
    """A grid to convert: the path as it was given, the mesh below the output folder, and how.

    ``replace`` are the existing files that may be replaced; decided when the job starts.
    """

    source: Path
    mesh: str
    options: ConvertOptions
    replace: frozenset[str] = frozenset()

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


class Result(NamedTuple):
    """A job and its row, of this run or an earlier one."""

    job: Job
    row: Row

    def failure(self) -> str:
        """Return which file failed and why, in one line."""
        source, reason = str(self.job.source), str(self.row["reason"])
        return one_line(reason if source in reason else f"{source}: {reason}")


def attempt(
    job: Job, settings: Settings, network: Network, progress: Progress | None = None
) -> Row:
    """Convert a file and return its row; an error becomes a row, too.

    A mesh that has appeared since the plan is replaced by the same mesh only: it was made by a
    process that was killed before the row was written. An exception in ``progress`` ends the work.
    """
    start, content = time.perf_counter(), fingerprint(job.source)
    convert_it = _convert if job.options.labels is None else _convert_labels
    prints = Prints(job, settings)
    try:
        check_grid_file(job.source)
        _make_folder((settings.folder / job.mesh).parent)
        facts = convert_it(job, settings, network, progress, prints)
    except Exception as error:  # a bug that one file shows must not cost the others
        by_input = isinstance(error, (GridError, OptionError, FileError))
        retry = not by_input or isinstance(error, WriteError)
        row = failed_row(job, _reason(error), retry=retry, content=content)
        return {**row, "seconds": round(time.perf_counter() - start, 4)}
    return {
        **_paths(job),
        "status": "ok",
        "reason": None,
        "retry": False,
        "content": content,
        "output": prints.get(job.target, dict(prints)),
        **facts,
        "seconds": round(time.perf_counter() - start, 4),
    }


class Prints(dict[str, Fingerprint]):
    """Fingerprints of the files that a job writes, by their names below the output folder."""

    def __init__(self, job: Job, settings: Settings) -> None:
        self.replace, self.settings = job.replace, settings

    def name(self, path: str | Path) -> str:
        """Return the name of a file in the output folder."""
        return Path(path).relative_to(self.settings.folder).as_posix()

    def take(self, parts: Mapping[Path, Path]) -> None:
        """Take complete files by their paths to be; WriteError if one would replace another."""
        for path, part in parts.items():
            if (made := fingerprint(part)) is None:
                raise WriteError(f"{part} cannot be read again")
            if os.path.lexists(path):
                self._check_may_replace(path, made["sha256"])
            self[self.name(path)] = made

    def _check_may_replace(self, path: Path, made: str) -> None:
        """Raise WriteError unless a file of this content may replace the one that is there."""
        if path.is_symlink():
            raise WriteError(f"{path} is a link: remove it")
        may = self.settings.force or self.name(path) in self.replace
        is_new = path.stat().st_mtime > self.settings.began
        if (is_new or not may) and made != (fingerprint(path) or {}).get("sha256"):
            raise WriteError(
                f"{path} was written while this batch ran: give its inputs other names (out)"
                if is_new
                else f"{path} exists and is not what this batch makes: remove it or use --force"
            )


def _convert(
    job: Job, settings: Settings, network: Network, progress: Progress | None, prints: Prints
) -> Row:
    """Convert a file; return what its row says of the mesh."""
    target = settings.folder / job.mesh
    done = convert(
        job.source,
        target,
        network,
        job.options,
        force=os.path.lexists(target),
        progress=progress,
        before_rename=lambda part: prints.take({target: part}),
        keep=settings.check or settings.items is not None,
    )
    facts = done.report()
    if settings.items or settings.check:
        facts["check"] = _certify(job, done, prints[job.target], settings)
    return {**facts, "stages": {stage: round(s, 4) for stage, s in done.seconds.items()}}


def _convert_labels(
    job: Job, settings: Settings, network: Network, progress: Progress | None, prints: Prints
) -> Row:
    """Convert the labels of a file; return what its row says of their meshes."""
    made = convert_labels(
        job.source,
        settings.folder / job.mesh,
        network,
        job.options,
        names=settings.names,
        force=True,  # ``prints`` decides file by file
        progress=progress,
        before_rename=prints.take,
    )
    labels = [{**row, "output": prints.name(row["output"])} for row in made.labels]
    return {**made.report(), "labels": labels, "closed": made.closed, "warnings": []}


def _certify(job: Job, done: Conversion, mesh: Fingerprint, settings: Settings) -> dict[str, Any]:
    """Return the certificate of a finished mesh, or under ``error`` why it has none.

    What a page shows of the mesh is written into the folder for that, if there is one.
    """
    from ..check.check import check_files

    files = settings.folder / job.target, job.source, job.options
    try:
        if settings.items is None:
            return check_files(*files, kept=done.kept).report()
        from ..pages.items import item_of_files, keep_item

        item = item_of_files(*files, done.kept)
        keep_item(item, settings.items, job.target, mesh["sha256"])
        return item.certificate or {}
    except Exception as error:  # the mesh is good all the same
        return {"error": _reason(error)}


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WriteError(f"{folder} cannot be made: {error.strerror}") from error
    except RecursionError:
        raise WriteError(f"{folder} cannot be made: too many folders within each other") from None


def failed_row(job: Job, reason: str, *, retry: bool = True, content: Any = None) -> Row:
    """Return the row of a job that failed."""
    outcome = {"status": "failed", "reason": reason, "retry": retry, "content": content}
    return {**_paths(job), **outcome, "output": None, "seconds": 0.0}


def _paths(job: Job) -> Row:
    return {"in": os.path.abspath(job.source), "out": job.target}


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
