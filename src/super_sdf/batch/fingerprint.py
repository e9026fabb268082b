"""Fingerprints of files, which show whether a file has changed since the last run.

If size and modification time are the same, it has not; otherwise the SHA-256 of its content tells.
On current processors SHA-256 is the fastest of Python's hashes.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

CHUNK = 1 << 20  # bytes read at a time
Fingerprint = dict[str, Any]
"""``sha256``, ``size`` in bytes and ``mtime_ns``, as written in JSON."""


def fingerprint(path: Path) -> Fingerprint | None:
    """Return the fingerprint of a file, None if it cannot be read or is no regular file."""
    try:
        if not path.is_file():  # opening a pipe would block
            return None
        with path.open("rb", buffering=0) as file:
            state = os.fstat(file.fileno())  # before reading, so that a change meanwhile shows
            digest = hashlib.sha256()
            left = state.st_size  # files that the system generates may have no end
            while left > 0 and (chunk := file.read(min(CHUNK, left))):
                digest.update(chunk)
                left -= len(chunk)
    except OSError:
        return None
    return {"sha256": digest.hexdigest(), "size": state.st_size, "mtime_ns": state.st_mtime_ns}


def is_unchanged(path: Path, known: Fingerprint | None, *, same_path: bool = True) -> bool:
    """Return whether a file still has a known fingerprint; None stands for an unreadable file.

    Its content is read only if the modification time or the path is another.
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


def is_fingerprint(value: Any) -> bool:
    """Return whether a value from JSON has the form of a fingerprint."""
    types = {"sha256": str, "size": int, "mtime_ns": int}
    return isinstance(value, dict) and all(type(value.get(k)) is t for k, t in types.items())
