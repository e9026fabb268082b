"""What a file was when it was looked at, so that one may say later whether it still is that.

Size and time of change answer at once where they are the same; else the content's SHA-256 does,
the fastest of Python's hashes on processors of today.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

CHUNK = 1 << 20  # bytes read at a time
Fingerprint = dict[str, Any]
"""``sha256``, ``size`` in bytes and ``mtime_ns``, as they stand in JSON."""


def fingerprint(path: Path) -> Fingerprint | None:
    """Return what a file is now, None if it cannot be read or is no regular file."""
    try:
        if not path.is_file():  # to open a pipe would wait for ever
            return None
        with path.open("rb", buffering=0) as file:
            state = os.fstat(file.fileno())  # before it is read: a change while it is shows later
            digest, left = hashlib.sha256(), state.st_size  # what the system makes up has no end
            while chunk := file.read(min(CHUNK, left)):
                digest.update(chunk)
                left -= len(chunk)
    except OSError:
        return None
    return {"sha256": digest.hexdigest(), "size": state.st_size, "mtime_ns": state.st_mtime_ns}


def is_unchanged(path: Path, known: Fingerprint | None, *, same_path: bool = True) -> bool:
    """Say whether a file is what it was; None stands for one that could not be read.

    It is read only if its time is another, or if it was known by another path.
    """
    if known is None:
        return not (os.path.isfile(path) and os.access(path, os.R_OK))
    state = None
    with suppress(OSError):
        state = path.stat()
    if state is None or state.st_size != known["size"]:
        return False
    if same_path and state.st_mtime_ns == known["mtime_ns"]:
        return True
    now = fingerprint(path)
    return now is not None and bool(now["sha256"] == known["sha256"])


def is_fingerprint(found: Any) -> bool:
    """Say whether something read from JSON is what ``fingerprint`` returns."""
    types = {"sha256": str, "size": int, "mtime_ns": int}
    return isinstance(found, dict) and all(type(found.get(k)) is t for k, t in types.items())
