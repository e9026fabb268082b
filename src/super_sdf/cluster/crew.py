"""The checked workers of a cluster, which share tasks; and what runs in them.

Dask distributes the tasks, and gives those of a worker that died to another one, as often as its
scheduler allows (``allowed-failures``). Each task asks for the run as a resource, of which each
worker has one once it was checked: so it works at one task at a time, and a worker that comes later
is checked before it gets one. A task ends early when nobody wants its result any more, as after
Ctrl-C or when the process that asked for it was killed: otherwise it would go on writing.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import secrets
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import suppress
from itertools import islice
from typing import Any, TypeVar

from distributed import Future, KilledWorker, Worker, get_worker, wait
from distributed.core import Status

from ..errors import ClusterError, SuperSdfError
from ..batch.pool import Death, Tasks
from ..threads import Resources
from .checking import Needs, check_some, check_workers, first_of
from .connecting import Cluster

CheckWanted = Callable[[], None]
"""Raises ``UnwantedError`` if nobody wants the result of the task any more; cheap."""

ClusterWork = Callable[[Any, CheckWanted], Any]
"""Works at a task; returns the result, which is pickled."""

ClusterPrepare = Callable[[Resources], ClusterWork]
"""Called once in each worker, to load a network, say; returns what works at the tasks."""

CANCELLED = concurrent.futures.CancelledError, asyncio.CancelledError
Task = TypeVar("Task")
LOOK_SECONDS = 0.5  # between two looks at which workers there are
RESULT_SECONDS = 2.0  # that a result may take from a worker until it is looked whether that lives
PATIENCE_SECONDS = 60.0  # without any worker
AHEAD = 2  # tasks for each worker, where results are taken in order

_limits: dict[str, Resources] = {}  # of this process, if it is a worker, by run
_prepared: dict[str, ClusterWork] = {}


class UnwantedError(SuperSdfError):
    """Nobody wants the result of a task any more."""


class Crew:
    """The workers of a cluster, admitted when it is entered; ClusterError if one lacks something.

    ``prepare`` is called in each worker with what it may use, and returns the function that works
    at a task. It, the tasks and the results are pickled. ``warn`` is called with a sentence about a
    worker that may round differently, or is not used.
    """

    def __init__(
        self, cluster: Cluster, needs: Needs, prepare: ClusterPrepare, warn: Callable[[str], None]
    ) -> None:
        self.cluster, self.needs, self.prepare, self.warn = cluster, needs, prepare, warn
        self.run = f"super-sdf-{secrets.token_hex(8)}"
        self.members: dict[str, Resources] = {}
        self.refused: set[str] = set()
        self.submitted = 0
        self.given: set[Future[Any]] = set()  # whose results were not taken
        self.looked = self.seen = time.monotonic()

    def __enter__(self) -> Crew:
        checked = check_workers(self.cluster, self.needs)
        self.first = checked.values
        for warning in checked.warnings:
            self.warn(warning)
        self._admit(checked.members)
        return self

    def __exit__(self, *error: object) -> None:
        """Tell the scheduler what nobody waits for: those tasks end at their next check.

        Here, and not where results are taken: after an error such a generator lives as long as the
        traceback, and it may be Dask's own thread that collects it, which cannot wait for Dask.
        """
        with suppress(Exception):  # the connection may be lost: then the scheduler knows it, too
            self.cluster.client.cancel(list(self.given))
        self.given.clear()
        with suppress(SuperSdfError):  # the connection may be lost
            if not self.cluster.is_local:
                self.cluster.run(_forget, self.run, workers=list(self.members))

    def completed(self, tasks: Tasks[Task]) -> Generator[tuple[Task, Any], None, None]:
        """Yield the tasks of a queue with their results as they are completed.

        A task is taken from the queue when a worker is free for it. The result is a Death if the
        workers died that had the task, or if it raised an error. ClusterError if the connection is
        lost, or there is no worker any more; SuperSdfError as a worker raised it.
        """
        given: dict[Future[Any], Task] = {}
        while given or len(tasks):
            while len(tasks) and len(given) < max(len(self.members), 1):
                task = tasks.popleft()
                given[self._submit(task)] = task
            for future in self._wait(given):
                yield given.pop(future), self._result(future)

    def in_order(self, tasks: Iterable[Any]) -> Iterator[Any]:
        """Yield the results of tasks in their order, or a Death; raises what ``completed`` does.

        Workers keep the few results that are ready too early.
        """
        waiting, given = iter(tasks), deque[Any]()
        while True:
            room = max(AHEAD * len(self.members) - len(given), 1 - len(given), 0)
            given.extend(self._submit(task) for task in islice(waiting, room))
            if not given:
                return
            if self._wait([given[0]]):
                yield self._result(given.popleft())

    def _admit(self, members: dict[str, Resources]) -> None:
        for address, limits in members.items():
            self.cluster.run(_admit, self.run, limits, workers=[address])
        self.members.update(members)

    def _submit(self, task: Any) -> Future[Any]:
        self.submitted += 1
        key, submit = f"{self.run}-{self.submitted}", self.cluster.client.submit
        wanted = {self.run: 1}
        future = self.cluster.ask(
            lambda: submit(_work, self.run, self.prepare, task, key=key, resources=wanted)
        )
        self.given.add(future)
        return future

    def _wait(self, futures: Iterable[Future[Any]]) -> set[Future[Any]]:
        """Wait a moment for futures; return those that are done, and look after the workers."""
        done: set[Future[Any]] = set()
        with suppress(TimeoutError, asyncio.TimeoutError):  # the same from Python 3.11 on
            try:
                with self.cluster.client.as_current():
                    done = wait(list(futures), LOOK_SECONDS, "FIRST_COMPLETED").done
            except CANCELLED:
                raise self.cluster.lost() from None
        if time.monotonic() - self.looked > LOOK_SECONDS:
            self._look()
            self.looked = time.monotonic()
        return done

    def _result(self, future: Future[Any]) -> Any:
        """Return the result of a future that is done, or a Death."""
        self.given.discard(future)
        while True:
            try:
                return future.result(timeout=RESULT_SECONDS)
            except CANCELLED:
                raise self.cluster.lost() from None
            except KilledWorker as error:
                times = error.allowed_failures + 1
                return Death(f"was lost {times} times by the cluster (most likely out of memory)")
            except Exception as error:
                if future.status == "error":
                    if isinstance(error, SuperSdfError):
                        raise
                    return Death(f"ended with {type(error).__name__}: {error}".split("\n")[0])
                self._look()  # its worker died, and another one works at it; or the connection

    def _look(self) -> None:
        """Look which workers there are; admit new ones, and ClusterError if there are none."""
        there = self.cluster.workers()
        self.members = {a: limits for a, limits in self.members.items() if a in there}
        new = {a: n for a, n in there.items() if a not in self.members and a not in self.refused}
        if new:
            checked = check_some(self.cluster, self.needs, new, self.first)
            self._admit(checked.members)
            for address, fault in checked.faults.items():
                self.refused.add(address)
                self.warn(f"{first_of([address])} {fault}; it is not used")
        if self.members:
            self.seen = time.monotonic()
        elif time.monotonic() - self.seen > PATIENCE_SECONDS:
            raise ClusterError(
                f"the cluster {self.cluster.address} has had no worker for {PATIENCE_SECONDS:g} s: "
                "start some, and run it again"
            )


async def _admit(run: str, limits: Resources, dask_worker: Worker) -> None:
    """Let this worker take the tasks of a run, one at a time: they ask for the run as a resource.

    A pause makes the scheduler look again which of the waiting tasks this worker can take.
    """
    _limits[run] = limits
    dask_worker.status = Status.paused
    await dask_worker.set_resources(**{run: 1})
    dask_worker.status = Status.running


def _work(run: str, prepare: ClusterPrepare, task: Any) -> Any:
    """Work at a task in this worker, prepared once for each run; return its result."""
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


def _forget(run: str) -> None:
    """Free what was prepared in this worker for a run."""
    _prepared.pop(run, None)
    _limits.pop(run, None)
