"""Output files: checked before the work starts, and either complete or absent afterwards."""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import SuperSdfError, WriteError
from .parts import reserved_part

WRITABLE = stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH


def check_free(path: Path, *, force: bool = False) -> Path:
    """Return the path if a file can be created there.

    A link counts as its target; a dangling link counts as an existing file.

    Raises
    ------
    WriteError
        If the file exists and ``force`` is not set, or cannot be created.
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


def _kind_at(path: Path) -> int | None:
    """Return the mode of the file at a path, None if there is none."""
    try:
        return path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise _cannot_be_written(path, error) from error


def _check_not_protected(path: Path, mode: int | None) -> None:
    """Raise WriteError if the file at a path, of some mode, may not be written to.

    A rename would replace it all the same; and root may write to it, but it was protected.
    """
    if mode is not None and not (mode & WRITABLE and os.access(path, os.W_OK)):
        raise WriteError(f"{path} is write-protected: allow writing to it, or give another name")


def _behind_links(path: Path) -> Path:
    """Return the file that is written: the target if the path is a link."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


class _NameTakenError(Exception):
    """The target was created by another program meanwhile."""


def free_space(path: Path) -> int:
    """Return the free bytes on the disk of a file."""
    try:
        return shutil.disk_usage(_behind_links(path).parent).free
    except OSError as error:
        raise _cannot_be_written(path, error) from error


@contextmanager
def replacing(
    path: Path, *, force: bool = True, before_rename: Callable[[Path], None] | None = None
) -> Iterator[Path]:
    """Yield a temporary path beside the target, renamed to the target if the block succeeds.

    A link stays, and the file it points to is replaced and keeps its mode. Temporary files of the
    same target that killed processes left are removed.

    Parameters
    ----------
    path : Path
        The target.
    force : bool
        Replace a file that exists at the end; otherwise that is an error, and the file stays.
    before_rename : callable, optional
        Called with the path of the complete file before it is renamed.

    Raises
    ------
    WriteError
        If the file cannot be written, for whatever reason the system gives.
    """
    target = _behind_links(path) if force else path
    try:
        with reserved_part(target) as part:
            yield part
            if before_rename:
                before_rename(part)
            if force:
                _replace(part, target)
            else:
                _rename_if_free(part, target)
    except _NameTakenError:
        raise WriteError(
            f"{path} was created by another program meanwhile: remove it or use --force"
        ) from None
    except SuperSdfError:  # some are OSErrors, too, but not from the system
        raise
    except OSError as error:
        raise _cannot_be_written(path, error) from error


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Turn the system's errors in the block into a WriteError that names the path."""
    try:
        yield
    except SuperSdfError:  # some are OSErrors, too, but not from the system
        raise
    except OSError as error:
        raise _cannot_be_written(path, error) from error


def _replace(part: Path, target: Path) -> None:
    """Rename a file to a target, whose mode it takes over if that exists."""
    mode = _kind_at(target)
    _check_not_protected(target, mode)
    if mode is not None:
        part.chmod(stat.S_IMODE(mode))
    os.replace(part, target)


def _rename_if_free(part: Path, target: Path) -> None:
    """Rename a file unless the target exists: a hard link, unlike a rename, never replaces."""
    try:
        os.link(part, target)
    except FileExistsError:
        raise _NameTakenError from None
    except OSError:  # a file system without hard links: check just before the rename
        if os.path.lexists(target):
            raise _NameTakenError from None
        os.rename(part, target)


def _cannot_be_written(path: Path, error: OSError | ValueError) -> WriteError:
    """Return the error for a file that the system refuses to write."""
    return WriteError(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}")
