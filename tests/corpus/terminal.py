"""Standard output and error as files, for compiled code and child processes too."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


class Terminal:
    """Files in place of standard output and error, for compiled code and children too.

    One for the life of the process: what it starts may keep them.
    """

    def __init__(self) -> None:
        # Appending, so that others who hold them go on at the end after they were emptied.
        self.folder = tempfile.TemporaryDirectory(prefix="corpus-terminal-")
        paths = [Path(self.folder.name, name) for name in ("out", "err")]
        self.files = [path.open("a+b", buffering=0) for path in paths]

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Let standard output and error go to the files."""
        before, streams = [os.dup(1), os.dup(2)], (sys.stdout, sys.stderr)
        for number, file in enumerate(self.files, 1):
            file.truncate(0)
            os.dup2(file.fileno(), number)
        errors = ("strict", "backslashreplace")
        sys.stdout, sys.stderr = (
            open(number, "w", encoding="utf-8", errors=error, closefd=False)  # noqa: SIM115
            for number, error in enumerate(errors, 1)
        )
        try:
            yield
        finally:
            with suppress(OSError, ValueError):
                sys.stdout.flush()
                sys.stderr.flush()
            sys.stdout, sys.stderr = streams
            for number, kept in enumerate(before, 1):
                os.dup2(kept, number)
                os.close(kept)

    def read(self) -> tuple[str, str]:
        """Return what was written to each."""
        texts = []
        for file in self.files:
            file.seek(0)
            texts.append(file.read().decode("utf-8", "replace"))
        return texts[0], texts[1]
