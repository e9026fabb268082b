"""The entry point: what must be right before anything large is imported.

That is signals, a processor that NumPy can run on, and the standard streams: closed, full or broken
ones must not cost the user the mesh.
"""

from __future__ import annotations

import gc
import os
import sys
from contextlib import suppress

from .interrupts import ending_at_once

# Writing to a descriptor that is open for reading fails, as writing to a closed one does.
MODES = (os.O_RDONLY, os.O_RDONLY, os.O_WRONLY)
RARELY = 50_000  # objects between collections: imports leave no garbage, and looking takes 15 ms


def main() -> None:
    """Run the command line and end the process.

    All is written by then. Python would first take apart what it has loaded, for 30 ms.
    """
    gc.set_threshold(RARELY)
    with ending_at_once():
        open_missing_streams()
        from .main import run

        try:
            code = run()
        finally:
            discard_unwritable_output()
    os._exit(code)


def open_missing_streams() -> None:
    """Open null devices in place of standard streams that were closed before the start.

    Otherwise the next file that is opened would get the stream's number, and its output. Text for
    a missing stderr is lost; text for a missing stdout is an error.
    """
    for number, mode in enumerate(MODES):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, mode)  # takes the lowest free number, which is this one
    if sys.stdout is None:
        sys.stdout = os.fdopen(1, "w", closefd=False)
    if sys.stderr is None:
        sys.stderr = os.fdopen(2, "w", closefd=False, errors="backslashreplace")


def discard_unwritable_output() -> None:
    """Drop buffered output that cannot be written: Python would complain about it at exit."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            with suppress(OSError, ValueError):
                null = os.open(os.devnull, os.O_WRONLY)
                os.dup2(null, stream.fileno())
                os.close(null)
                stream.flush()
