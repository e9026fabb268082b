"""Output files: checked before the work starts, and either complete or absent afterwards.

Process 123 writes ``.part.ply.123.part`` beside ``part.ply`` and holds a lock on it meanwhile. A
file without a lock was left by a process that was killed, and goes with the next run.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import SuperSdfError, WriteError

try:
    import fcntl
except ImportError:  # Windows, where files that are open cannot be removed
    fcntl = None  # type: ignore[assignment]

WRITABLE = stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH
LONGEST = 96  # bytes of a name; file systems allow 255, some 143, and that of a part is longer


def check_free(path: Path, *, force: bool = False) -> Path:
    """Return the path if a file can be created there; raise WriteError if not.

    Without ``force`` no file may exist. A link counts as its target; a dangling link counts as an
    existing file.
    """
    mode = _mode_of(path)
    if mode is not None and stat.S_ISDIR(mode):
        raise WriteError(f"{path} is a folder: give a file")
    if os.path.lexists(path) and not force:
        raise WriteError(f"{path} exists: remove it or use --force")
    if mode is not None and not stat.S_ISREG(mode):
        raise WriteError(f"{path} is not a regular file: give another name")
    folder = Path(os.path.realpath(path) if path.is_symlink() else path).parent
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


def _mode_of(path: Path) -> int | None:
    """Return the mode of a file, None if there is none; WriteError if it is write-protected."""
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise _cannot_be_written(path, error) from error
    if stat.S_ISREG(mode) and not (mode & WRITABLE and os.access(path, os.W_OK)):
        raise WriteError(f"{path} is write-protected: allow writing to it, or give another name")
    return mode


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


@contextmanager
def replacing(path: Path, *, force: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside the target, renamed to the target if the block succeeds.

    A link stays, and the file it points to is replaced and keeps its mode. Temporary files of the
    same target that killed processes left are removed. Without ``force`` a file that exists at the
    end stays, which is an error.
    """
    target = Path(os.path.realpath(path)) if force and path.is_symlink() else path
    # the last bytes of a long name; a report may hold names that no file can have
    name = target.name.encode("utf-8", "surrogatepass")[-LONGEST:].decode("utf-8", "ignore")
    part = target.with_name(f".{name}.{os.getpid()}.part")
    with naming(path):
        _remove_abandoned(part)
        try:
            file = os.open(part, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
        except FileExistsError:
            raise WriteError(f"{target} is being written already: wait for it") from None
        with os.fdopen(file, "wb") as locked:
            if fcntl is None or not _lock(file):
                locked.close()  # Windows does not rename files that are open
            try:
                yield part
                _rename(part, target, force=force)
            finally:
                part.unlink(missing_ok=True)


def _rename(part: Path, target: Path, *, force: bool) -> None:
    """Rename a file; without ``force`` only if the target does not exist."""
    if force:
        mode = _mode_of(target)
        if mode is not None:
            part.chmod(stat.S_IMODE(mode))
        os.replace(part, target)
        return
    try:
        os.link(part, target)  # unlike a rename, never replaces a file
    except OSError as error:  # it exists, or the file system has no hard links
        if isinstance(error, FileExistsError) or os.path.lexists(target):
            said = "was created by another program meanwhile: remove it or use --force"
            raise WriteError(f"{target} {said}") from None
        os.rename(part, target)


def _remove_abandoned(part: Path) -> None:
    """Remove the files like a part, by other processes, that no process holds a lock on."""
    start = part.name.removesuffix(f"{os.getpid()}.part")
    is_one = re.compile(re.escape(start) + r"\d+\.part").fullmatch
    with suppress(OSError):
        for name in filter(is_one, os.listdir(part.parent)):
            with suppress(OSError):  # another user's, or gone
                with (part.parent / name).open("rb+") as file:
                    is_free = fcntl is None or _lock(file.fileno())
                if is_free:
                    (part.parent / name).unlink()


def _lock(file: int) -> bool:
    """Lock an open file until it is closed, and return whether that worked."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # it is locked, or the file system has no locks
        return False
    return True
