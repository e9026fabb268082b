"""Output files: checked before the work starts, and either complete or absent afterwards.

Process 123 writes ``.part.ply.123.part`` beside ``part.ply`` and holds a lock on it meanwhile. A
file without a lock was abandoned; where there are no locks, one whose process has ended.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from numpy.typing import NDArray

from ..errors import SuperSdfError, WriteError

WRITABLE = stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH
# File systems allow names of 255 bytes (some 143); the name of a spool file is 9 bytes longer.
LONGEST = 96
PART = re.compile(r"(?P<stem>\..+\.)(?P<pid>\d+)\.part(\.\w+)?", re.DOTALL)
SPOOL_BYTES = 4_000_000  # kept in memory before a file is made


def check_free(path: Path, *, force: bool = False) -> Path:
    """Return the path if a file can be created there; raise WriteError if not.

    Without ``force`` no file may exist. A link counts as its target; a dangling link counts as an
    existing file.
    """
    kind = _kind_at(path)
    if kind is not None and stat.S_ISDIR(kind):
        raise WriteError(f"{path} is a folder: give a file")
    if os.path.lexists(path) and not force:
        raise WriteError(f"{path} exists: remove it or use --force")
    if kind is not None and not stat.S_ISREG(kind):
        raise WriteError(f"{path} is not a regular file: give another name")
    _check_not_protected(path, kind)
    folder = _behind_links(path).parent
    if not folder.is_dir():
        raise WriteError(f"{folder} is not a folder: make it first")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise WriteError(f"{path} cannot be written: no permission in {folder}")
    return path


def check_apart(path: str | Path, others: Iterable[str | Path]) -> None:
    """Raise WriteError if writing a file would replace another one, by whatever name or link."""
    for other in others if os.path.exists(path) else ():
        if os.path.exists(other) and os.path.samefile(path, other):
            raise WriteError(f"{path} is the same file as {other}: give another file")


def free_space(path: Path) -> int:
    """Return the free bytes on the disk of a file."""
    with naming(path):
        return shutil.disk_usage(_behind_links(path).parent).free


def _kind_at(path: Path) -> int | None:
    try:
        return path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise _cannot_be_written(path, error) from error


def _check_not_protected(path: Path, mode: int | None) -> None:
    if mode is not None and not (mode & WRITABLE and os.access(path, os.W_OK)):
        raise WriteError(f"{path} is write-protected: allow writing to it, or give another name")


def _behind_links(path: Path) -> Path:
    return Path(os.path.realpath(path)) if path.is_symlink() else path


@contextmanager
def replacing(
    path: Path, *, force: bool = True, before_rename: Callable[[Path], None] | None = None
) -> Iterator[Path]:
    """Yield a temporary path beside the target, renamed to the target if the block succeeds.

    A link stays, and the file it points to is replaced and keeps its mode. Temporary files of the
    same target that killed processes left are removed. Without ``force`` a file that exists at the
    end stays, which is an error. ``before_rename`` is called with the path of the complete file.
    """
    target = _behind_links(path) if force else path
    with naming(path), _reserved_part(target) as part:
        yield part
        if before_rename:
            before_rename(part)
        if not force:
            _rename_if_free(part, target)
            return
        mode = _kind_at(target)
        _check_not_protected(target, mode)
        if mode is not None:
            part.chmod(stat.S_IMODE(mode))
        os.replace(part, target)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Turn the system's errors in the block into a WriteError that names the path."""
    try:
        yield
    except SuperSdfError:  # some are OSErrors, too, but not from the system
        raise
    except OSError as error:
        raise _cannot_be_written(path, error) from error


def _cannot_be_written(path: Path, error: OSError | ValueError) -> WriteError:
    return WriteError(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}")


def _rename_if_free(part: Path, target: Path) -> None:
    """Rename a file unless the target exists: a hard link, unlike a rename, never replaces."""
    taken = WriteError(
        f"{target} was created by another program meanwhile: remove it or use --force"
    )
    try:
        os.link(part, target)
    except FileExistsError:
        raise taken from None
    except OSError:  # a file system without hard links: check just before the rename
        if os.path.lexists(target):
            raise taken from None
        os.rename(part, target)


# Temporary files


def part_path(target: Path) -> Path:
    """Return the path of the unfinished target that this process writes."""
    return target.with_name(f"{_stem(target.name)}{os.getpid()}.part")


def _stem(name: str) -> str:
    """Return the prefix of the names of a target's parts; long names are hashed."""
    raw = name.encode("utf-8", "surrogatepass")  # a report may hold names that no file can have
    if len(raw) <= LONGEST:
        return f".{name}."
    from hashlib import sha256  # loads OpenSSL, and long names are rare

    return f".{sha256(raw).hexdigest()[:32]}."


@contextmanager
def _reserved_part(target: Path) -> Iterator[Path]:
    remove_abandoned_parts([target])
    part = part_path(target)
    try:
        file = os.open(part, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
    except FileExistsError:
        raise WriteError(f"{target} is being written already: wait for it") from None
    has_lock = take_lock(file) is not None
    if not has_lock:
        os.close(file)
    try:
        yield part
    finally:
        part.unlink(missing_ok=True)
        if has_lock:
            os.close(file)


def remove_abandoned_parts(targets: Iterable[Path], pid: int | None = None) -> None:
    """Remove unfinished parts of the targets that ended processes, or process ``pid``, left.

    A ``*`` in the name of a target stands for anything.
    """
    stems_in: dict[Path, set[str]] = {}
    for target in targets:
        stems_in.setdefault(target.parent, set()).add(_stem(target.name))
    for folder, stems in stems_in.items():
        pattern = "|".join(re.escape(stem).replace(r"\*", ".*") for stem in stems)
        is_one = re.compile(pattern, re.DOTALL).fullmatch
        with suppress(OSError):
            for name in os.listdir(folder):
                match = PART.fullmatch(name)
                if match and is_one(match["stem"]):
                    owner = int(match["pid"])
                    if owner == pid or _is_abandoned(folder / name, owner):
                        (folder / name).unlink(missing_ok=True)


def _is_abandoned(path: Path, pid: int) -> bool:
    """Return whether no process holds a part's lock; without locks, whether its process ended."""
    try:
        file = os.open(path, os.O_RDWR)
    except OSError:  # another user's, or gone
        return False
    try:
        taken = take_lock(file)
    finally:
        os.close(file)
    return taken if taken is not None else not _is_running(pid)


def take_lock(file: int) -> bool | None:
    """Lock an open file until it is closed.

    Return whether that worked, or None if the system or file system has no locks.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return None
    return True


def _is_running(pid: int) -> bool:
    if os.name == "nt":  # where open files cannot be removed
        return False
    try:
        os.kill(pid, 0)
    except OSError as error:
        return not isinstance(error, ProcessLookupError)  # it may be another user's
    with suppress(OSError):  # a zombie has ended
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return True


@contextmanager
def spool_beside(part: Path) -> Iterator[IO[bytes]]:
    """Open a temporary file without a name beside a file that is being written.

    Where the system has no such files, ``remove_abandoned_parts`` recognises its name.
    """
    folder, name = str(part.parent), f"{part.name}."
    with tempfile.SpooledTemporaryFile(SPOOL_BYTES, dir=folder, prefix=name) as spool:
        yield spool


def append_spool(waiting: IO[bytes], file: IO[bytes]) -> None:
    """Copy the temporary file ``waiting`` to the end of ``file``."""
    waiting.seek(0)
    shutil.copyfileobj(waiting, file, SPOOL_BYTES)


def little_endian(array: NDArray[Any]) -> bytes:
    """Return the bytes of an array in little-endian order."""
    return array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
