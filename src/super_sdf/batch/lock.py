"""An output folder belongs to one batch at a time, which removes what killed ones left half done.

The lock is the system's, on the open file of the journal, so it ends with its process however that
ends.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from ..errors import FileError, WriteError
from ..files.parts import remove_abandoned_parts, take_lock
from .journal import NAME, note_begun, read_journal


class FolderLock:
    """Hold a folder; ``begun`` are the outputs that were begun and not finished.

    Raises
    ------
    FileError
        If another batch holds it, or it cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        path = folder / NAME
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if os.path.exists(path) and not path.is_file():  # to open a pipe would wait for ever
                raise FileError(f"{path} is no regular file: remove it")
            self.file: BinaryIO = path.open("ab", buffering=0)
        except FileError:
            raise
        except OSError as error:
            raise WriteError(f"{folder} cannot be written: {error.strerror}") from error
        if take_lock(self.file.fileno()) is False:  # None: there are no locks here
            self.file.close()
            raise FileError(f"{folder} is in use by another batch: wait for it, or give another")
        self.begun = read_journal(folder).begun
        self.left = [folder / target for target in self.begun]

    def __enter__(self) -> FolderLock:
        remove_abandoned_parts(self.left)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        remove_abandoned_parts(
            self.left
        )  # once more: orphans of a killed process may have lived on a moment
        if not self.begun:
            with suppress(OSError):
                self.file.truncate(0)
        self.file.close()

    def begin(self, target: str) -> None:
        """Note that an output is about to be written."""
        self.begun.add(target)
        note_begun(self.folder, target)

    def finish(self, target: str) -> None:
        """Forget an output: the ledger has it."""
        self.begun.discard(target)
