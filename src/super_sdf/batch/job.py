"""One file of a batch: what is to be done, and the row that says what came of it."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from ..convert import ConvertOptions, convert
from ..errors import FileError, GridError, OptionError, WriteError
from ..files.regular import check_regular_file
from ..network.decoder import Decoder
from .fingerprint import Fingerprint, fingerprint
from .journal import note_made

Row = dict[str, Any]
"""A line of the ledger.

in, out : the input's absolute path; the output's, relative to the output folder
status, reason : "ok", None; or "failed", why
retry : whether it failed for a reason that another run may not meet
content, output : fingerprints of the input, and of the mesh
options : digest of all that the mesh depends on beside the input
seconds : the time it took in all; the stages' are in ``stages``
"""


@dataclass(frozen=True)
class Job:
    """A grid to convert: its path as it was given, the mesh's within the output folder.

    ``replace``: whether a file that is there may be replaced, asked when the job begins.
    """

    source: Path
    target: str
    options: ConvertOptions
    replace: bool = False


class Result(NamedTuple):
    """What came of a job, now or in a run before."""

    job: Job
    row: Row

    def failure(self) -> str:
        """Return which file failed, and why, in a line."""
        source, reason = str(self.job.source), str(self.row["reason"])
        return in_a_line(reason if source in reason else f"{source}: {reason}")


def attempt(job: Job, folder: Path, network: Decoder) -> Row:
    """Convert a file and return its row; whatever goes wrong stands in the row."""
    start, target = time.perf_counter(), folder / job.target
    content, made = fingerprint(job.source), []

    def note(part: Path) -> None:
        made.append(_note_mesh(part, folder, job.target))

    try:
        check_regular_file(job.source)
        _make_folder(target.parent)
        done = convert(
            job.source, target, network, job.options, force=job.replace, before_rename=note
        )
    except Exception as error:  # a bug that one file shows must not cost the others
        row = failed_row(job, _reason(error), retry=not _is_inputs_fault(error), content=content)
        return {**row, "seconds": _since(start)}
    return {
        **_head(job),
        "status": "ok",
        "reason": None,
        "retry": False,
        "content": content,
        "output": made[0],
        **done.report(),
        "seconds": _since(start),
        "stages": {stage: round(spent, 4) for stage, spent in done.seconds.items()},
    }


def _note_mesh(part: Path, folder: Path, target: str) -> Fingerprint:
    """Note in the journal which mesh is about to take its name; return its fingerprint."""
    made = fingerprint(part)
    if made is None:
        raise WriteError(f"{part} cannot be read again")
    note_made(folder, target, made["sha256"])
    return made


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WriteError(f"{folder} cannot be made: {error.strerror}") from error
    except RecursionError:
        raise WriteError(f"{folder} cannot be made: too many folders within each other") from None


def failed_row(job: Job, reason: str, *, retry: bool = True, content: Any = None) -> Row:
    """Return the row of a job that failed."""
    said = {"status": "failed", "reason": reason, "retry": retry, "content": content}
    return {**_head(job), **said, "output": None, "seconds": 0.0}


def _head(job: Job) -> Row:
    return {"in": os.path.abspath(job.source), "out": job.target}


def _since(start: float) -> float:
    return round(time.perf_counter() - start, 4)


def _is_inputs_fault(error: Exception) -> bool:
    """Say whether the same file with the same options will always fail so."""
    by_input = isinstance(error, (GridError, OptionError, FileError))
    return by_input and not isinstance(error, WriteError)


def _reason(error: Exception) -> str:
    """Return what went wrong, in a line."""
    if isinstance(error, MemoryError) and not _is_ours(error):
        return "out of memory: use a smaller --factor or grid"
    if isinstance(error, OSError) and not _is_ours(error):  # no bug: a name too long, say
        return f"the system refuses it: {error.strerror or error}"
    first = in_a_line(next(iter(str(error).splitlines()), ""))
    return first if _is_ours(error) else f"{type(error).__name__}: {first}"


def _is_ours(error: Exception) -> bool:
    return type(error).__module__ == GridError.__module__


def in_a_line(text: str) -> str:
    """Return a text as one line that any terminal shows, whatever is in the names of files."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
