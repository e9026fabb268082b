"""The lock on an output folder: one batch at a time may use it.

It is the operating system's lock on an open file, so it ends with its process, however that ends.
The file is not the journal: on Windows no other process can read what is locked.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path
from types import TracebackType

from filelock import FileLock, Timeout

from ..errors import FileError, WriteError
from ..files.output import remove_abandoned_parts
from .journal import LOCK_NAME, NAME, clear_journal, note_started, read_journal

# What the system answers where the file system has no locks, as some of networks: a batch runs
# without one there.
NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP}


class FolderLock:
    """Hold an output folder; remove what killed batches left unfinished there.

    Attributes
    ----------
    started : set of str
        The outputs that were started and not finished, by this batch or by those before.

    Raises
    ------
    FileError
        If another batch holds the folder, or it cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for path in (folder / NAME, folder / LOCK_NAME):
                if os.path.exists(path) and not path.is_file():  # opening a pipe would block
                    raise FileError(f"{path} is no regular file: remove it")
            (folder / NAME).touch()
            self.lock = take_lock(folder / LOCK_NAME)
        except Timeout:
            raise FileError(
                f"{folder} is in use by another batch: wait for it, or give another"
            ) from None
        except FileError:
            raise
        except OSError as error:
            raise WriteError(f"{folder} cannot be written: {error.strerror}") from error
        self.started = read_journal(folder).started
        self.left_by_others = [folder / target for target in self.started]

    def __enter__(self) -> FolderLock:
        remove_abandoned_parts(self.left_by_others)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # Again: the workers of a killed batch may have gone on for a moment.
        remove_abandoned_parts(self.left_by_others)
        if not self.started:
            clear_journal(self.folder)
        if self.lock is not None:
            self.lock.release()

    def start(self, target: str) -> None:
        """Note that an output is about to be written."""
        self.started.add(target)
        note_started(self.folder, target)

    def finish(self, target: str) -> None:
        """Forget an output: the ledger has it."""
        self.started.discard(target)


def take_lock(path: Path) -> FileLock | None:
    """Return the lock on a file, held; None where the file system has no locks.

    Raises
    ------
    Timeout
        If another process holds it.
    OSError
        If the file cannot be opened.
    """
    lock = FileLock(path, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        return None
    return lock
