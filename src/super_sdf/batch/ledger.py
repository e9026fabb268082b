"""What is done: ``report.jsonl``, a JSON line for every file that was finished.

Lines are appended, and the last one of an output counts. Each is written whole or not at all, so a
killed process tears at most the line it was writing, which is cut off at the next start. What a
power cut may cost, the sizes and hashes in the lines show.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from ..errors import FileError, WriteError
from ..machine.records import append_line, parse_line
from .fingerprint import is_fingerprint
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
HEAD = b'{"in": "'  # what every line begins with


class Ledger:
    """The rows of an output folder, by output.

    Attributes
    ----------
    rows : dict
        The last row of each output.
    written : set of str
        The outputs that were ever written by a batch, so that it may write them again.

    Raises
    ------
    FileError
        If something else has the report's name, or if it cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / NAME
        self.rows: dict[str, Row] = {}
        self.written: set[str] = set()
        self.whole = 0  # bytes in whole lines
        if os.path.exists(self.path):
            self._read()

    def add(self, row: Row) -> None:
        """Keep a row, in memory and in the file."""
        try:
            append_line(self.path, row)
        except OSError as error:
            raise WriteError(f"{self.path} cannot be written: {error.strerror}") from error
        self._take(row)

    def cut_torn_line(self) -> None:
        """Remove what a killed process left of its last line."""
        if os.path.exists(self.path) and self.path.stat().st_size > self.whole:
            with self.path.open("r+b") as file:
                file.truncate(self.whole)

    def _read(self) -> None:
        line = b"\n"
        try:
            if self.path.is_file():  # to open a pipe would wait for ever
                with self.path.open("rb") as file:
                    for line in file:
                        self._read_line(line)
                if self.rows or (self.whole == 0 and is_torn_row(line)):
                    return
        except OSError as error:
            raise FileError(f"{self.path} cannot be read: {error.strerror}") from error
        raise FileError(
            f"{self.path} is not a batch's report: move it, or give another folder for the meshes"
        )

    def _read_line(self, line: bytes) -> None:
        """Take a line, unless it is torn or none of ours."""
        if line.endswith(b"\n"):
            self.whole += len(line)
            row = parse_line(line)
            if is_row(row):
                self._take(row)

    def _take(self, row: Row) -> None:
        self.rows[row["out"]] = row
        if row["status"] == "ok":
            self.written.add(row["out"])


def is_torn_row(text: bytes) -> bool:
    """Say whether a file's only line can be a row that was being written; none at all can be."""
    begins = text.startswith(HEAD) or HEAD.startswith(text)
    return text == b"\n" or (begins and parse_line(text) is None)


def is_row(found: Any) -> bool:
    """Say whether something read is a row, with all that is looked up in one."""
    if not isinstance(found, dict):
        return False
    if not all(type(found.get(key, found)) in types for key, types in TYPES.items()):
        return False
    content, output = (found.get(key, found) for key in ("content", "output"))
    if content is not None and not is_fingerprint(content):
        return False
    if found["status"] == "ok":
        return is_fingerprint(output) and type(found.get("closed")) is bool
    return found["status"] == "failed" and output is None
