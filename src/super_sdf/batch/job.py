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
from ..network.decoder import Decoder
from ..progress import Progress
from .fingerprint import Fingerprint, fingerprint

Row = dict[str, Any]
"""A line of the ledger, ``report.jsonl``.

in, out : absolute path of the input; path of the output, relative to the output folder
status, reason : "ok" and None, or "failed" and why
retry : whether another run may succeed with the same input and options
content, output : fingerprints of the input and of the mesh
options : digest of all that the mesh depends on, besides the input
mesher : what made the triangles
simplified : with ``--simplify`` or ``--triangles``, triangles before and after, and distances
check : with ``--check`` the certificate, or why there is none
seconds : time in all; that of each stage is in ``stages``
"""


@dataclass(frozen=True)
class Job:
    """A grid to convert: the path as it was given, the mesh below the output folder, and how.

    ``replace`` says whether an existing file may be replaced; decided when the job starts.
    """

    source: Path
    target: str
    options: ConvertOptions
    replace: bool = False


@dataclass(frozen=True)
class Outputs:
    """The output folder; whether meshes are checked; the folder for what a page shows of them."""

    folder: Path
    check: bool = False
    items: Path | None = None


class Result(NamedTuple):
    """A job and its row, of this run or an earlier one."""

    job: Job
    row: Row

    def failure(self) -> str:
        """Return which file failed and why, in one line."""
        source, reason = str(self.job.source), str(self.row["reason"])
        return one_line(reason if source in reason else f"{source}: {reason}")


def attempt(job: Job, outputs: Outputs, network: Decoder, progress: Progress | None = None) -> Row:
    """Convert a file and return its row; an error becomes a row, too.

    A mesh that has appeared since the plan is replaced by the same mesh only: it was made by a
    process that was killed before the row was written. An exception in ``progress`` ends the work.
    """
    start, target = time.perf_counter(), outputs.folder / job.target
    content, printed = fingerprint(job.source), []
    has_appeared = not job.replace and os.path.lexists(target)

    def note(part: Path) -> None:
        printed.append(_print_of_mesh(part))
        if has_appeared and printed[0]["sha256"] != (fingerprint(target) or {}).get("sha256"):
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
            keep=outputs.check or outputs.items is not None,
        )
    except Exception as error:  # a bug that one file shows must not cost the others
        by_input = isinstance(error, (GridError, OptionError, FileError))
        retry = not by_input or isinstance(error, WriteError)
        row = failed_row(job, _reason(error), retry=retry, content=content)
        return {**row, "seconds": _since(start)}
    certificate = {}
    if outputs.items or outputs.check:
        certificate = {"check": _certify(job, done, printed[0], outputs)}
    return {
        **_paths(job),
        "status": "ok",
        "reason": None,
        "retry": False,
        "content": content,
        "output": printed[0],
        "mesher": job.options.mesher,
        **done.report(),
        **certificate,
        "seconds": _since(start),
        "stages": {stage: round(spent, 4) for stage, spent in done.seconds.items()},
    }


def _certify(
    job: Job, done: Conversion, mesh_print: Fingerprint, outputs: Outputs
) -> dict[str, Any]:
    """Return the certificate of a finished mesh, or under ``error`` why it has none.

    With ``items`` of the outputs, what a page shows of the mesh is written there.
    """
    from ..certificate.check import check_files

    files = outputs.folder / job.target, job.source, job.options
    try:
        if outputs.items is None:
            return check_files(*files, kept=done.kept).report()
        from ..pages.items import item_of_files
        from .items import Items

        item = item_of_files(*files, done.kept)
        Items(outputs.items).add(item, job.target, mesh_print)
        return item.certificate or {}
    except Exception as error:  # the mesh is good all the same
        return {"error": _reason(error)}


def _print_of_mesh(part: Path) -> Fingerprint:
    """Return the fingerprint of a finished mesh, before it is moved to its name."""
    mesh_print = fingerprint(part)
    if mesh_print is None:
        raise WriteError(f"{part} cannot be read again")
    return mesh_print


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
    """Return the entries that every row begins with."""
    return {"in": os.path.abspath(job.source), "out": job.target}


def _since(start: float) -> float:
    return round(time.perf_counter() - start, 4)


def _reason(error: Exception) -> str:
    """Return what went wrong, in one line."""
    if isinstance(error, MemoryError) and not _is_ours(error):
        return "out of memory: use a smaller --factor or grid"
    if isinstance(error, OSError) and not _is_ours(error):  # no bug: a name too long, say
        return f"the system refuses it: {error.strerror or error}"
    first = one_line(next(iter(str(error).splitlines()), ""))
    return first if _is_ours(error) else f"{type(error).__name__}: {first}"


def _is_ours(error: Exception) -> bool:
    """Return whether an error is of this package's own classes, whose messages are for users."""
    return type(error).__module__ == GridError.__module__


def one_line(text: str) -> str:
    """Return a text as one printable line; other characters, as in file names, are escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
