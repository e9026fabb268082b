"""The worker's side of the pool: prepare once, then work at tasks until the parent ends."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import util
from multiprocessing.connection import Connection, wait
from multiprocessing.spawn import get_executable
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import SuperSdfError

# ``python -c``, which multiprocessing starts, imports from the current folder unless told not to.
# Python 3.10 knows only -I: what that leaves out, multiprocessing hands over with the path.
SAFE_PATH = "-P" if sys.version_info >= (3, 11) else "-I"
Tell = Callable[[Any], None]
"""Sends a partial result of the current task to the parent, or ``ClockStarted``."""

Work = Callable[[Any, Tell], Any]
"""Works at a task; what it returns is the task's final result."""

Prepare = Callable[[], Work]
"""Called once in each worker, to load a network, say; returns what works at the tasks."""


class ClockStarted(NamedTuple):
    """What a worker tells when a task's time limit begins to count."""


class Ready(NamedTuple):
    """Message: the worker can take a task."""


class PrepareFailed(NamedTuple):
    """Message: the worker could not prepare itself, and no other worker could."""

    error: SuperSdfError


class Partial(NamedTuple):
    """Message: a partial result of the current task; more will follow."""

    value: Any


class Final(NamedTuple):
    """Message: the final result of the current task. The worker can take the next one."""

    value: Any


def serve(pipe: Connection, prepare: Prepare) -> None:
    """Run a worker process: take tasks from the pipe and send their results, until it closes."""
    settle_signals()
    threading.Thread(target=end_with_parent, daemon=True).start()
    with suppress(EOFError, ConnectionError):  # the parent has ended, or needs no more workers
        try:
            work = prepare()
        except SuperSdfError as error:
            pipe.send(PrepareFailed(error))
            return
        except Exception as error:  # even a bug is reported by the parent in one line
            line = f"{type(error).__name__}: {error}".split("\n")[0]
            pipe.send(PrepareFailed(SuperSdfError(line)))
            return
        pipe.send(Ready())
        while True:
            task = pipe.recv()
            pipe.send(Final(work(task, lambda value: pipe.send(Partial(value)))))


def settle_signals() -> None:
    """Ignore Ctrl-C, which the parent handles, and unblock what it had blocked at the start."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ending_signals())


def end_with_parent() -> None:
    """End this process when its parent ends, even by a kill: an orphan would go on writing."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


@contextmanager
def ending_signals_blocked() -> Iterator[None]:
    """Block SIGINT, SIGTERM and SIGHUP in this thread and in processes that it starts.

    Windows cannot block signals; nothing happens there.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # otherwise it lifts the block when it is first needed
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ending_signals())
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def python_flags(*flags: str) -> Iterator[None]:
    """Start Pythons within the block with ``SAFE_PATH`` and other flags, from whatever thread."""
    usual = util._args_from_interpreter_flags  # type: ignore[attr-defined]
    util._args_from_interpreter_flags = lambda: [*usual(), SAFE_PATH, *flags]  # type: ignore[attr-defined]
    try:
        yield
    finally:
        util._args_from_interpreter_flags = usual  # type: ignore[attr-defined]


def isolated_python(code: str) -> list[str]:
    """Return the command of a Python that runs ``code`` and finds modules where this one does.

    It takes nothing from the current folder.
    """
    own, here = str(Path(__file__).resolve().parents[2]), os.getcwd()
    folders = [own, *(path for path in sys.path if path and os.path.abspath(path) != here)]
    start = f"import sys; sys.path[:0] = sys.argv[1:]; {code}"
    return [get_executable(), "-I", "-c", start, *folders]


def ending_signals() -> set[signal.Signals]:
    """Return the signals of this system that ask a process to end; Windows has no SIGHUP."""
    names = ("SIGINT", "SIGTERM", "SIGHUP")
    return {getattr(signal, name) for name in names if hasattr(signal, name)}
