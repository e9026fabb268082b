"""The ledger ``report.jsonl``: a JSON line for every file that was converted, or failed.

Lines are appended, and the last one of an output counts. A killed process leaves at most the line
that it was writing unfinished, which is cut off before the next one is written. Damage by a power
cut shows in the sizes and hashes in the lines.

A file of the same form beside it has the names of the outputs that are started, and is empty when
nothing is unfinished: so the next batch knows what a killed one left, and which mesh may be its own
although it has no row.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path, PurePath
from typing import Any

from ..errors import FileError, WriteError
from ..files.output import remove_abandoned_parts
from ..machine.records import RecordFile, parse_line
from .fingerprint import Fingerprint, is_fingerprint, is_unchanged
from .job import Row

NAME, STARTED_NAME = "report.jsonl", ".super-sdf-batch"
TYPES: dict[str, tuple[type, ...]] = {
    "in": (str,),
    "out": (str,),
    "status": (str,),
    "reason": (str, type(None)),
    "retry": (bool,),
    "options": (str,),
}
ROW_START = b'{"in": "'  # of every line


class Ledger:
    """The rows of an output folder; FileError if something else has the name of its files.

    ``rows`` are the last finished ones by output, ``written`` the fingerprints of the last meshes
    that a batch wrote. This batch has ``started`` some outputs and not finished them. A killed
    one ``left`` others: a part of a mesh, or a mesh without a row, may be there.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.path = folder, folder / NAME
        self.rows: dict[str, Row] = {}
        self.written: dict[str, Fingerprint] = {}
        self.started, self.left = set[str](), set[str]()
        self.file, self.journal = RecordFile(self.path), RecordFile(folder / STARTED_NAME)
        if os.path.exists(self.path):
            self._read()
        self._read_left()

    def start(self, target: str) -> None:
        """Note that an output is about to be written."""
        self._append(self.journal, target)
        self.started.add(target)

    def add(self, row: Row) -> None:
        """Keep a row, in memory and in the file."""
        self._append(self.file, row)
        self._take(row)

    def remove_parts(self) -> None:
        """Remove the unfinished parts of outputs whose processes have ended."""
        remove_abandoned_parts(self.folder / target for target in self.started | self.left)

    def close(self) -> None:
        """Remove parts again, and forget what was started if nothing of it is unfinished."""
        self.remove_parts()
        self.left = {target for target in self.left if self._has_no_row(target)}
        if not (self.started or self.left):
            with suppress(OSError):
                os.truncate(self.journal.path, 0)

    def _has_no_row(self, target: str) -> bool:
        """Return whether the file of an output is there and is not as its row says."""
        path, known = self.folder / target, self.written.get(target)
        return os.path.lexists(path) and not (known and is_unchanged(path, known))

    def _append(self, file: RecordFile, record: Any) -> None:
        try:
            file.append(record)
        except OSError as error:
            raise WriteError(f"{file.path} cannot be written: {error.strerror}") from error

    def _read_left(self) -> None:
        path = self.journal.path
        if os.path.exists(path) and not path.is_file():  # opening a pipe would block
            raise FileError(f"{path} is no regular file: remove it")
        with suppress(OSError):
            for name in self.journal.read():
                # unfinished files are removed nowhere else
                if isinstance(name, str) and ".." not in PurePath(name).parts:
                    self.left |= set() if PurePath(name).is_absolute() else {name}

    def _read(self) -> None:
        is_report = False
        try:
            if self.path.is_file():  # opening a pipe would block
                for record in self.file.read():
                    if is_row(record):
                        is_report = True
                        self._take(record)
                is_first = not self.file.whole_bytes
                is_report |= is_first and is_unfinished_row(self.file.unfinished)
        except OSError as error:
            raise FileError(f"{self.path} cannot be read: {error.strerror}") from error
        if not is_report:
            raise FileError(
                f"{self.path} is not a batch's report: move it, or give another folder for the "
                "meshes"
            )

    def _take(self, row: Row) -> None:
        target = row["out"]
        self.rows[target] = row
        if row["status"] == "ok":
            self.written[target] = row["output"]
        if row["status"] == "ok" or not os.path.lexists(self.folder / target):
            self.started.discard(target)  # otherwise its process may have died after writing it


def is_unfinished_row(text: bytes) -> bool:
    """Return whether a file's only text can be the beginning of a row; no text can be, too."""
    is_start = text.startswith(ROW_START) or ROW_START.startswith(text)
    return is_start and parse_line(text) is None


def is_row(record: Any) -> bool:
    """Return whether a parsed line is a row, with all the keys that are looked up in one."""
    if not isinstance(record, dict):
        return False
    if not all(type(record.get(key, record)) in types for key, types in TYPES.items()):
        return False
    content, output = (record.get(key, record) for key in ("content", "output"))
    if content is not None and not is_fingerprint(content):
        return False
    if record["status"] == "ok":
        return is_fingerprint(output) and type(record.get("closed")) is bool
    return record["status"] == "failed" and output is None
