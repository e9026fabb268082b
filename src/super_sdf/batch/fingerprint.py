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
from ..files.store import is_store

CHUNK = 1 << 20  # bytes read at a time
Fingerprint = dict[str, Any]
"""``sha256``, ``size`` in bytes and ``mtime_ns``, as written in JSON."""


def file_state(path: Path) -> tuple[int, int]:
    """Return size and time of the last change, in ns; of a Zarr folder those of all its files.

    ``path`` may name an array in the file.
    """
    file, _ = split_member(path)
    states = [part.stat() for part in (_parts(file) if is_store(file) else [file])]
    return sum(s.st_size for s in states), max((s.st_mtime_ns for s in states), default=0)


def _parts(folder: Path) -> list[Path]:
    """Return all files below a folder, sorted."""
    found = [Path(path, name) for path, _, names in os.walk(folder) for name in names]
    return sorted(found)


def fingerprint(path: Path) -> Fingerprint | None:
    """Return the fingerprint of a file, None if it cannot be read or is no regular file.

    Of a Zarr folder it covers the names and contents of all files in it.
    """
    file, _ = split_member(path)
    digest = hashlib.sha256()
    try:
        size, changed = file_state(file)  # before reading, so that a change meanwhile shows
        if is_store(file):
            for part in _parts(file):
                digest.update(str(part.relative_to(file)).encode() + b"\0")
                _add(digest, part)
        elif file.is_file():  # opening a pipe would block
            _add(digest, file)
        else:
            return None
    except OSError:
        return None
    return {"sha256": digest.hexdigest(), "size": size, "mtime_ns": changed}


def _add(digest: Any, path: Path) -> None:
    """Add the content of a file to a digest."""
    with path.open("rb", buffering=0) as file:
        left = os.fstat(file.fileno()).st_size  # files that the system generates may have no end
        while left > 0 and (chunk := file.read(min(CHUNK, left))):
            digest.update(chunk)
            left -= len(chunk)


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
