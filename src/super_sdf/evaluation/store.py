"""The store of an evaluation: a line of JSON for each shape, setting and method measured.

Rows are appended as they come, so a kill costs only the measurement under way. A line that is not a
row of this protocol is skipped, and measured again if it is still asked for.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import WriteError
from ..machine.records import RecordFile
from .measuring import NUMBERS, OPTIONAL_NUMBERS, PROTOCOL, Measurement, Task
from .names import PROCESS

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
        self.file = RecordFile(path)
        self.rows: dict[tuple[Any, ...], Measurement] = {}
        for record in self.file.read():
            if is_row(record):
                self._take(record)

    def add(self, row: Measurement) -> None:
        """Keep a row, in memory and in the file.

        Raises
        ------
        WriteError
            If the file takes no more.
        """
        try:
            self.file.append(row)
        except OSError as error:
            raise WriteError(
                f"{self.file.path} cannot be written: {error.strerror}; the rows before are kept, "
                "and the same command goes on from there"
            ) from error
        self._take(row)

    def get(self, task: Task, method: str) -> Measurement | None:
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

    def _take(self, row: Measurement) -> None:
        self.rows[tuple(row[name] for name in KEY_TYPES)] = row


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
