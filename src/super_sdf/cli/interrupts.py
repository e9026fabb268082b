"""Signals that end a command: it prints one line and leaves no half-written file.

Until a command begins to write, a signal ends the process at once. From then on the signal raises
an exception, so that files that were begun are removed. It waits for the end of an import: native
libraries make another error of an exception there, or abort, and others swallow it.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
Handler = Callable[[int, FrameType | None], None]
IMPORTING = "<frozen importlib._bootstrap>"  # the file of the frames that import


class Interrupted(KeyboardInterrupt):
    """A signal that asks this process to end was received."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


def exit_code(error: KeyboardInterrupt) -> int:
    """Return the exit code of a process that a signal ended: 128 plus the signal's number."""
    return 128 + (error.number if isinstance(error, Interrupted) else signal.SIGINT)


def describe_interrupt(code: int) -> str:
    """Describe what ended a process with an exit code."""
    name = signal.Signals(code - 128).name
    return "interrupted" if name == "SIGINT" else f"ended by {name}"


def wants_json() -> bool:
    """Return whether the command line asks for JSON; also before it is parsed."""
    return "--json" in sys.argv[1:]


@contextmanager
def ending_at_once() -> Iterator[None]:
    """End the process on a signal within the block, which must not write files."""

    def end(number: int, frame: FrameType | None) -> None:
        line = describe_interrupt(128 + number)
        with suppress(OSError):
            if wants_json():
                os.write(1, f'{{"error": "{line}"}}\n'.encode("ascii"))
        with suppress(OSError):
            os.write(2, f"Error: {line}\n".encode("ascii"))
        os._exit(128 + number)

    with _handling(end):
        yield


@contextmanager
def raising_interrupts() -> Iterator[None]:
    """Raise ``Interrupted`` on a signal within the block, so that it can remove its files.

    At the end it is raised again if code in the block swallowed it or made another error of it.
    """
    received: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        received.append(number)
        _raise(number, frame)

    try:
        with _handling(handle):
            yield
    except Exception:  # after a signal it is what some code made of the interrupt
        if not received:
            raise
    if received:
        raise Interrupted(received[0])


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
    """Raise ``Interrupted``: now, or in the next line of the code that waits for an import."""

    def raise_there(*_: Any) -> None:
        sys.settrace(None)
        raise Interrupted(number)

    importer = None  # the frame that waits for the outermost import in progress
    while frame is not None:
        if frame.f_code.co_filename == IMPORTING:
            importer = frame.f_back
        frame = frame.f_back
    if importer is None:
        raise Interrupted(number)
    importer.f_trace = raise_there
    sys.settrace(lambda *_: None)  # only with one are the functions of frames called
