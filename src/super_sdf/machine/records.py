"""Lines of JSON that are appended, each whole or not at all.

A system that runs out of room takes a part of what it is given and says so by a number alone, so
that number is looked at. There is no fsync: it takes as long as a small grid (2 ms).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import IO, Any


def append_line(path: Path, record: Any) -> None:
    """Append a record to a file that nobody else writes; after an error it is as it was before.

    Raises
    ------
    OSError
        If there is no room, say.
    """
    line = (json.dumps(record) + "\n").encode()
    with path.open("ab", buffering=0) as file:
        size = file.seek(0, 2)
        try:
            write_whole(file, line)
        except OSError:
            file.truncate(size)
            raise


def append_shared_line(path: Path, record: Any) -> None:
    """Append a record to a file that other processes write, too.

    What a killed process left of its line may stand before it, so a line break comes first; blank
    lines have no meaning.

    Raises
    ------
    OSError
        If there is no room, say.
    """
    with path.open("ab", buffering=0) as file:
        write_whole(file, f"\n{json.dumps(record)}\n".encode())


def write_whole(file: IO[bytes], data: bytes) -> None:
    """Write all of it to an unbuffered file; what has no room is an OSError."""
    left = memoryview(data)
    while left:
        left = left[file.write(left) :]


def parse_line(line: bytes) -> Any:
    """Return what a line holds, None if it is no JSON or nested too deeply for the parser."""
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None
