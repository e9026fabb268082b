"""A worker process from within: it prepares once, and answers tasks until its parent ends."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

from ..errors import SuperSdfError

Prepare = Callable[[], Callable[[Any], Any]]
"""Makes a worker's function out of nothing: it loads a network, say."""


class Ready(NamedTuple):
    """A process can take tasks."""


class Refusal(NamedTuple):
    """A process cannot prepare, and no other could."""

    error: SuperSdfError


def serve(pipe: Connection, prepare: Prepare) -> None:
    """Answer the tasks that come by the pipe, until nobody is at its other end."""
    settle_signals()
    threading.Thread(target=end_with_parent, daemon=True).start()
    with suppress(EOFError, OSError):
        try:
            answer = prepare()
        except SuperSdfError as error:
            pipe.send(Refusal(error))
            return
        except Exception as error:  # of a bug, too, the parent is to say a line
            pipe.send(Refusal(SuperSdfError(f"{type(error).__name__}: {error}".split("\n")[0])))
            return
        pipe.send(Ready())
        while True:
            pipe.send(answer(pipe.recv()))


def settle_signals() -> None:
    """Leave Ctrl-C to the parent, and let what it had blocked at the start end this process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _ending_signals())


def end_with_parent() -> None:
    """End this process when its parent does, however that does: an orphan would write on."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


@contextmanager
def ending_signals_blocked() -> Iterator[None]:
    """Put off SIGINT, SIGTERM and SIGHUP, for this thread and for processes that it starts."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # it would lift the block when a process first needs it
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _ending_signals())
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _ending_signals() -> set[signal.Signals]:
    return {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
