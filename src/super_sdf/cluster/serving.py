"""What runs in Dask's workers: at one task at a time, prepared once for each run.

A task ends early when nobody wants its result any more, as after Ctrl-C or when the process that
asked for it was killed: otherwise it would go on writing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from distributed import Scheduler, Worker, get_worker
from distributed.core import Status

from ..errors import SuperSdfError
from ..machine.resources import Resources

CheckWanted = Callable[[], None]
"""Raises ``UnwantedError`` if nobody wants the result of the task any more; cheap."""

ClusterWork = Callable[[Any, CheckWanted], Any]
"""Works at a task; what it returns is the result, which is pickled."""

ClusterPrepare = Callable[[Resources], ClusterWork]
"""Called once in each worker, to load a network, say; returns what works at the tasks."""

_limits: dict[str, Resources] = {}  # of this process, by run
_prepared: dict[str, ClusterWork] = {}


class UnwantedError(SuperSdfError):
    """Nobody wants the result of a task any more."""


class QuietScheduler(Scheduler):
    """A scheduler without a dashboard; Dask's answers at port 8787 even without any page."""

    def start_http_server(self, *_: Any, **__: Any) -> None:
        """Open no port."""


class QuietWorker(Worker):
    """A worker without a dashboard."""

    def start_http_server(self, *_: Any, **__: Any) -> None:
        """Open no port."""


async def admit(run: str, limits: Resources, dask_worker: Worker) -> None:
    """Let this worker take the tasks of a run, one at a time: they ask for the run as a resource.

    A pause makes the scheduler look again which of the waiting tasks this worker can take.
    """
    _limits[run] = limits
    dask_worker.status = Status.paused
    await dask_worker.set_resources(**{run: 1})
    dask_worker.status = Status.running


def work_here(run: str, prepare: ClusterPrepare, task: Any) -> Any:
    """Work at a task; return its result."""
    worker = get_worker()
    key = worker.get_current_task()

    def check_wanted() -> None:
        state = worker.state.tasks.get(key)
        if state is None or state.state == "cancelled":
            raise UnwantedError("nobody waits for the result any more")

    check_wanted()
    if run not in _prepared:
        _prepared[run] = prepare(_limits[run])
    return _prepared[run](task, check_wanted)


def forget(run: str) -> None:
    """Free what was prepared for a run."""
    _prepared.pop(run, None)
    _limits.pop(run, None)
