"""The journal ``.super-sdf-batch`` in the output folder: what a batch is about to write there.

A line is a JSON string, the name of an output that is started; or an object with the SHA-256 of a
mesh that is about to be moved to its name. If the process is killed, the next batch knows from it
which outputs may be unfinished, and which meshes a batch made although the report has no row of
them.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from ..errors import WriteError
from ..machine.records import RecordFile

NAME = ".super-sdf-batch"
LOCK_NAME = f"{NAME}.lock"


class Journal(NamedTuple):
    """The outputs that were started, and by output the SHA-256 of the meshes that were made."""

    started: set[str]
    made: dict[str, set[str]]


def read_journal(folder: Path) -> Journal:
    """Return what a folder's journal holds; lines that are not the journal's are skipped."""
    journal = Journal(set(), {})
    with suppress(OSError):
        for line in _journal_file(folder).read():
            if isinstance(line, str) and _is_within(line):
                journal.started.add(line)
            elif isinstance(line, dict):
                target, digest = line.get("out"), line.get("sha256")
                if isinstance(target, str) and isinstance(digest, str):
                    journal.made.setdefault(target, set()).add(digest)
    return journal


def note_started(folder: Path, target: str) -> None:
    """Note that an output is about to be written."""
    _append(folder, target)


def note_made(folder: Path, target: str, digest: str) -> None:
    """Note the SHA-256 of a mesh that is about to be moved to its name; any process may call it."""
    _append(folder, {"out": target, "sha256": digest})


def clear_journal(folder: Path) -> None:
    """Empty the journal: nothing is unfinished."""
    _journal_file(folder).clear()


def _append(folder: Path, record: Any) -> None:
    file = _journal_file(folder)
    try:
        file.append(record)
    except OSError as error:
        raise WriteError(f"{file.path} cannot be written: {error.strerror}") from error


def _journal_file(folder: Path) -> RecordFile:
    return RecordFile(folder / NAME, is_shared=True)


def _is_within(target: str) -> bool:
    """Return whether an output lies in its folder: unfinished files are removed nowhere else."""
    return not PurePath(target).is_absolute() and ".." not in PurePath(target).parts
