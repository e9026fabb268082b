"""The store of an evaluation: a line of JSON for each shape, setting and method measured.

Rows are appended as they come, so a kill costs only the measurement under way. A line that is not a
row of this protocol is skipped, and measured again if it is still asked for.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import WriteError
from ..machine.records import RecordFile
from .measuring import NUMBERS, OPTIONAL_NUMBERS, PROTOCOL, TEXTS, Measurement, Task
from .names import PROCESS

# The key of a row, with types; everything else in a row are figures.
KEY_TYPES: dict[str, tuple[type, ...]] = {
    "shape": (str,),
    "mesh": (str,),
    "turned": (int, type(None)),  # rows of earlier versions lack it, as no shape was turned
    "size": (int,),
    "factor": (int,),
    "noise": (int, float),
    "scale": (int, float),
    "passes": (int,),
    "method": (str,),
    "digest": (str,),
    "protocol": (int,),
}
LARGEST = 1e300  # a larger number shows that the line is damaged


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
        """Return the measurement of a method, None if there is none."""
        key = task.key(method)
        return self.rows.get(tuple(key[name] for name in KEY_TYPES))

    def is_final(self, task: Task, method: str) -> bool:
        """Return whether a method need not be measured again.

        A failure may have a passing cause, so it is measured again. What ran out of time is
        measured again only with a higher limit.
        """
        row = self.get(task, method)
        if row is None or row["error"] is None:
            return row is not None
        limit = row.get("limit")
        return limit is not None and task.limit is not None and limit >= task.limit

    def _take(self, row: Measurement) -> None:
        self.rows[tuple(row.get(name) for name in KEY_TYPES)] = row


def is_row(record: Any) -> bool:
    """Return whether a parsed line is a complete measurement, or a failure, of this protocol."""
    if not isinstance(record, dict) or record.get("protocol") != PROTOCOL:
        return False
    if not all(type(record.get(name)) in kinds for name, kinds in KEY_TYPES.items()):
        return False
    if record.get("error", 0) is not None:
        return isinstance(record.get("error"), str) and is_number(record.get("limit") or 0)
    if record["method"] == PROCESS:
        return is_number(record.get("seconds")) and is_number(record.get("peak_mb"))
    notes = record.get("notes")
    return (
        all(is_number(record.get(name)) for name in NUMBERS)
        and all(is_number(record.get(name) or 0) for name in OPTIONAL_NUMBERS)
        and all(isinstance(record.get(name) or "", str) for name in TEXTS)
        and isinstance(notes, list)
        and all(isinstance(note, str) for note in notes)
    )


def is_number(value: Any) -> bool:
    """Return whether a value is a finite number or a bool."""
    return isinstance(value, (int, float)) and -LARGEST < value < LARGEST
