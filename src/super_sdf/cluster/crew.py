"""The checked workers of a cluster, which share tasks.

Dask distributes the tasks, and gives those of a worker that died to another one, as often as its
scheduler allows (``allowed-failures``). Each task asks for the run as a resource, of which each
worker has one once it was checked: so it works at one task at a time, and a worker that comes later
is checked before it gets one.
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
from typing import TYPE_CHECKING, Any, TypeVar

from ..errors import ClusterError, SuperSdfError
from ..machine.pool import Death, Tasks
from ..machine.resources import Resources
from .checking import Needs, check_some, check_workers, first_of
from .connecting import Cluster
from .serving import ClusterPrepare, admit, forget, work_here

if TYPE_CHECKING:
    from distributed import Future

CANCELLED = concurrent.futures.CancelledError, asyncio.CancelledError
Task = TypeVar("Task")
LOOK_SECONDS = 0.5  # between two looks at which workers there are
RESULT_SECONDS = 2.0  # that a result may take from a worker until it is looked whether that lives
PATIENCE_SECONDS = 60.0  # without any worker
AHEAD = 2  # tasks for each worker, where results are taken in order


class Crew:
    """The workers of a cluster, admitted when it is entered; ClusterError if one lacks something.

    ``prepare`` is called in each worker with what it may use, and returns the function that works
    at a task. It, the tasks and the results are pickled. ``warn`` is called with a sentence about a
    worker that may round differently, or is not used.
    """

    def __init__(
        self,
        cluster: Cluster,
        needs: Needs,
        prepare: ClusterPrepare,
        warn: Callable[[str], None],
    ) -> None:
        self.cluster, self.needs, self.prepare, self.warn = cluster, needs, prepare, warn
        self.run = f"super-sdf-{secrets.token_hex(8)}"
        self.members: dict[str, Resources] = {}
        self.refused: set[str] = set()
        self.submitted = 0
        self.looked = self.seen = time.monotonic()

    def __enter__(self) -> Crew:
        checked = check_workers(self.cluster, self.needs)
        self.first = checked.values
        for warning in checked.warnings:
            self.warn(warning)
        self._admit(checked.members)
        return self

    def __exit__(self, *error: object) -> None:
        with suppress(SuperSdfError):  # the connection may be lost
            if not self.cluster.is_local:
                self.cluster.run(forget, self.run, workers=list(self.members))

    def _admit(self, members: dict[str, Resources]) -> None:
        for address, limits in members.items():
            self.cluster.run(admit, self.run, limits, workers=[address])
        self.members.update(members)

    def completed(self, tasks: Tasks[Task]) -> Generator[tuple[Task, Any], None, None]:
        """Yield the tasks of a queue with their results as they are completed.

        A task is taken from the queue when a worker is free for it. The result is a Death if the
        workers died that had the task, or if it raised an error. ClusterError if the connection is
        lost, or there is no worker any more; SuperSdfError as a worker raised it.
        """
        given: dict[Future[Any], Task] = {}
        try:
            while given or len(tasks):
                while len(tasks) and len(given) < max(len(self.members), 1):
                    task = tasks.popleft()
                    given[self._submit(task)] = task
                for future in self._wait(given):
                    yield given.pop(future), self._result(future)
        finally:
            self._cancel(given)

    def in_order(self, tasks: Iterable[Any]) -> Iterator[Any]:
        """Yield the results of tasks in their order, or a Death; raises what ``completed`` does.

        Workers keep the few results that are ready too early.
        """
        waiting, given = iter(tasks), deque[Any]()
        try:
            while True:
                room = max(AHEAD * len(self.members) - len(given), 1 - len(given), 0)
                given.extend(self._submit(task) for task in islice(waiting, room))
                if not given:
                    return
                if self._wait(list(given)[:1]):
                    yield self._result(given.popleft())
        finally:
            self._cancel(given)

    def _submit(self, task: Any) -> Future[Any]:
        self.submitted += 1
        key, submit = f"{self.run}-{self.submitted}", self.cluster.client.submit
        wanted = {self.run: 1}
        return self.cluster.ask(
            lambda: submit(work_here, self.run, self.prepare, task, key=key, resources=wanted)
        )

    def _wait(self, futures: Iterable[Future[Any]]) -> set[Future[Any]]:
        """Wait a moment for futures; return those that are done, and look after the workers."""
        from distributed import wait

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
        from distributed import KilledWorker

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

    def _cancel(self, futures: Iterable[Future[Any]]) -> None:
        """Tell the scheduler that nobody waits for futures: their tasks end at their next check."""
        with suppress(Exception):  # the connection may be lost: then the scheduler knows it, too
            self.cluster.client.cancel(list(futures))
