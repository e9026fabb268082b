"""The file that remembers what was measured: a line of JSON for each shape, setting and method.

Rows are appended as they come, so that a kill costs the one under way. A line that is no row of
this protocol is passed over, and what it stood for is measured again.
"""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..errors import WriteError
from .measuring import NUMBERS, OPTIONAL_NUMBERS, PROCESS, PROTOCOL, Row, Task

# What a row is known by, and the types of it; the rest of it are figures.
KEY_TYPES: dict[str, tuple[type, ...]] = {
    "shape": (str,),
    "mesh": (str,),
    "size": (int,),
    "factor": (int,),
    "noise": (int, float),
    "scale": (int, float),
    "passes": (int,),
    "method": (str,),
    "digest": (str,),
    "protocol": (int,),
}
LARGEST = 1e300  # a number beyond is damage


class Store:
    """The rows of a file of JSON lines, by key."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: dict[tuple[Any, ...], Row] = {}
        line = b"\n"
        if path.exists():
            with path.open("rb") as file:
                for line in file:
                    self._take_line(line)
        if not line.endswith(b"\n"):  # it was being written when the writer was killed
            self._write("\n")

    def add(self, row: Row) -> None:
        """Keep a row, in memory and in the file.

        Raises
        ------
        WriteError
            If the file takes no more.
        """
        self._take(row)
        self._write(json.dumps(row) + "\n")

    def get(self, task: Task, method: str) -> Row | None:
        """Return a method's row, if it was measured."""
        key = task.key(method)
        return self.rows.get(tuple(key[name] for name in KEY_TYPES))

    def is_final(self, task: Task, method: str) -> bool:
        """Say whether a row is there that another run would not better.

        A failure may have had a passing cause; one by the limit has not, unless given more time.
        """
        row = self.get(task, method)
        if row is None or row["error"] is None:
            return row is not None
        limit = row.get("limit")
        return limit is not None and task.limit is not None and limit >= task.limit

    def _take_line(self, line: bytes) -> None:
        """Take a line of the file if it is a row."""
        with suppress(ValueError, RecursionError):  # damaged, or nested too deep for the parser
            found = json.loads(line)
            if is_row(found):
                self._take(found)

    def _take(self, row: Row) -> None:
        self.rows[tuple(row[name] for name in KEY_TYPES)] = row

    def _write(self, text: str) -> None:
        try:
            with self.path.open("a", encoding="utf-8") as out:
                out.write(text)
        except OSError as error:
            raise WriteError(
                f"{self.path} cannot be written: {error.strerror}; the rows before are kept, and "
                "the same command goes on from there"
            ) from error


def is_row(found: Any) -> bool:
    """Say whether something read is a row of this protocol: a failure, or all its figures."""
    if not isinstance(found, dict) or found.get("protocol") != PROTOCOL:
        return False
    if not all(type(found.get(name)) in kinds for name, kinds in KEY_TYPES.items()):
        return False
    if found.get("error", 0) is not None:
        return isinstance(found.get("error"), str) and is_number(found.get("limit") or 0)
    if found["method"] == PROCESS:
        return is_number(found.get("seconds")) and is_number(found.get("peak_mb"))
    notes = found.get("notes")
    return (
        all(is_number(found.get(name)) for name in NUMBERS)
        and all(is_number(found.get(name) or 0) for name in OPTIONAL_NUMBERS)
        and isinstance(notes, list)
        and all(isinstance(note, str) for note in notes)
    )


def is_number(found: Any) -> bool:
    """Say whether something is a number, true and false among them, of a sensible size."""
    return isinstance(found, (int, float)) and -LARGEST < found < LARGEST
