"""The rows of a measurement: a file of JSON lines that makes long runs resumable.

Rows are appended as they come, so a kill costs only the tasks under way. A row is valid as long as
its key is asked for; a line that is damaged is measured again.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from super_sdf.batch.record import RecordFile
from super_sdf.errors import WriteError

Key = Mapping[str, Any]
Row = dict[str, Any]


class Rows:
    """The rows of a file, by key."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.file = RecordFile(path)
        self.rows: dict[str, Row] = {}
        for record in self.file.read():
            if isinstance(record, dict) and isinstance(record.get("key"), dict):
                self.rows[name_of(record["key"])] = record

    def add(self, key: Key, figures: Row) -> None:
        """Keep a row, in memory and in the file."""
        record = {"key": dict(key), **figures}
        try:
            self.file.append(record)
        except OSError as error:
            raise WriteError(
                f"{self.file.path} cannot be written: {error.strerror}; the rows in it are kept, "
                "and the same command goes on from there"
            ) from error
        self.rows[name_of(key)] = record

    def get(self, key: Key) -> Row | None:
        """Return the row of a key, its entries among the figures; None if there is none."""
        record = self.rows.get(name_of(key))
        return None if record is None else flat(record)

    def is_final(self, key: Key, limit: float | None = None) -> bool:
        """Return whether a row need not be measured again.

        A failure may have a passing cause, so it is measured again. What ran out of time is
        measured again only with a higher limit.
        """
        row = self.get(key)
        if row is None or row.get("error") is None:
            return row is not None
        before = row.get("limit")
        return before is not None and limit is not None and before >= limit

    def __iter__(self) -> Iterator[Row]:
        return map(flat, self.rows.values())


def name_of(key: Key) -> str:
    """Return a key as text."""
    return json.dumps(key, sort_keys=True)


def flat(record: Row) -> Row:
    """Return the entries of a row's key and its figures."""
    return {**record["key"], **{name: value for name, value in record.items() if name != "key"}}
