"""What a batch remembers: ``report.jsonl`` in its output folder, and fingerprints of files.

The report has a JSON line for every file that was converted, or failed; the last line of an output
counts. Lines are appended. A line that a killed process left unfinished is passed over, and cut off
before the next one is written.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from ..errors import FileError, WriteError
from ..files.formats import split_member
from ..files.regular import files_of, is_store

NAME, LOCK_NAME, STAGE_NAME = "report.jsonl", ".super-sdf-batch.lock", ".super-sdf-parts"
OWN_NAMES = (NAME, LOCK_NAME, STAGE_NAME, ".super-sdf-batch")
CHUNK = 1 << 20  # bytes read at a time
NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP}  # some network drives

Fingerprint = dict[str, Any]
"""``sha256``, ``size`` in bytes and ``mtime_ns`` of a file, as written in JSON."""

Row = dict[str, Any]
"""A line of the report; docs/reference/json.md says what its keys mean."""


class RecordFile:
    """A file of JSON lines, which need not exist; it is written by one process at a time."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> Iterator[Any]:
        """Yield what each finished line holds; None for a line that is not valid JSON."""
        with suppress(FileNotFoundError), self.path.open("rb") as file:
            for line in file:
                if line.endswith(b"\n"):
                    try:
                        yield json.loads(line)
                    except (ValueError, RecursionError):
                        yield None

    def append(self, record: Any) -> None:
        """Append a record as a line, after cutting off an unfinished one.

        After an OSError, of a full disk, say, the file holds the lines that it held before.
        """
        left = memoryview(f"{json.dumps(record)}\n".encode())
        with self.path.open("a+b", buffering=0) as file:
            end = file.seek(0, os.SEEK_END)
            while end and (file.seek(end - 1), file.read(1))[1] != b"\n":
                end -= 1
            file.truncate(end)
            try:
                while left:  # a full disk may take a part of it
                    left = left[file.write(left) :]
            except OSError:
                file.truncate(end)
                raise


class Record:
    """The rows of an output folder; FileError if its ``report.jsonl`` is something else.

    ``rows`` are the last ones by output. ``made`` are all contents that a batch wrote: SHA-256 by
    output and name of the file.
    """

    def __init__(self, folder: Path) -> None:
        self.file = RecordFile(folder / NAME)
        self.rows: dict[str, Row] = {}
        self.made: dict[str, dict[str, set[str]]] = {}
        path = self.file.path
        if os.path.exists(path) and not path.is_file():  # opening a pipe would block
            raise FileError(f"{path} is no regular file: remove it")
        try:
            read = list(self.file.read())
        except OSError as error:
            raise FileError(f"{path} cannot be read: {error.strerror}") from error
        for row in read:
            if _is_row(row):
                self._take(row)
        if read and not self.rows:
            raise FileError(
                f"{path} is not a batch's report: move it, or give another folder for the meshes"
            )

    def add(self, row: Row) -> None:
        """Keep a row, in memory and in the file."""
        try:
            self.file.append(row)
        except OSError as error:
            raise WriteError(f"{self.file.path} cannot be written: {error.strerror}") from error
        self._take(row)

    def _take(self, row: Row) -> None:
        self.rows[row["out"]] = row
        made = self.made.setdefault(row["out"], {})
        for name, known in outputs_of(row).items():
            made.setdefault(name, set()).add(known["sha256"])


def outputs_of(row: Row) -> dict[str, Fingerprint]:
    """Return the fingerprints of the files of a row by their names; none if it failed."""
    output = row["output"] or {}
    return {row["out"]: output} if "sha256" in output else output


def _is_row(row: Any) -> bool:
    """Return whether a parsed line is a row, with what is looked up in one."""
    try:
        texts = all(isinstance(row[key], str) for key in ("in", "out", "status", "options"))
        known = [*outputs_of(row).values(), row["content"] or {"sha256": ""}]
        return texts and isinstance(row["retry"], bool) and all("sha256" in each for each in known)
    except (TypeError, KeyError, AttributeError):
        return False


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
        size, changed = file_state(path)  # before reading, so that a change meanwhile shows
        for part in files_of(path):
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


def file_state(path: Path) -> tuple[int, int]:
    """Return size and time of the last change, in ns; of several files the sums."""
    states = [file.stat() for file in files_of(path)]
    return sum(s.st_size for s in states), sum(s.st_mtime_ns for s in states)


def is_unchanged(path: Path, known: Fingerprint | None, *, same_path: bool = True) -> bool:
    """Return whether a file still has a known fingerprint; None stands for an unreadable file.

    Its content is read only if the modification time or the path is another.
    """
    if known is None:
        file, _ = split_member(path)
        return not ((os.path.isfile(file) or is_store(file)) and os.access(file, os.R_OK))
    with suppress(OSError):
        if same_path and file_state(path) == (known.get("size"), known.get("mtime_ns")):
            return True
    return bool((fingerprint(path) or {}).get("sha256") == known["sha256"])


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Make an output folder and hold its lock within the block; FileError if a batch has it."""
    lock = FileLock(folder / LOCK_NAME, timeout=0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout:
        said = f"{folder} is in use by another batch: wait for it, or give another"
        raise FileError(said) from None
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise WriteError(f"{folder} cannot be written: {error.strerror}") from error
    try:
        yield
    finally:
        lock.release()
