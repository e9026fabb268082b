"""Append-only files of JSON lines, each written whole or not at all, by one process at a time.

A file system that runs out of room may accept a part of what is written and tell so by the returned
number alone, so that number is checked. There is no fsync: it would take 2 ms, as long as a small
grid.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any


class RecordFile:
    """A file of JSON lines, which need not exist.

    A line that a killed process left unfinished is cut off when the next one is appended. After
    ``read``, the finished lines have ``whole_bytes``, and ``unfinished`` is what follows them.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.whole_bytes = 0
        self.unfinished = b""

    def read(self) -> Iterator[Any]:
        """Yield what each finished line holds; None for a line that is not valid JSON."""
        self.whole_bytes, self.unfinished = 0, b""
        with suppress(FileNotFoundError), self.path.open("rb") as file:
            for line in file:
                if line.endswith(b"\n"):
                    self.whole_bytes += len(line)
                    yield parse_line(line)
                else:
                    self.unfinished = line

    def append(self, record: Any) -> None:
        """Append a record as a line; after an OSError the file is as it was before."""
        left = memoryview(f"{json.dumps(record)}\n".encode())
        with self.path.open("ab", buffering=0) as file:
            size = file.seek(0, 2)
            if self.unfinished and size == self.whole_bytes + len(self.unfinished):
                size = file.truncate(self.whole_bytes)
            self.unfinished = b""
            try:
                while left:
                    left = left[file.write(left) :]
            except OSError:
                with suppress(OSError):  # a device, say: the first error tells more
                    file.truncate(size)
                raise


def parse_line(line: bytes) -> Any:
    """Return what a line of JSON holds, None if it is not valid or nested too deeply to parse."""
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None
