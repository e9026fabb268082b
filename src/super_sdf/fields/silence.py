"""Keeping libraries in C++ from printing to the file descriptor of stderr."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

STDERR = 2


@contextmanager
def discarded_stderr() -> Iterator[None]:
    """Discard what is written to file descriptor 2, if there is one."""
    try:
        kept = os.dup(STDERR)
    except OSError:  # it is closed already
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, STDERR)
        yield
    finally:
        os.dup2(kept, STDERR)
        os.close(kept)
        os.close(nowhere)
