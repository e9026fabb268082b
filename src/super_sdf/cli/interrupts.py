"""Signals that end a command: it prints one line and leaves no half-written file.

Until a command begins to write, a signal ends the process at once: an exception raised during an
import may come out as another error. From then on the signal raises an exception, so that files
that were begun are removed.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
Handler = Callable[[int, FrameType | None], None]


class Interrupted(KeyboardInterrupt):
    """A signal that asks this process to end was received."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


def exit_code(error: KeyboardInterrupt) -> int:
    """Return the exit code of a process that a signal ended: 128 plus the signal's number."""
    return 128 + _number(error)


def describe_interrupt(error: KeyboardInterrupt) -> str:
    """Describe what ended the command."""
    return _describe(_number(error))


def _number(error: KeyboardInterrupt) -> int:
    return error.number if isinstance(error, Interrupted) else int(signal.SIGINT)


def _describe(number: int) -> str:
    name = signal.Signals(number).name
    return "interrupted" if name == "SIGINT" else f"ended by {name}"


@contextmanager
def ending_at_once() -> Iterator[None]:
    """End the process on a signal within the block, which must not write files."""
    with _handling(_end):
        yield


@contextmanager
def raising_interrupts() -> Iterator[None]:
    """Raise ``Interrupted`` on a signal within the block, so that it can remove its files."""
    with _handling(_raise):
        yield


@contextmanager
def _handling(handler: Handler) -> Iterator[None]:
    """Install a handler for the signals that are not ignored (``nohup`` ignores SIGHUP)."""
    if threading.current_thread() is not threading.main_thread():  # only it may install handlers
        yield
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}
    handled = [number for number in SIGNALS if before[number] not in (signal.SIG_IGN, None)]
    try:
        for number in handled:
            signal.signal(number, handler)
        yield
    finally:
        for number in handled:
            signal.signal(number, before[number])


def _raise(number: int, frame: FrameType | None) -> None:
    raise Interrupted(number)


def _end(number: int, frame: FrameType | None) -> None:
    line = f"Error: {_describe(number)}\n"
    with suppress(OSError):
        os.write(2, line.encode("ascii"))
    os._exit(128 + number)
