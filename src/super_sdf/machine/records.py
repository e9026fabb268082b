"""Append-only files of JSON lines, each written whole or not at all.

A file system that runs out of room may accept a part of what is written and tell so by the returned
number alone, so that number is checked. There is no fsync: it would take 2 ms, as long as a small
grid.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, Any


class RecordFile:
    """A file of JSON lines.

    Parameters
    ----------
    path : Path
        The file; it need not exist.
    is_shared : bool
        Whether several processes append to it at the same time. If not, a line that a killed
        process left unfinished is cut off when the next one is appended.

    Attributes
    ----------
    whole_bytes : int
        Length of the finished lines, after ``read``.
    unfinished : bytes
        What stands after them, after ``read``.
    """

    def __init__(self, path: Path, *, is_shared: bool = False) -> None:
        self.path, self.is_shared = path, is_shared
        self.whole_bytes = 0
        self.unfinished = b""

    def read(self) -> Iterator[Any]:
        """Yield what each finished line holds; None for a line that is not valid JSON.

        Of a shared file also what an unfinished last line holds: it may lack its line break only.

        Raises
        ------
        OSError
            If the file exists and cannot be read.
        """
        self.whole_bytes, self.unfinished = 0, b""
        with suppress(FileNotFoundError), self.path.open("rb") as file:
            for line in file:
                if line.endswith(b"\n"):
                    self.whole_bytes += len(line)
                    yield parse_line(line)
                else:
                    self.unfinished = line
                    if self.is_shared:
                        yield parse_line(line)

    def append(self, record: Any) -> None:
        """Append a record as a line; after an error the file is as it was before.

        Raises
        ------
        OSError
            If there is no room, say.
        """
        line = f"{json.dumps(record)}\n"
        with self.path.open("ab", buffering=0) as file:
            if self.is_shared:  # a killed process may have left half a line before this one
                write_whole(file, f"\n{line}".encode())
                return
            size = file.seek(0, 2)
            if self.unfinished and size == self.whole_bytes + len(self.unfinished):
                size = file.truncate(self.whole_bytes)
            self.unfinished = b""
            try:
                write_whole(file, line.encode())
            except OSError:
                with suppress(OSError):  # a device, say: the first error tells more
                    file.truncate(size)
                raise

    def clear(self) -> None:
        """Remove all records; nothing happens if the file cannot be written."""
        with suppress(OSError), self.path.open("r+b") as file:
            file.truncate(0)


def write_whole(file: IO[bytes], data: bytes) -> None:
    """Write all bytes to an unbuffered file; raise OSError if there is no room for them."""
    left = memoryview(data)
    while left:
        left = left[file.write(left) :]


def parse_line(line: bytes) -> Any:
    """Return what a line of JSON holds, None if it is not valid or nested too deeply to parse."""
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None
