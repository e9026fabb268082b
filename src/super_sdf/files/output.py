"""Output files: asked for before the work starts, and there whole or not at all."""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import SuperSdfError, WriteError
from .parts import reserved_part


def check_free(path: Path, *, force: bool = False) -> Path:
    """Return the path if a file can be made there.

    A link counts as what it leads to, and as a file where it leads to none.
    """
    kind = _kind_at(path)
    if kind is not None and stat.S_ISDIR(kind):
        raise WriteError(f"{path} is a folder: give a file")
    if os.path.lexists(path) and not force:
        raise WriteError(f"{path} exists: remove it or use --force")
    if kind is not None and not stat.S_ISREG(kind):
        raise WriteError(f"{path} is no regular file: give another name")
    folder = _behind_links(path).parent
    if not folder.is_dir():
        raise WriteError(f"{folder} is no folder: make it first")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise WriteError(f"{path} cannot be written: no permission in {folder}")
    return path


def _kind_at(path: Path) -> int | None:
    """Return the mode of what is there, None if nothing is."""
    try:
        return path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as error:  # the last: a NUL in the name
        raise _cannot_be_written(path, error) from error


def _behind_links(path: Path) -> Path:
    """Return the file to be made: where the last link leads, if the path is one."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


class _NameTakenError(Exception):
    """The target has appeared since it was asked for."""


def free_space(path: Path) -> int:
    """Return the bytes that are free where a file is to be."""
    try:
        return shutil.disk_usage(_behind_links(path).parent).free
    except OSError as error:
        raise _cannot_be_written(path, error) from error


@contextmanager
def replacing(
    path: Path, *, force: bool = True, before_rename: Callable[[Path], None] | None = None
) -> Iterator[Path]:
    """Yield a path beside the target; it takes the target's place only if all goes well.

    The place of a link is kept: the file that it leads to is replaced. What killed processes left
    of the same target is removed. Whatever the system has against it is raised as WriteError.

    Parameters
    ----------
    path : Path
        The target.
    force : bool
        Replace a file that is there in the end; else that is an error, and the file stays.
    before_rename : callable, optional
        Called with the path of the finished file, before it takes the target's name.
    """
    target = _behind_links(path) if force else path
    try:
        with reserved_part(target) as part:
            yield part
            if before_rename:
                before_rename(part)
            (os.replace if force else _rename_if_free)(part, target)
    except _NameTakenError:
        raise WriteError(
            f"{path} was made by somebody else meanwhile: remove it or use --force"
        ) from None
    except SuperSdfError:  # also an OSError, perhaps, but not the system's
        raise
    except OSError as error:
        raise _cannot_be_written(path, error) from error


def _rename_if_free(part: Path, target: Path) -> None:
    """Give a file its name unless that is taken: a second name, unlike a rename, never replaces."""
    try:
        os.link(part, target)
    except FileExistsError:
        raise _NameTakenError from None
    except OSError:  # a file system without links: the last look is as near as can be
        if os.path.lexists(target):
            raise _NameTakenError from None
        os.rename(part, target)


def _cannot_be_written(path: Path, error: OSError | ValueError) -> WriteError:
    """Return the error for what the system has against a file."""
    return WriteError(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}")
