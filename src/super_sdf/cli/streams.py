"""Standard streams that are closed, full or gone: no reason to lose a mesh, or to print into it."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import TextIO

# To write to what is open for reading fails as it does where the stream is closed.
MODES = (os.O_RDONLY, os.O_RDONLY, os.O_WRONLY)


def open_missing_streams() -> None:
    """Open what was closed before the start: the next file would take its number, and its output.

    What is written to stderr is lost then; to stdout it is an error.
    """
    for number, mode in enumerate(MODES):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, mode)  # takes the lowest number that is free: this one
    if sys.stdout is None:
        sys.stdout = os.fdopen(1, "w", closefd=False)
    if sys.stderr is None:
        sys.stderr = os.fdopen(2, "w", closefd=False, errors="backslashreplace")


def settle_streams() -> None:
    """Drop what cannot be written in the end: Python would complain of it on its way out."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            _drop(stream)


def _drop(stream: TextIO) -> None:
    """Lead a stream to nowhere, with what it holds."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
        stream.flush()
