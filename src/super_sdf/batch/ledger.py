"""The ledger ``report.jsonl``: a JSON line for every file that was converted, or failed.

Lines are appended, and the last one of an output counts. A file is also entered when its conversion
starts ("started"): a batch that is killed leaves that as its last line, so the next one knows what
may be unfinished, and which meshes may be of a batch although they have no row. A killed process
leaves at most the line that it was writing unfinished, which is cut off before the next one is
written. Damage by a power cut shows in the sizes and hashes in the lines.
"""

from __future__ import annotations

import os
from pathlib import Path, PurePath
from typing import Any

from ..errors import FileError, WriteError
from ..files.output import remove_abandoned_parts
from ..machine.records import RecordFile, parse_line
from .fingerprint import Fingerprint, is_fingerprint
from .job import Job, Row

NAME = "report.jsonl"
TYPES: dict[str, tuple[type, ...]] = {
    "reason": (str, type(None)),
    "retry": (bool,),
    "options": (str,),
}
ROW_START = b'{"in": "'  # of every line


class Ledger:
    """The rows of an output folder, by output.

    Attributes
    ----------
    rows : dict
        The last finished row of each output.
    written : dict
        The fingerprint of the last mesh that a batch wrote of each output.
    started : set of str
        The outputs that were started and not finished: a part of a mesh, or a mesh that has no row,
        may be there.

    Raises
    ------
    FileError
        If something else has the report's name, or if it cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.path = folder, folder / NAME
        self.rows: dict[str, Row] = {}
        self.written: dict[str, Fingerprint] = {}
        self.started: set[str] = set()
        self.file = RecordFile(self.path)
        if os.path.exists(self.path):
            self._read()

    def start(self, job: Job) -> None:
        """Note that a file is about to be converted."""
        self.add({"in": os.path.abspath(job.source), "out": job.target, "status": "started"})

    def add(self, row: Row) -> None:
        """Keep a row, in memory and in the file."""
        try:
            self.file.append(row)
        except OSError as error:
            raise WriteError(f"{self.path} cannot be written: {error.strerror}") from error
        self._take(row)

    def clean_up(self) -> None:
        """Remove the unfinished parts of outputs whose processes have ended."""
        remove_abandoned_parts(self.folder / target for target in self.started)

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
        if row["status"] == "started":
            self.started.add(target)
            return
        self.rows[target] = row
        if row["status"] == "ok":
            self.written[target] = row["output"]
            self.started.discard(target)
        elif not os.path.lexists(self.folder / target):  # else its process died after writing it
            self.started.discard(target)


def is_unfinished_row(text: bytes) -> bool:
    """Return whether a file's only text can be the beginning of a row; no text can be, too."""
    is_start = text.startswith(ROW_START) or ROW_START.startswith(text)
    return is_start and parse_line(text) is None


def is_row(record: Any) -> bool:
    """Return whether a parsed line is a row, with all the keys that are looked up in one."""
    if not isinstance(record, dict) or not all(type(record.get(k)) is str for k in ("in", "out")):
        return False
    if record.get("status") == "started":
        target = PurePath(record["out"])  # unfinished files are removed nowhere else
        return not target.is_absolute() and ".." not in target.parts
    if not all(type(record.get(key, record)) in types for key, types in TYPES.items()):
        return False
    content, output = (record.get(key, record) for key in ("content", "output"))
    if content is not None and not is_fingerprint(content):
        return False
    if record.get("status") == "ok":
        return is_fingerprint(output) and type(record.get("closed")) is bool
    return record.get("status") == "failed" and output is None
