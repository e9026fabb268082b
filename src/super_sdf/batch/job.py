"""One file of a batch: the job, and the row of the report with its outcome."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from ..convert import Conversion, ConvertOptions, convert
from ..errors import FileError, GridError, OptionError, WriteError
from ..files.regular import check_grid_file
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

    def load_network(self, threads: int) -> Network:
        """Return the network of a worker."""
        return load_network(
            self.model, device=self.device, threads=threads, precision=self.precision
        )


@dataclass(frozen=True)
class Job:
    """A grid to convert: the path as it was given, the mesh below the output folder, and how.

    ``replace`` says whether an existing file may be replaced; decided when the job starts.
    """

    source: Path
    target: str
    options: ConvertOptions
    replace: bool = False


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
    start, target = time.perf_counter(), settings.folder / job.target
    content, printed = fingerprint(job.source), []
    has_appeared = not job.replace and os.path.lexists(target)

    def note(part: Path) -> None:
        if (mesh_print := fingerprint(part)) is None:
            raise WriteError(f"{part} cannot be read again")
        printed.append(mesh_print)
        if has_appeared and mesh_print["sha256"] != (fingerprint(target) or {}).get("sha256"):
            raise WriteError(
                f"{target} exists and is not what this batch makes: remove it or use --force"
            )

    try:
        check_grid_file(job.source)
        _make_folder(target.parent)
        done = convert(
            job.source,
            target,
            network,
            job.options,
            force=job.replace or has_appeared,
            progress=progress,
            before_rename=note,
            keep=settings.check or settings.items is not None,
        )
    except Exception as error:  # a bug that one file shows must not cost the others
        by_input = isinstance(error, (GridError, OptionError, FileError))
        retry = not by_input or isinstance(error, WriteError)
        row = failed_row(job, _reason(error), retry=retry, content=content)
        return {**row, "seconds": round(time.perf_counter() - start, 4)}
    certificate = {}
    if settings.items or settings.check:
        certificate = {"check": _certify(job, done, printed[0], settings)}
    return {
        **_paths(job),
        "status": "ok",
        "reason": None,
        "retry": False,
        "content": content,
        "output": printed[0],
        **done.report(),
        **certificate,
        "seconds": round(time.perf_counter() - start, 4),
        "stages": {stage: round(spent, 4) for stage, spent in done.seconds.items()},
    }


def _certify(job: Job, done: Conversion, mesh: Fingerprint, settings: Settings) -> dict[str, Any]:
    """Return the certificate of a finished mesh, or under ``error`` why it has none.

    What a page shows of the mesh is written into the folder for that, if there is one.
    """
    from ..certificate.check import check_files

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
