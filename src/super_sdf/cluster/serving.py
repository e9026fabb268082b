"""The workers' side of the pool: prepare once, then work at one task at a time.

A task ends early when nobody wants its result any more, as after Ctrl-C or when the process that
asked for it was killed: otherwise it would go on writing.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, NamedTuple

from distributed import Worker, get_worker

from ..errors import SuperSdfError
from ..machine.serving import PrepareFailed, Ready
from .connecting import Limits

CheckWanted = Callable[[], None]
"""Raises ``UnwantedError`` if nobody wants the result of the task any more; cheap."""

ClusterWork = Callable[[Any, CheckWanted], Any]
"""Works at a task; what it returns is the result, which is pickled."""

ClusterPrepare = Callable[[Limits], ClusterWork]
"""Called once in each worker, to load a network, say; returns what works at the tasks."""

MOST_PREPARED = 2  # runs whose networks a worker keeps
_turn = threading.Lock()  # a worker of several threads gives all of them to one task
_prepared: OrderedDict[str, ClusterWork] = OrderedDict()
_at_work: set[str] = set()


class UnwantedError(SuperSdfError):
    """Nobody wants the result of a task any more."""


class Elsewhere(NamedTuple):
    """Result: this process is not the one that was checked and given the task."""


class Call(NamedTuple):
    """What a worker needs for a task: Dask's name of its process, the run, how to prepare."""

    identity: str
    run: str
    prepare: ClusterPrepare
    limits: Limits


def prepare_here(call: Call) -> Ready | PrepareFailed | Elsewhere:
    """Prepare this worker."""
    if get_worker().id != call.identity:
        return Elsewhere()
    try:
        with _turn:
            work_of(call)
    except SuperSdfError as error:
        return PrepareFailed(error)
    except Exception as error:  # even a bug is reported in one line
        line = f"{type(error).__name__}: {error}".split("\n")[0]
        return PrepareFailed(SuperSdfError(line))
    return Ready()


def work_here(call: Call, task: Any) -> Any:
    """Work at a task; return its result."""
    worker = get_worker()
    if worker.id != call.identity:
        return Elsewhere()
    check = wanted_check(worker)
    key = str(worker.get_current_task())
    _at_work.add(key)
    try:
        with _turn:
            check()
            return work_of(call)(task, check)
    finally:
        _at_work.discard(key)


def work_of(call: Call) -> ClusterWork:
    """Return what works at the tasks of a run, prepared at most once."""
    if call.run not in _prepared:
        while len(_prepared) >= MOST_PREPARED:
            _prepared.popitem(last=False)
        _prepared[call.run] = call.prepare(call.limits)
    return _prepared[call.run]


def wanted_check(worker: Worker) -> CheckWanted:
    """Return what raises when Dask has cancelled the task of this thread; any thread may call."""
    key = worker.get_current_task()

    def check() -> None:
        state = worker.state.tasks.get(key)
        if state is None or state.state == "cancelled":
            raise UnwantedError("nobody waits for the result any more")

    return check


def keys_at_work() -> set[str]:
    """Return the keys of the tasks that this worker is working at."""
    return set(_at_work)


def forget(run: str) -> None:
    """Free what was prepared for a run."""
    _prepared.pop(run, None)
