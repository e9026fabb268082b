"""The journal ``.super-sdf-batch`` in the output folder: what a batch is about to write there.

A line is a JSON string, the name of an output that is started; or an object with the SHA-256 of a
mesh that is about to be moved to its name. If the process is killed, the next batch knows from it
which outputs may be unfinished, and which meshes a batch made although the report has no row of
them.

On a cluster, each other machine has a journal of its own, ``.super-sdf-batch.MACHINE``: network
file systems do not let two machines append to one file.
"""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Iterator
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
    for line in _lines(folder):
        if isinstance(line, str) and _is_within(line):
            journal.started.add(line)
        elif isinstance(line, dict):
            target, digest = line.get("out"), line.get("sha256")
            if isinstance(target, str) and isinstance(digest, str):
                journal.made.setdefault(target, set()).add(digest)
    return journal


def _lines(folder: Path) -> Iterator[Any]:
    """Yield what the lines of all machines' journals hold."""
    with suppress(OSError):
        yield from _journal_file(folder).read()
    for path in _others(folder):
        with suppress(OSError):
            yield from RecordFile(path, is_shared=True).read()


def _others(folder: Path) -> list[Path]:
    """Return the journals of other machines."""
    with suppress(OSError):
        names = sorted(name for name in os.listdir(folder) if is_journal(name))
        return [path for path in map(folder.joinpath, names) if path.is_file()]
    return []


def is_journal(name: str) -> bool:
    """Return whether a file name is that of another machine's journal."""
    return name.startswith(f"{NAME}.") and name.casefold() != LOCK_NAME


def note_started(folder: Path, target: str) -> None:
    """Note that an output is about to be written."""
    _append(folder, target)


def note_made(folder: Path, target: str, digest: str, host: str = "") -> None:
    """Note the SHA-256 of a mesh that is about to be moved to its name; any process may call it.

    ``host`` is the machine that runs the batch; "" for this one.
    """
    here = socket.gethostname()
    own = host and here != host
    _append(folder, {"out": target, "sha256": digest}, re.sub(r"[^\w-]", "_", here) if own else "")


def clear_journal(folder: Path) -> None:
    """Empty the journal: nothing is unfinished."""
    _journal_file(folder).clear()
    for path in _others(folder):
        with suppress(OSError):
            path.unlink()


def _append(folder: Path, record: Any, host: str = "") -> None:
    file = _journal_file(folder, host)
    try:
        file.append(record)
    except OSError as error:
        raise WriteError(f"{file.path} cannot be written: {error.strerror}") from error


def _journal_file(folder: Path, host: str = "") -> RecordFile:
    return RecordFile(folder / (f"{NAME}.{host}" if host else NAME), is_shared=True)


def _is_within(target: str) -> bool:
    """Return whether an output lies in its folder: unfinished files are removed nowhere else."""
    return not PurePath(target).is_absolute() and ".." not in PurePath(target).parts
