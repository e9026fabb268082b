"""The ledger ``report.jsonl``: a JSON line for every file that was converted, or failed.

Lines are appended, and the last one of an output counts. A killed process leaves at most the line
that it was writing unfinished, which is cut off before the next one is written. Damage by a power
cut shows in the sizes and hashes in the lines.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from ..errors import FileError, WriteError
from ..machine.records import RecordFile, parse_line
from .fingerprint import Fingerprint, is_fingerprint
from .job import Row

NAME = "report.jsonl"
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
    """The rows of an output folder, by output.

    Attributes
    ----------
    rows : dict
        The last row of each output.
    written : dict
        The fingerprint of the last mesh that a batch wrote of each output.

    Raises
    ------
    FileError
        If something else has the report's name, or if it cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / NAME
        self.rows: dict[str, Row] = {}
        self.written: dict[str, Fingerprint] = {}
        self.file = RecordFile(self.path)
        if os.path.exists(self.path):
            self._read()

    def add(self, row: Row) -> None:
        """Keep a row, in memory and in the file."""
        try:
            self.file.append(row)
        except OSError as error:
            raise WriteError(f"{self.path} cannot be written: {error.strerror}") from error
        self._take(row)

    def _read(self) -> None:
        try:
            if self.path.is_file():  # opening a pipe would block
                for record in self.file.read():
                    if is_row(record):
                        self._take(record)
                is_first = not self.file.whole_bytes
                if self.rows or (is_first and is_unfinished_row(self.file.unfinished)):
                    return
        except OSError as error:
            raise FileError(f"{self.path} cannot be read: {error.strerror}") from error
        raise FileError(
            f"{self.path} is not a batch's report: move it, or give another folder for the meshes"
        )

    def _take(self, row: Row) -> None:
        self.rows[row["out"]] = row
        if row["status"] == "ok":
            self.written[row["out"]] = row["output"]


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
