"""What a batch remembers: ``report.jsonl`` in its output folder, and fingerprints of files.

The report has a JSON line for every file that was converted, or failed; the last line of an output
counts. A line that a killed process left unfinished is passed over, and the next one replaces it.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from ..errors import FileError
from ..files.formats import files_of, is_store, split_member
from ..files.output import naming

NAME, LOCK_NAME, STAGE_NAME = "report.jsonl", ".super-sdf-batch.lock", ".super-sdf-parts"
KEYS = {"in", "out", "status", "retry", "content", "output", "asked"}  # of every row
CHUNK = 1 << 20  # bytes read at a time
NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP}  # some network drives

Fingerprint = dict[str, Any]
"""``sha256``, ``size`` in bytes and ``mtime_ns`` of a file, as written in JSON."""

Row = dict[str, Any]
"""A line of the report; docs/reference/json.md says what its keys mean."""


class Record:
    """The rows of an output folder; FileError if its ``report.jsonl`` is something else."""

    def __init__(self, folder: Path) -> None:
        self.path, self.size = folder / NAME, 0  # bytes of whole lines
        self.rows: dict[str, Row] = {}  # the last ones, by output
        # SHA-256 of all contents that a batch wrote, by output and name of the file
        self.made: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
        try:
            with suppress(FileNotFoundError), self.path.open("rb") as file:
                for line in file:
                    if line.endswith(b"\n"):
                        self.size += len(line)
                        with suppress(ValueError, RecursionError):
                            self._take(json.loads(line))
        except OSError as error:
            raise FileError(f"{self.path} cannot be read: {error.strerror}") from error
        if self.size and not self.rows:
            way_out = "move it, or give another folder for the meshes"
            raise FileError(f"{self.path} is not a batch's report: {way_out}")

    def add(self, row: Row) -> None:
        """Append a row to the file, in place of an unfinished line, and keep it in memory."""
        line = f"{json.dumps(row)}\n".encode()
        with naming(self.path), self.path.open("ab") as file:
            self.size = min(self.size, file.seek(0, os.SEEK_END))
            file.truncate(self.size)
            file.write(line)
        self.size += len(line)
        self._take(row)

    def _take(self, row: Any) -> None:
        """Keep what is a row in memory; pass over a line that is none."""
        with suppress(TypeError, KeyError, AttributeError):
            digests = {name: each["sha256"] for name, each in outputs_of(row).items()}
            if row.keys() >= KEYS:
                self.rows[row["out"]] = row
                for name, digest in digests.items():
                    self.made[row["out"]][name].add(digest)


def outputs_of(row: Row) -> dict[str, Fingerprint]:
    """Return the fingerprints of the files of a row by their names; none if it failed."""
    output = row["output"] or {}
    return {row["out"]: output} if "sha256" in output else output


def fingerprint(path: Path) -> Fingerprint | None:
    """Return the fingerprint of a file with those that it names, or of all in a Zarr folder.

    None if it cannot be read or is no regular file.
    """
    (file, _), digest = split_member(path), hashlib.sha256()
    try:
        if not (is_store(file) or file.is_file()):  # opening a pipe would block
            return None
        size, changed = file_state(path)  # before reading, so that a change meanwhile shows
        for part in files_of(path):
            if part != file:
                digest.update(os.fsencode(os.path.relpath(part, file)) + b"\0")
            with part.open("rb") as opened:
                while chunk := opened.read(CHUNK):
                    digest.update(chunk)
    except OSError:
        return None
    return {"sha256": digest.hexdigest(), "size": size, "mtime_ns": changed}


def file_state(path: Path) -> tuple[int, int]:
    """Return size and time of the last change, in ns; of several files the sums."""
    states = [file.stat() for file in files_of(path)]
    return sum(s.st_size for s in states), sum(s.st_mtime_ns for s in states)


def is_unchanged(path: Path, known: Fingerprint | None, *, same_path: bool = True) -> bool:
    """Return whether a file has a known fingerprint; None stands for one that cannot be read."""
    with suppress(OSError):  # the content is read only if the time or the path is another
        state = (known or {}).get("size"), (known or {}).get("mtime_ns")
        if same_path and file_state(path) == state:
            return True
    return (fingerprint(path) or {}).get("sha256") == (known or {}).get("sha256")


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Make an output folder and hold its lock within the block; FileError if a batch has it."""
    lock = FileLock(folder / LOCK_NAME, timeout=0)
    with naming(folder):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire()
        except Timeout:
            said = f"{folder} is in use by another batch: wait for it, or give another"
            raise FileError(said) from None
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
    try:
        yield
    finally:
        lock.release()
