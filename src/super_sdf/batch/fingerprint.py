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

from ..files.formats import split_member
from ..files.regular import files_of, is_store

CHUNK = 1 << 20  # bytes read at a time
Fingerprint = dict[str, Any]
"""``sha256``, ``size`` in bytes and ``mtime_ns``, as written in JSON."""


def file_state(path: Path, files: list[Path] | None = None) -> tuple[int, int]:
    """Return size and time of the last change, in ns; of several files the sums.

    ``path`` may name an array in the file; ``files`` are those that are read for it.
    """
    states = [file.stat() for file in files or files_of(path)]
    return sum(s.st_size for s in states), sum(s.st_mtime_ns for s in states)


def fingerprint(path: Path) -> Fingerprint | None:
    """Return the fingerprint of a file, None if it cannot be read or is no regular file.

    Of a Zarr folder it covers the names and contents of all files in it; of a header or a network
    also those of the files that it names.
    """
    file, _ = split_member(path)
    digest = hashlib.sha256()
    try:
        if not (is_store(file) or file.is_file()):  # opening a pipe would block
            return None
        files = files_of(path)
        size, changed = file_state(path, files)  # before reading, so that a change meanwhile shows
        for part in files:
            if part != file:
                digest.update(os.fsencode(os.path.relpath(part, file)) + b"\0")
            with part.open("rb", buffering=0) as opened:
                left = os.fstat(opened.fileno()).st_size  # files of the system may have no end
                while left > 0 and (chunk := opened.read(min(CHUNK, left))):
                    digest.update(chunk)
                    left -= len(chunk)
    except OSError:
        return None
    return {"sha256": digest.hexdigest(), "size": size, "mtime_ns": changed}


def is_unchanged(path: Path, known: Fingerprint | None, *, same_path: bool = True) -> bool:
    """Return whether a file still has a known fingerprint; None stands for an unreadable file.

    Its content is read only if the modification time or the path is another.
    """
    if known is None:
        file, _ = split_member(path)
        return not ((os.path.isfile(file) or is_store(file)) and os.access(file, os.R_OK))
    state = None
    with suppress(OSError):
        state = file_state(path)
    if state is None or state[0] != known["size"]:
        return False
    if same_path and state[1] == known["mtime_ns"]:
        return True
    now = fingerprint(path)
    return now is not None and bool(now["sha256"] == known["sha256"])


def is_fingerprint(value: Any) -> bool:
    """Return whether a value from JSON has the form of a fingerprint."""
    types = {"sha256": str, "size": int, "mtime_ns": int}
    return isinstance(value, dict) and all(type(value.get(k)) is t for k, t in types.items())
