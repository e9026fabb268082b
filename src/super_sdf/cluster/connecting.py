"""Connecting to a cluster: worker processes of this machine, or a Dask scheduler at an address.

Everything that Dask has to say comes as one line, a ClusterError; its own messages are silenced.
"""

from __future__ import annotations

import asyncio
import logging
import signal
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TypeVar

import dask
from distributed import Client, Nanny, Scheduler, SpecCluster, Worker
from distributed.comm import core as comm
from distributed.security import Security

from ..errors import ClusterError
from ..batch.pool import ending_signals_blocked, python_flags
from ..threads import Resources, allot_each, count_cores

LOCAL = "local"
CONNECT_SECONDS = 5  # that a scheduler has to answer
FIRST_WORKER_SECONDS = 10  # that a cluster has to show a worker
CLOSE_SECONDS = 5  # that the workers of this machine have to end
HARD_LIMIT = 1.25  # of the memory that a worker of this machine plans with: above, it is killed
LEAST_HARD_LIMIT = 5 * 10**8  # an idle worker holds a third of it
LOGGERS = ("distributed", "tornado", "asyncio", "bokeh")
CONFIG = {
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 1.0,
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.admin.tick.interval": "1s",
    "distributed.scheduler.allowed-failures": 1,
    "distributed.scheduler.work-stealing": False,
    "distributed.scheduler.active-memory-manager.start": False,
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    "distributed.worker.profile.enabled": False,
    "distributed.nanny.pre-spawn-environ": {},  # it would stay in the environment of this process
}
Answer = TypeVar("Answer")


class QuietScheduler(Scheduler):
    """A scheduler without a dashboard; Dask's answers at port 8787 even without any page."""

    def start_http_server(self, *_: Any, **__: Any) -> None:
        """Open no port."""


class QuietWorker(Worker):
    """A worker without a dashboard."""

    def start_http_server(self, *_: Any, **__: Any) -> None:
        """Open no port."""


@dataclass(frozen=True)
class Cluster:
    """A cluster that is connected: Dask's client, the address asked for, what each worker may use.

    0 threads are those that Dask gave it.
    """

    client: Client
    address: str
    limits: Resources

    @property
    def is_local(self) -> bool:
        """Whether the workers were started by this process."""
        return self.address == LOCAL

    def workers(self) -> dict[str, int]:
        """Return the threads of each worker by address; ClusterError if the connection is lost."""
        return dict(self.ask(self.client.nthreads))

    def run(self, function: Callable[..., Any], *given: Any, workers: list[str]) -> dict[str, Any]:
        """Call a function in some workers, beside their work; return results or exceptions."""
        run = self.client.run
        return dict(self.ask(lambda: run(function, *given, workers=workers, on_error="return")))

    def ask(self, question: Callable[[], Answer]) -> Answer:
        """Return what the scheduler answers; raise ClusterError if the connection is lost."""
        with suppress(OSError, asyncio.TimeoutError):
            if self.client.status == "running":
                return question()
        raise self.lost()

    def lost(self) -> ClusterError:
        """Return the error for a connection that was lost."""
        return ClusterError(
            f"the connection to the Dask scheduler at {self.address} was lost: run it again when "
            "the scheduler is back"
        )


@contextmanager
def connect(
    address: str, *, workers: int = 0, threads: int = 0, max_memory: int | None = None
) -> Iterator[Cluster]:
    """Connect to a cluster; at the end, and after errors, everything that was started is closed.

    The address is "local", for processes of this machine (``workers`` of them, 0: one per core), or
    that of a Dask scheduler, such as tcp://10.0.0.1:8786. ``threads`` are those of each worker; 0:
    its share of the cores, or those that Dask gave it. ``max_memory`` are the bytes of all workers
    together for "local", else of each. ClusterError if nobody answers, or there is no worker.
    """
    with ExitStack() as stack:
        stack.enter_context(_silence())
        server: Any = address
        limits = Resources(threads, max_memory)
        if address == LOCAL:
            count = workers or count_cores()
            limits = allot_each(count, threads, max_memory)
            stack.enter_context(dask.config.set(CONFIG))
            hard = max(int(HARD_LIMIT * (limits.memory or 0)), LEAST_HARD_LIMIT)
            server = stack.enter_context(_local_cluster(count, hard if max_memory else 0))
        client = stack.enter_context(_open_client(server, address))
        cluster = Cluster(client, address, limits)
        with suppress(TimeoutError, asyncio.TimeoutError):  # the same from Python 3.11 on
            client.wait_for_workers(1, timeout=FIRST_WORKER_SECONDS)
        if not cluster.workers():
            raise ClusterError(
                f"the Dask scheduler at {address} has no workers: start some with "
                f"'dask worker {address}'"
            )
        yield cluster


@contextmanager
def _local_cluster(count: int, killed_at: int) -> Iterator[SpecCluster]:
    """Run worker processes on this machine, each killed at some bytes of memory; 0: no limit.

    They listen on the loopback interface only, and open no dashboard. Signals are held back while
    they start: none may start without being known here, and what they inherit keeps a Ctrl-C in the
    terminal from them.
    """
    host, silence_logs = "127.0.0.1", logging.CRITICAL
    scheduler = {"cls": QuietScheduler, "options": {"host": host, "port": 0, "dashboard": False}}
    options = {"host": host, "nthreads": 1, "memory_limit": killed_at, "silence_logs": silence_logs}
    worker = {"cls": Nanny, "options": {**options, "worker_class": QuietWorker}}
    with (
        tempfile.TemporaryDirectory(prefix="super-sdf-", ignore_cleanup_errors=True) as scratch,
        dask.config.set({"temporary-directory": scratch}),
        python_flags(),  # as long as workers may be started again
    ):
        _start_quiet_tracker()
        with ending_signals_blocked():
            workers = dict.fromkeys(range(count), worker)
            try:
                cluster = SpecCluster(workers, scheduler, silence_logs=silence_logs)
            except Exception as error:  # of many kinds; a worker was killed as it started, say
                raise ClusterError(
                    f"the local workers do not start ({' '.join(str(error).split())}): run it "
                    "again, with fewer --jobs if memory is short"
                ) from error
        try:
            yield cluster
        finally:
            with suppress(Exception):  # it is closing: what does not end by itself is killed
                cluster.close(timeout=CLOSE_SECONDS)


def _start_quiet_tracker() -> None:
    """Start Python's resource tracker so that it says nothing of Dask's semaphores after a signal.

    It runs as long as this process, and hears the SIGHUP of a terminal that is closed.
    """
    from multiprocessing import resource_tracker

    hears = threading.current_thread() is threading.main_thread() and hasattr(signal, "SIGHUP")
    handler = signal.signal(signal.SIGHUP, signal.SIG_IGN) if hears else None
    try:
        with python_flags("-Wignore:resource_tracker"):
            resource_tracker.ensure_running()
    finally:
        if hears:
            signal.signal(signal.SIGHUP, handler)


@contextmanager
def _open_client(server: Any, address: str) -> Iterator[Client]:
    """Connect to a scheduler; ClusterError if it does not answer."""
    try:
        if address != LOCAL:
            asyncio.run(_greet(server))
        client = Client(server, timeout=CONNECT_SECONDS, set_as_default=False)
    except Exception as error:  # of many kinds: a bad address, a refused or silent port, TLS
        is_silent = isinstance(error, (OSError, asyncio.TimeoutError)) or not str(error)
        why = "" if is_silent else f" ({' '.join(str(error).split())})"
        raise ClusterError(
            f"no Dask scheduler answers at {address}{why}: start one with 'dask scheduler' and "
            "workers with 'dask worker ADDRESS', or give 'local' or another address"
        ) from error
    try:
        yield client
    finally:
        with suppress(Exception):
            client.close(timeout=CLOSE_SECONDS)


async def _greet(address: str) -> None:
    """Raise if a scheduler does not return a greeting in time: a Client would wait for ever."""
    arguments = Security().get_connection_args("client")
    peer = await asyncio.wait_for(comm.connect(address, **arguments), CONNECT_SECONDS)
    await peer.close()


@contextmanager
def _silence() -> Iterator[None]:
    """Keep Dask's log messages and warnings from the terminal within the block."""
    names = [name for name in logging.root.manager.loggerDict if name.split(".")[0] in LOGGERS]
    loggers = [logging.getLogger(name) for name in (*LOGGERS, *names)]
    levels = [logger.level for logger in loggers]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for logger in loggers:
            logger.setLevel(logging.CRITICAL + 1)
        try:
            yield
        finally:
            for logger, level in reversed(list(zip(loggers, levels))):
                logger.setLevel(level)
