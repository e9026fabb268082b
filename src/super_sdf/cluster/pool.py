"""Giving tasks to the workers of a cluster; any of them may die without harm to the others.

Each task is given to one worker, which was checked, and never moved to another by Dask: so the
tasks of a worker that dies are known, and whether they are tried again is the caller's decision, as
with ``machine.pool``.

While a worker works at a short task it gets the next one, so that it need not wait for the answer
of the scheduler. A task that was in a worker that died is alone there the next time: then it is
certain whose fault a second death is.
"""

from __future__ import annotations

import asyncio
import os
import secrets
import signal
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from ..errors import ClusterError, SuperSdfError
from ..machine.pool import MAX_FAILED_STARTS, Death, Tasks
from ..machine.serving import PrepareFailed, Ready
from .checking import Checked, Member, Needs, check_some, first_of
from .connecting import Cluster
from .serving import Call, ClusterPrepare, Elsewhere, forget, keys_at_work, prepare_here, work_here

if TYPE_CHECKING:
    from distributed import Future

Task = TypeVar("Task")
LOOK_SECONDS = 0.5  # between two looks at which workers there are
RESULT_SECONDS = 2.0  # that a result may take from a worker until it is looked whether that lives
STOP_SECONDS = 5.0  # that workers have to stop what nobody wants any more
PATIENCE_SECONDS = 60.0  # without any worker
SHORT_TASK = 1.0  # seconds: after one, a worker gets the next task before it has finished
KILL = getattr(signal, "SIGKILL", signal.SIGTERM)  # Windows has none, and its SIGTERM kills
LOST = "was lost by the cluster (most likely out of memory)"


@dataclass(eq=False)
class Worker(Generic[Task]):
    """A worker with what it was given: futures and tasks, the one that it works at first.

    Attributes
    ----------
    member : Member
        The worker.
    is_ready : bool
        Whether it is prepared.
    given : dict
        By key of the future, the future and its task; the task is None while it prepares.
    since : float
        When it began with the first of them.
    pace : float
        Seconds of its last task; infinity before.
    """

    member: Member
    is_ready: bool = False
    given: dict[Any, tuple[Future[Any], Task | None]] = field(default_factory=dict)
    since: float = 0.0
    pace: float = float("inf")

    def call(self, run: str, prepare: ClusterPrepare) -> Call:
        """Return what its process needs for a task."""
        return Call(self.member.report.identity, run, prepare, self.member.limits)


@dataclass(frozen=True)
class ClusterPoolOptions(Generic[Task]):
    """How a pool treats its tasks.

    Attributes
    ----------
    clean_up : callable
        Called with a task that was not finished and its worker's process ID, to remove what the
        worker left behind.
    is_suspect : callable
        Returns whether a worker died while it had a task, which therefore is to be alone.
    looks_ahead : bool
        Whether a worker may get a short task before it has finished the one before.
    warn : callable
        Called with a sentence about a worker that came later and is not used.
    choose : callable
        Takes the queue and the address of a worker; returns the task that this worker gets.
    """

    clean_up: Callable[[Task, int], None] = lambda task, pid: None
    is_suspect: Callable[[Task], bool] = lambda task: False
    looks_ahead: bool = True
    warn: Callable[[str], None] = lambda text: None
    choose: Callable[[Tasks[Task], str], Task] = lambda tasks, address: tasks.popleft()


class ClusterPool(Generic[Task]):
    """The workers of a cluster, which share a queue of tasks.

    Parameters
    ----------
    cluster : Cluster
        The connection.
    checked : Checked
        Its workers, from ``check_workers``.
    needs : Needs
        What workers that come later are checked for.
    tasks : Tasks
        The queue. A task is taken from it when it is given to a worker.
    prepare : callable
        Called in each worker with what it may use; returns the function that works at a task. It,
        the tasks and the results are pickled.
    options : ClusterPoolOptions
        How the tasks are treated.
    """

    def __init__(
        self,
        cluster: Cluster,
        checked: Checked,
        needs: Needs,
        tasks: Tasks[Task],
        prepare: ClusterPrepare,
        options: ClusterPoolOptions[Task] | None = None,
    ) -> None:
        self.cluster, self.checked, self.needs = cluster, checked, needs
        self.tasks, self.prepare = tasks, prepare
        self.options: ClusterPoolOptions[Task] = options or ClusterPoolOptions()
        self.run = secrets.token_hex(8)
        self.workers: dict[str, Worker[Task]] = {}
        self.refused: set[str] = set()
        self.aside: Task | None = None  # waits for a worker that has nothing else
        self.finished: SimpleQueue[Future[Any]] = SimpleQueue()
        self.count = self.failed_starts = 0
        self.looked = self.seen = time.monotonic()

    def results(self) -> Generator[tuple[Task, Any], None, None]:
        """Run the tasks.

        Yields
        ------
        task, result
            The result of each task as it arrives, or a Death.

        Raises
        ------
        ClusterError
            If the connection is lost, or if there is no worker any more.
        SuperSdfError
            What ``prepare`` raised.
        """
        try:
            for member in self.checked.members:
                self._admit(member)
            while self._assign():
                yield from self._receive()
        finally:
            self._stop()

    def _admit(self, member: Member) -> None:
        """Let a worker prepare itself."""
        worker = self.workers[member.address] = Worker[Task](member)
        self._submit(worker, None)

    def _assign(self) -> bool:
        """Give tasks to the workers; return whether there is anything to wait for."""
        ready = [worker for worker in self.workers.values() if worker.is_ready]
        for worker in ready:
            if not worker.given and (task := self._next(worker)) is not None:
                self._submit(worker, task)
        for worker in ready:
            if self.aside is None and len(self.tasks) and self._may_look_ahead(worker):
                task = self.options.choose(self.tasks, worker.member.address)
                if self.options.is_suspect(task):
                    self.aside = task
                else:
                    self._submit(worker, task)
        is_busy = any(
            task is not None
            for worker in self.workers.values()
            for _, task in worker.given.values()
        )
        return is_busy or self.aside is not None or len(self.tasks) > 0

    def _next(self, worker: Worker[Task]) -> Task | None:
        """Return the next task for a worker, None if there is none."""
        if self.aside is not None:
            task, self.aside = self.aside, None
            return task
        if not len(self.tasks):
            return None
        return self.options.choose(self.tasks, worker.member.address)

    def _may_look_ahead(self, worker: Worker[Task]) -> bool:
        """Return whether a worker may get the next task beside the one that it works at."""
        if not self.options.looks_ahead or len(worker.given) != 1 or worker.pace > SHORT_TASK:
            return False
        (_, task), *_ = worker.given.values()
        return task is not None and not self.options.is_suspect(task)

    def _submit(self, worker: Worker[Task], task: Task | None) -> None:
        """Give a worker a task, or None to prepare itself."""
        self.count += 1
        call = worker.call(self.run, self.prepare)
        function, arguments = (prepare_here, [call]) if task is None else (work_here, [call, task])
        submit, address = self.cluster.client.submit, worker.member.address
        future = self.cluster.ask(
            lambda: submit(
                function,
                *arguments,
                key=f"super-sdf-{self.run}-{self.count}",
                workers=[address],
                allow_other_workers=False,
                pure=False,
            )
        )
        if not worker.given:
            worker.since = time.monotonic()
        worker.given[future.key] = future, task
        future.add_done_callback(self.finished.put)

    def _receive(self) -> Iterator[tuple[Task, Any]]:
        """Wait a moment for a future; yield what it brings, and look which workers there are."""
        with suppress(Empty):
            yield from self._take(self.finished.get(timeout=LOOK_SECONDS))
        if time.monotonic() - self.looked > LOOK_SECONDS:
            yield from self._look()
            self.looked = time.monotonic()

    def _take(self, future: Future[Any]) -> Iterator[tuple[Task, Any]]:
        """Yield the result of a future that is done, or a Death."""
        worker = next(
            (worker for worker in self.workers.values() if future.key in worker.given), None
        )
        if worker is None:  # its worker was reported dead before
            return
        value = self._value(future, worker)
        if isinstance(value, Elsewhere):
            yield from self._report_death(worker)
            return
        _, task = worker.given.pop(future.key)
        now = time.monotonic()
        worker.pace, worker.since = now - worker.since, now
        if isinstance(value, PrepareFailed):
            raise value.error
        if isinstance(value, Ready):
            worker.is_ready, self.failed_starts = True, 0
        elif task is not None:
            yield task, value

    def _value(self, future: Future[Any], worker: Worker[Task]) -> Any:
        """Return the result of a future that is done; Elsewhere if it was lost with its worker."""
        from distributed import KilledWorker

        is_there = True
        while is_there:
            try:
                return future.result(timeout=RESULT_SECONDS)
            except (TimeoutError, asyncio.TimeoutError):  # the same from Python 3.11 on
                is_there = worker.member.address in self.cluster.workers()
            except Exception as error:
                if future.status != "error" or isinstance(error, KilledWorker):
                    self.cluster.workers()  # raises if that is because the connection was lost
                    break
                # The task's own error, or what cannot be pickled.
                line = f"{type(error).__name__}: {error}".split("\n")[0]
                if worker.is_ready:
                    return Death(f"ended with {line}")
                return PrepareFailed(SuperSdfError(line))
        return Elsewhere()

    def _look(self) -> Iterator[tuple[Task, Any]]:
        """Look which workers there are; yield the tasks of those that died, and admit new ones."""
        there = self.cluster.workers()
        for worker in [worker for address, worker in self.workers.items() if address not in there]:
            yield from self._report_death(worker)
        new = {a: n for a, n in there.items() if a not in self.workers and a not in self.refused}
        if new and (len(self.tasks) or self.aside is not None):
            checked = check_some(self.cluster, self.needs, new, self.checked.members)
            for member in checked.members:
                self._admit(member)
            for address, fault in checked.faults.items():
                self.refused.add(address)
                self.options.warn(f"{first_of([address])} {fault}; it is not used")
        self._check_patience()

    def _check_patience(self) -> None:
        """Raise ClusterError if there has been no worker for a while."""
        if self.workers:
            self.seen = time.monotonic()
        elif time.monotonic() - self.seen > PATIENCE_SECONDS:
            raise ClusterError(
                f"the cluster {self.cluster.address} has had no worker for {PATIENCE_SECONDS:g} s: "
                "start some, and run it again"
            )

    def _report_death(self, worker: Worker[Task]) -> Iterator[tuple[Task, Death]]:
        """Remove a dead worker; yield the tasks that it had."""
        del self.workers[worker.member.address]
        self._cancel(worker)
        if not worker.is_ready:
            self.failed_starts += 1
            if self.failed_starts == MAX_FAILED_STARTS:
                raise ClusterError(
                    f"{MAX_FAILED_STARTS} workers in a row ended before they were ready, the last "
                    f"one {worker.member.address}: see its log"
                )
        for _, task in worker.given.values():
            if task is not None:
                self.options.clean_up(task, worker.member.report.pid)
                yield task, Death(LOST)

    def _cancel(self, worker: Worker[Task]) -> None:
        """Tell the scheduler that nobody waits for what a worker was given."""
        with suppress(Exception):  # the connection may be lost: then the scheduler knows it, too
            self.cluster.client.cancel([future for future, _ in worker.given.values()])

    def _stop(self) -> None:
        """Stop what the workers are doing, and clean up after it."""
        hands = {address: worker for address, worker in self.workers.items() if worker.given}
        for worker in hands.values():
            self._cancel(worker)
        self._wait_until_stopped(hands)
        for worker in hands.values():
            for _, task in worker.given.values():
                if task is not None:
                    self.options.clean_up(task, worker.member.report.pid)
        with suppress(SuperSdfError):
            if not self.cluster.is_local:
                self.cluster.run(forget, self.run, workers=list(self.workers))

    def _wait_until_stopped(self, hands: dict[str, Worker[Task]]) -> None:
        """Wait until workers have stopped; kill those of this machine that do not."""
        keys = {key for worker in hands.values() for key in worker.given}
        until, left = time.monotonic() + STOP_SECONDS, list(hands)
        while left and time.monotonic() < until:
            try:
                at_work = self.cluster.run(keys_at_work, workers=left)
            except SuperSdfError:
                break
            left = [a for a, found in at_work.items() if isinstance(found, set) and found & keys]
            if left:
                time.sleep(0.05)
        if self.cluster.is_local:
            for address in left:
                with suppress(OSError):
                    os.kill(hands[address].member.report.pid, KILL)
