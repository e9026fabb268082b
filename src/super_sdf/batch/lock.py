"""The lock on an output folder: one batch at a time may use it.

It is the operating system's lock on an open file, so it ends with its process, however that ends.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from ..errors import FileError, WriteError

LOCK_NAME = ".super-sdf-batch.lock"
# What the system answers where the file system has no locks, as some of networks: a batch runs
# without one there.
NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP}


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Make an output folder and hold its lock within the block; FileError if a batch has it."""
    path = folder / LOCK_NAME
    lock = FileLock(path, timeout=0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.path.exists(path) and not path.is_file():  # opening a pipe would block
            raise FileError(f"{path} is no regular file: remove it")
        lock.acquire()
    except Timeout:
        raise FileError(
            f"{folder} is in use by another batch: wait for it, or give another"
        ) from None
    except FileError:
        raise
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise WriteError(f"{folder} cannot be written: {error.strerror}") from error
    try:
        yield
    finally:
        lock.release()
