"""What a batch remembers: fingerprints of files, and the ledger of its output folder; its lock.

The ledger, ``report.jsonl``, has a JSON line for every file that was converted, or failed. Lines
are appended, and the last one of an output counts. A killed process leaves at most the line that it
was writing unfinished, which is cut off before the next one is written. Damage by a power cut shows
in the sizes and hashes in the lines.

A file of the same form beside it has the names of the outputs that are started, and is empty when
nothing is unfinished: so the next batch knows what a killed one left, and which mesh may be its own
although it has no row.
"""

from __future__ import annotations

import errno
import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePath
from typing import Any

from filelock import FileLock, Timeout

from ..errors import FileError, WriteError
from ..files.formats import split_member
from ..files.output import remove_abandoned_parts
from ..files.regular import files_of, is_store
from .records import RecordFile, parse_line

NAME, STARTED_NAME, LOCK_NAME = "report.jsonl", ".super-sdf-batch", ".super-sdf-batch.lock"
Fingerprint = dict[str, Any]
"""``sha256``, ``size`` in bytes and ``mtime_ns`` of a file, as written in JSON."""

Row = dict[str, Any]
"""A line of the ledger.

in, out : absolute path of the input; path of the output, relative to the output folder
status, reason : "ok" and None, or "failed" and why
retry : whether another run may succeed with the same input and options
content, output : fingerprints of the input and of the mesh; of files of labels by their names
version, network : of this package, and the SHA-256 of the network's file
model, precision, asked : what was asked for, and the options of the conversion
options : digest of all that the mesh depends on, besides the input
simplified : with ``--simplify`` or ``--triangles``, triangles before and after, and distances
check : with ``--check`` the certificate, or why there is none
seconds : time in all; that of each stage is in ``stages``
"""
TYPES: dict[str, tuple[type, ...]] = {
    "in": (str,),
    "out": (str,),
    "status": (str,),
    "reason": (str, type(None)),
    "retry": (bool,),
    "options": (str,),
}
ROW_START = b'{"in": "'  # of every line
CHUNK = 1 << 20  # bytes read at a time
# What the system answers where the file system has no locks, as some of networks: a batch runs
# without one there.
NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP}


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
    with suppress(OSError):
        size, changed = file_state(path)
        if size == known["size"]:
            is_same = same_path and changed == known["mtime_ns"]
            return bool(is_same or (fingerprint(path) or {}).get("sha256") == known["sha256"])
    return False


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Make an output folder and hold its lock within the block; FileError if a batch has it.

    It is the operating system's lock on an open file, so it ends with its process in any case.
    """
    path = folder / LOCK_NAME
    lock = FileLock(path, timeout=0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _check_is_regular(path)
        lock.acquire()
    except Timeout:
        raise FileError(
            f"{folder} is in use by another batch: wait for it, or give another"
        ) from None
    except OSError as error:
        if isinstance(error, FileError):
            raise
        if error.errno not in NO_LOCKS:
            raise WriteError(f"{folder} cannot be written: {error.strerror}") from error
    try:
        yield
    finally:
        lock.release()


class Ledger:
    """The rows of an output folder; FileError if something else has the name of its files.

    ``rows`` are the last finished ones by output, ``written`` the fingerprints of all files that
    a batch wrote for one, as it wrote them last. This batch has ``started`` some outputs and not
    finished them. A killed one ``left`` others: a part of a mesh, or a mesh without a row, may be
    there.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.rows: dict[str, Row] = {}
        self.written: dict[str, dict[str, Fingerprint]] = {}
        self.started, self.left = set[str](), set[str]()
        self.file, self.journal = RecordFile(folder / NAME), RecordFile(folder / STARTED_NAME)
        if os.path.exists(self.file.path):
            self._read()
        self._read_left()

    def start(self, target: str) -> None:
        """Note that an output is about to be written."""
        _append(self.journal, target)
        self.started.add(target)

    def add(self, row: Row) -> None:
        """Keep a row, in memory and in the file."""
        _append(self.file, row)
        self._take(row)

    def others(self, row: Row) -> list[str]:
        """Return the files of earlier rows of an output that a new row does not have."""
        names = self.written.get(row["out"], {}).keys() - outputs_of(row).keys()
        return sorted(name for name in names if os.path.lexists(self.folder / name))

    def remove_parts(self) -> None:
        """Remove the unfinished parts of outputs whose processes have ended."""
        remove_abandoned_parts(self.folder / target for target in self.started | self.left)

    def close(self) -> None:
        """Remove parts again, and forget what was started if nothing of it is unfinished."""
        self.remove_parts()
        self.left = {target for target in self.left if self._has_no_row(target)}
        if not (self.started or self.left):
            with suppress(OSError):
                os.truncate(self.journal.path, 0)

    def _has_no_row(self, target: str) -> bool:
        """Return whether a file of an output is there and is not as its row says."""
        return any(
            os.path.lexists(path := self.folder / name)
            and not (known and is_unchanged(path, known))
            for name, known in self.written.get(target, {target: None}).items()
        )

    def _read_left(self) -> None:
        _check_is_regular(self.journal.path)
        with suppress(OSError):
            for name in self.journal.read():
                # unfinished files are removed nowhere else
                if isinstance(name, str) and _is_below(name):
                    self.left.add(name)

    def _read(self) -> None:
        path, is_report = self.file.path, False
        try:
            if path.is_file():  # opening a pipe would block
                for row in filter(is_row, self.file.read()):
                    is_report = True
                    self._take(row)
                if not self.file.whole_bytes:  # it may be the beginning of the first row
                    start = self.file.unfinished
                    is_report = start.startswith(ROW_START) or ROW_START.startswith(start)
                    is_report &= parse_line(start) is None
        except OSError as error:
            raise FileError(f"{path} cannot be read: {error.strerror}") from error
        if not is_report:
            raise FileError(
                f"{path} is not a batch's report: move it, or give another folder for the meshes"
            )

    def _take(self, row: Row) -> None:
        target = row["out"]
        self.rows[target] = row
        if made := outputs_of(row):
            self.written.setdefault(target, {}).update(made)
        if row["status"] == "ok" or not os.path.lexists(self.folder / target):
            self.started.discard(target)  # otherwise its process may have died after writing it


def outputs_of(row: Row) -> dict[str, Fingerprint]:
    """Return the fingerprints of the files of a row by their names; none if it failed."""
    output = row["output"]
    return {row["out"]: output} if _is_fingerprint(output) else output or {}


def asked_of(row: Row) -> dict[str, Any]:
    """Return the options of a row, none if it does not state them."""
    asked = row.get("asked")
    return asked if isinstance(asked, dict) else {}


def is_row(record: Any) -> bool:
    """Return whether a parsed line is a row, with all the keys that are looked up in one."""
    if not isinstance(record, dict):
        return False
    if not all(type(record.get(key, record)) in types for key, types in TYPES.items()):
        return False
    content, output = (record.get(key, record) for key in ("content", "output"))
    if content is not None and not _is_fingerprint(content):
        return False
    if record["status"] == "ok":
        return _are_outputs(output) and type(record.get("closed")) is bool
    return record["status"] == "failed" and output is None


def _is_fingerprint(value: Any) -> bool:
    types = {"sha256": str, "size": int, "mtime_ns": int}
    return isinstance(value, dict) and all(type(value.get(k)) is t for k, t in types.items())


def _are_outputs(value: Any) -> bool:
    """Return whether a value is the fingerprint of a file, or of several by their names."""
    if _is_fingerprint(value) or not isinstance(value, dict):
        return _is_fingerprint(value)
    return bool(value) and all(_is_below(k) and _is_fingerprint(value[k]) for k in value)


def _is_below(name: str) -> bool:
    """Return whether a name is of a path below the output folder."""
    return not PurePath(name).is_absolute() and ".." not in PurePath(name).parts


def _check_is_regular(path: Path) -> None:
    if os.path.exists(path) and not path.is_file():  # opening a pipe would block
        raise FileError(f"{path} is no regular file: remove it")


def _append(file: RecordFile, record: Any) -> None:
    try:
        file.append(record)
    except OSError as error:
        raise WriteError(f"{file.path} cannot be written: {error.strerror}") from error
