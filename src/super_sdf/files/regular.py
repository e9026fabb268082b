"""Only regular files are read as inputs.

Opening a named pipe may wait forever, reading a device may never end, and a folder is no input.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path, PurePath

from ..errors import FileError, seen

KINDS = {
    stat.S_IFDIR: "folder",
    stat.S_IFIFO: "named pipe",
    stat.S_IFSOCK: "socket",
    stat.S_IFCHR: "device",
    stat.S_IFBLK: "device",
}
REASONS = {
    errno.ENOENT: "does not exist",
    errno.ENOTDIR: "does not exist: the path before its last / is not a folder",
    errno.ELOOP: "cannot be read: its links lead in a circle",
    errno.ENAMETOOLONG: "does not exist: the name is longer than the system allows",
    errno.EACCES: "cannot be read: permission denied",
}


def check_regular_file(path: str | Path) -> Path:
    """Return the path if it is a readable regular file, or a link to one.

    The file is not opened, so this never blocks.

    Raises
    ------
    FileError
        If it does not exist, may not be read, is empty, or is a folder, a pipe, a socket or a
        device.
    """
    try:
        found = os.stat(path)
    except OSError as error:
        raise FileError(f"{path} {reason_of(error)}") from None
    except ValueError:  # a NUL, or a character that the file system's encoding lacks
        raise FileError(f"{str(path)!r} is not a valid file name") from None
    if not stat.S_ISREG(found.st_mode):
        kind = KINDS.get(stat.S_IFMT(found.st_mode), "special file")
        raise FileError(f"{path} is a {kind}: give a file")
    if not os.access(path, os.R_OK):
        raise FileError(f"{path} {REASONS[errno.EACCES]}")
    if not found.st_size:  # such as files in /proc, which the system makes up as they are read
        raise FileError(f"{path} is empty: give a file with something in it")
    return Path(path)


def check_beside(path: Path, name: str) -> Path:
    """Return the file that another one, or a folder, names as part of it: in the folder, or below.

    A file that is a link may have its parts beside the file that it leads to.

    Raises
    ------
    FileError
        If it is anywhere else, or as in ``check_regular_file``.
    """
    homes = (path,) if path.is_dir() else (path.parent, path.resolve().parent)
    other = homes[0] / name
    if not PurePath(name).is_absolute() and ".." not in PurePath(name).parts:
        check_regular_file(other)
        if any(other.resolve().is_relative_to(home.resolve()) for home in homes):
            return other
    raise FileError(
        f"{path} names the file {seen(name)}, which is not in its folder: put both into one folder"
    )


def reason_of(error: OSError) -> str:
    """Return why the system refuses to read a file, as the words after its name."""
    reason = REASONS.get(error.errno or 0)
    return reason or f"cannot be read: {error.strerror or error}"
