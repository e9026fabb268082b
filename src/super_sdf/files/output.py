"""Output files: checked before the work starts, and either complete or absent afterwards.

Thread 4 of process 123 writes ``.part.ply.123.4.part`` beside ``part.ply``.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import get_native_id

from ..errors import SuperSdfError, WriteError

LONGEST = 50  # characters of a name that the name of its part has: file systems allow 255 bytes


def check_free(path: Path, *, force: bool = False) -> Path:
    """Return the path if a file can be created there, or with ``force`` replaced; else WriteError.

    A link counts as its target, a dangling link as an existing file.
    """
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        mode = 0
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise _cannot_be_written(path, error) from error
    if stat.S_ISDIR(mode):
        raise WriteError(f"{path} is a folder: give a file")
    if mode and not stat.S_ISREG(mode):
        raise WriteError(f"{path} is not a regular file: give another name")
    if mode and not (mode & 0o222 and os.access(path, os.W_OK)):  # root may write to all files
        raise WriteError(f"{path} is write-protected: allow writing to it, or give another name")
    if os.path.lexists(path) and not force:
        raise WriteError(f"{path} exists: remove it or use --force")
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

    A link stays, and the file it points to is replaced and keeps its mode. Without ``force`` a file
    that exists at the end stays, which is an error.
    """
    target = Path(os.path.realpath(path)) if path.is_symlink() else path
    part = target.with_name(f".{target.name[-LONGEST:]}.{os.getpid()}.{get_native_id()}.part")
    with naming(path):
        try:
            yield part
            check_free(path, force=force)
            if target.exists():
                part.chmod(stat.S_IMODE(target.stat().st_mode))
            os.replace(part, target)
        finally:
            part.unlink(missing_ok=True)
