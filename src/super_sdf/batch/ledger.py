"""What is done: ``report.jsonl``, a JSON line for every file that was finished.

Lines are appended, and the last one of an output counts. Each is handed to the system whole and at
once, so a killed process tears at most the line it was writing, which is cut off at the next start.
There is no fsync: it takes as long as a small grid (2 ms), and what a power cut may cost, the sizes
and hashes in the lines show.
"""

from __future__ import annotations

import json
from pathlib import Path

from ..errors import WriteError
from .job import Row

NAME = "report.jsonl"
KEYS = {"in", "out", "status", "reason", "retry", "content", "output", "options"}


class Ledger:
    """The rows of an output folder, by output.

    Attributes
    ----------
    rows : dict
        The last row of each output.
    written : set of str
        The outputs that were ever written by a batch, so that it may write them again.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / NAME
        self.rows: dict[str, Row] = {}
        self.written: set[str] = set()
        self.whole = 0  # bytes in whole lines
        if self.path.is_file():
            self._read()

    def add(self, row: Row) -> None:
        """Keep a row, in memory and in the file."""
        self._take(row)
        line = (json.dumps(row) + "\n").encode()
        try:
            with self.path.open("ab", buffering=0) as file:
                file.write(line)
        except OSError as error:
            raise WriteError(f"{self.path} cannot be written: {error.strerror}") from error

    def cut_torn_line(self) -> None:
        """Remove what a killed process left of its last line."""
        if self.path.is_file() and self.path.stat().st_size > self.whole:
            with self.path.open("r+b") as file:
                file.truncate(self.whole)

    def _read(self) -> None:
        for line in self.path.read_bytes().splitlines(keepends=True):
            if not line.endswith(b"\n"):
                return
            self.whole += len(line)
            self._parse(line)

    def _parse(self, line: bytes) -> None:
        """Take a line, unless it is none of ours."""
        try:
            row = json.loads(line)
        except ValueError:
            return
        if isinstance(row, dict) and row.keys() >= KEYS:
            self._take(row)

    def _take(self, row: Row) -> None:
        self.rows[row["out"]] = row
        if row["status"] == "ok":
            self.written.add(row["out"])
