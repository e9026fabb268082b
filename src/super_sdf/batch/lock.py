"""An output folder belongs to one batch at a time, and remembers what was being written.

The lock is the system's, on the open file ``.super-sdf-batch``, so it ends with its process however
that ends. In the file stand the outputs that were begun: should the process be killed, the next one
knows that they are no one else's, and removes what was half written.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from ..errors import FileError, WriteError

NAME = ".super-sdf-batch"
PART = re.compile(r"\.(?P<name>.+)\.(?P<pid>\d+)\.part", re.DOTALL)


class FolderLock:
    """Hold a folder; ``begun`` are the outputs that were begun and not finished.

    Raises
    ------
    FileError
        If another batch holds it, or it cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.file: BinaryIO = (folder / NAME).open("ab", buffering=0)
        except OSError as error:
            raise WriteError(f"{folder} cannot be written: {error.strerror}") from error
        if not _take_lock(self.file):
            self.file.close()
            raise FileError(f"{folder} is in use by another batch: wait for it, or give another")
        self.begun = read_begun(folder)
        self.left = [folder / target for target in self.begun]

    def __enter__(self) -> FolderLock:
        remove_parts(self.left)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        remove_parts(self.left)  # once more: orphans of a killed process may have lived on a moment
        with suppress(OSError):
            self.file.truncate(0)
            self._note(sorted(self.begun))
        self.file.close()

    def begin(self, target: str) -> None:
        """Note that an output is about to be written."""
        self.begun.add(target)
        self._note([target])

    def finish(self, target: str) -> None:
        """Forget an output: the ledger has it."""
        self.begun.discard(target)

    def _note(self, targets: Iterable[str]) -> None:
        try:
            self.file.write("".join(json.dumps(target) + "\n" for target in targets).encode())
        except OSError as error:
            name = self.folder / NAME
            raise WriteError(f"{name} cannot be written: {error.strerror}") from error


def read_begun(folder: Path) -> set[str]:
    """Return the outputs that batches before have begun, and perhaps not finished."""
    begun = set()
    with suppress(OSError):
        for line in (folder / NAME).read_bytes().splitlines():
            with suppress(ValueError):  # a line that was being written
                begun.add(str(json.loads(line)))
    return begun


def remove_parts(targets: Iterable[Path], pid: int | None = None) -> None:
    """Remove what ended processes, or the one given, left of unfinished files.

    The names are those of ``files.output.replacing``.
    """
    names_in: dict[Path, set[str]] = {}
    for target in targets:
        names_in.setdefault(target.parent, set()).add(target.name)
    for folder, names in names_in.items():
        with suppress(OSError):
            for path in folder.iterdir():
                match = PART.fullmatch(path.name)
                if match and match["name"] in names and _is_over(int(match["pid"]), pid):
                    path.unlink(missing_ok=True)


def _is_over(found: int, ended: int | None) -> bool:
    """Say whether a process has ended: the one known to have, or any that does not live."""
    return found == ended if ended else not _lives(found)


def _lives(pid: int) -> bool:
    """Say whether another process has this number."""
    if pid == os.getpid() or os.name == "nt":  # Windows lets no open file be removed anyhow
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True  # somebody else's
    with suppress(OSError):  # ended, though nobody has asked how yet
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return True


def _take_lock(file: BinaryIO) -> bool:
    """Lock an open file if nobody else has; where the system has no such lock, do without."""
    try:
        import fcntl
    except ImportError:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True
