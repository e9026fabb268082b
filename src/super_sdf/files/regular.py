"""Only regular files are read as inputs.

To open a named pipe waits for ever, to read a device never ends, and a folder is no input.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from ..errors import FileError

KINDS = {
    stat.S_IFDIR: "folder",
    stat.S_IFIFO: "named pipe",
    stat.S_IFSOCK: "socket",
    stat.S_IFCHR: "device",
    stat.S_IFBLK: "device",
}
REASONS = {
    errno.ENOENT: "does not exist",
    errno.ENOTDIR: "does not exist: what stands before its last / is no folder",
    errno.ELOOP: "cannot be read: its links lead in a circle",
    errno.ENAMETOOLONG: "does not exist: the name is longer than the system allows",
    errno.EACCES: "cannot be read: permission denied",
}


def check_regular_file(path: str | Path) -> Path:
    """Return the path if it is a regular file, or a link to one, that may be read.

    Nothing is opened, so this does not wait.

    Raises
    ------
    FileError
        If it does not exist, may not be read, or is a folder, a pipe, a socket or a device.
    """
    try:
        state = os.stat(path)
    except OSError as error:
        raise FileError(f"{path} {reason_of(error)}") from None
    except ValueError:  # a NUL, or a character that the system's encoding lacks
        raise FileError(f"{str(path)!r} is no name that a file can have") from None
    if not stat.S_ISREG(state.st_mode):
        kind = KINDS.get(stat.S_IFMT(state.st_mode), "special file")
        raise FileError(f"{path} is a {kind}: give a file")
    if not os.access(path, os.R_OK):
        raise FileError(f"{path} {REASONS[errno.EACCES]}")
    if not state.st_size:  # or the system makes it up as it is read, without end
        raise FileError(f"{path} is empty")
    return Path(path)


def reason_of(error: OSError) -> str:
    """Return what the system has against a file, to be read after the file's name."""
    said = REASONS.get(error.errno or 0)
    return said or f"cannot be read: {error.strerror or error}"
