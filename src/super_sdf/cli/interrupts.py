"""Signals that ask a command to end: it does, in a line, with nothing half-written left behind.

Until a command begins to write it ends at once: an exception in the midst of an import would come
out as something else. From then on the signal is an exception, which removes what was begun.
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
    """A signal has asked this process to end."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


def exit_code(error: KeyboardInterrupt) -> int:
    """Return the exit code of a process that a signal ended: 128 and the signal's number."""
    return 128 + _number(error)


def describe_interrupt(error: KeyboardInterrupt) -> str:
    """Say what ended the command."""
    return _describe(_number(error))


def _number(error: KeyboardInterrupt) -> int:
    return error.number if isinstance(error, Interrupted) else int(signal.SIGINT)


def _describe(number: int) -> str:
    name = signal.Signals(number).name
    return "interrupted" if name == "SIGINT" else f"ended by {name}"


@contextmanager
def ending_at_once() -> Iterator[None]:
    """Let signals end the process within the block, as long as it writes nothing."""
    with _handling(_end):
        yield


@contextmanager
def raising_interrupts() -> Iterator[None]:
    """Let signals raise ``Interrupted`` within the block, for it has files to remove."""
    with _handling(_raise):
        yield


@contextmanager
def _handling(handler: Handler) -> Iterator[None]:
    """Install a handler for the signals that are not ignored (``nohup`` ignores SIGHUP)."""
    if threading.current_thread() is not threading.main_thread():  # only that can, and gets them
        yield
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}
    heard = [number for number in SIGNALS if before[number] not in (signal.SIG_IGN, None)]
    try:
        for number in heard:
            signal.signal(number, handler)
        yield
    finally:
        for number in heard:
            signal.signal(number, before[number])


def _raise(number: int, frame: FrameType | None) -> None:
    raise Interrupted(number)


def _end(number: int, frame: FrameType | None) -> None:
    line = f"Error: {_describe(number)}\n"
    with suppress(OSError):
        os.write(2, line.encode("ascii"))
    os._exit(128 + number)
