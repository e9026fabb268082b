"""Work on a Dask cluster (extra ``cluster``): the files of a batch, or the tiles of one grid.

Dask distributes the tasks, and gives those of a worker that died to another one, as often as its
scheduler allows (``allowed-failures``). A worker works at as many tasks at a time as Dask gave it
threads, each on one thread and with its share of the memory.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import logging
import os
import pkgutil
import tempfile
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import dask
from distributed import Client, KilledWorker, LocalCluster, get_worker, wait

from .. import __version__
from ..errors import ClusterError, SuperSdfError
from ..files.formats import find_format, split_member
from ..errors import EXTRAS, missing_modules
from ..threads import reuse_freed
from ..network.network import find_model, shipped_models
from ..threads import allot_each, count_cores
from .job import Job, Settings, convert_job
from .pool import Death
from .record import Row, fingerprint

Task = TypeVar("Task")
LOCAL = "local"
CONNECT_SECONDS = 5  # that a scheduler has to answer
FIRST_WORKER_SECONDS = 10  # that a cluster has to show a worker
LOOK_SECONDS = 1.0  # between two looks at whether there are workers
PATIENCE_SECONDS = 60.0  # without any worker
MOST_FILES = 100  # whose presence each worker checks
SHARE = 0.75  # of a worker's limit: Dask gives it no more work at 0.8, and kills it at 0.95
VERSION = "super_sdf:__version__"
LOGGERS = ("distributed", "tornado", "asyncio")
CONFIG = {
    "distributed.nanny.pre-spawn-environ": {},  # it would stay in the environment of this process
    "distributed.scheduler.allowed-failures": 1,
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
}
CANCELLED = concurrent.futures.CancelledError, asyncio.CancelledError
TIMEOUTS = TimeoutError, asyncio.TimeoutError  # the same from Python 3.11 on


class Needs(NamedTuple):
    """What every worker has to have: files and a folder at the same paths, a network, packages."""

    files: tuple[Path, ...] = ()
    folder: Path | None = None
    network: tuple[Path, Any] | None = None  # a file that does not come with the package, its hash
    modules: tuple[str, ...] = ()

    def lacking(self) -> str:
        """Return what this process lacks, "" if nothing."""
        for path in self.files:
            if not path.exists():
                return f"does not see {path}: put the inputs where all machines see them"
        if self.folder and not (self.folder.is_dir() and os.access(self.folder, os.W_OK)):
            return f"cannot write to {self.folder}: give a folder that all machines share"
        if self.network and (fingerprint(self.network[0]) or {}).get("sha256") != self.network[1]:
            return f"has another file of the network {self.network[0]}: copy the one from here"
        if missing := missing_modules(self.modules):
            return f"lacks {', '.join(missing)}: install there what is installed here"
        return ""


@contextmanager
def connect(
    address: str, *, workers: int = 0, threads: int = 0, max_memory: int | None = None
) -> Iterator[Client]:
    """Connect to a cluster; at the end, and after errors, everything that was started is closed.

    The address is "local", for processes of this machine (``workers`` of them, 0: one per core),
    that of a Dask scheduler, such as tcp://10.0.0.1:8786, or its scheduler file. ``max_memory`` are
    the bytes of all workers together for "local". ClusterError if nobody answers, or if there is no
    worker.
    """
    with ExitStack() as stack:
        for logger in map(logging.getLogger, LOGGERS):
            stack.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL + 1)
        given: dict[str, Any] = {"address": address}
        if address == LOCAL:
            given["address"] = stack.enter_context(_local_cluster(workers, max_memory))
        elif Path(address).is_file():
            given = {"scheduler_file": address}
        try:
            client = Client(**given, timeout=CONNECT_SECONDS, set_as_default=False)
        except Exception as error:  # of many kinds: a bad address, a refused or silent port, TLS
            is_silent = isinstance(error, (OSError, *TIMEOUTS)) or not str(error)
            why = "" if is_silent else f" ({' '.join(str(error).split())})"
            raise ClusterError(
                f"no Dask scheduler answers at {address}{why}: start one with 'dask scheduler' and "
                "workers with 'dask worker ADDRESS', or give 'local' or another address"
            ) from error
        stack.callback(client.close, timeout=CONNECT_SECONDS)
        with suppress(*TIMEOUTS):
            client.wait_for_workers(1, timeout=FIRST_WORKER_SECONDS)
        if not client.nthreads():
            raise ClusterError(
                f"the Dask scheduler at {address} has no workers: start some with "
                f"'dask worker {address}'"
            )
        yield client


@contextmanager
def _local_cluster(count: int, max_memory: int | None) -> Iterator[LocalCluster]:
    """Run worker processes on this machine, which listen on the loopback interface only."""
    os.environ.setdefault("PYTHONSAFEPATH", "1")  # they import nothing from the current folder
    count = count or count_cores()
    bound = allot_each(count, 0, max_memory).memory if max_memory else None
    with tempfile.TemporaryDirectory(prefix="super-sdf-", ignore_cleanup_errors=True) as scratch:
        with dask.config.set({**CONFIG, "temporary-directory": scratch}):
            try:
                cluster = LocalCluster(
                    n_workers=count,
                    threads_per_worker=1,
                    host="127.0.0.1",
                    dashboard_address=None,
                    worker_dashboard_address=None,
                    memory_limit=int(bound / SHARE) if bound else 0,
                    silence_logs=logging.CRITICAL,
                )
            except Exception as error:  # of many kinds; a worker was killed as it started, say
                raise ClusterError(
                    f"the local workers do not start ({' '.join(str(error).split())}): run it "
                    "again, with fewer --jobs if memory is short"
                ) from error
            with closing(cluster):
                yield cluster


def check_workers(client: Client, needs: Needs) -> None:
    """Raise ClusterError if a worker has no super-sdf, another version of it, or lacks something.

    The first question needs nothing of this package where it is answered.
    """
    for address, answer in client.run(
        pkgutil.resolve_name, VERSION, on_error="return"
    ).items():
        if isinstance(answer, ImportError):
            fault = f"does not have super-sdf: install version {__version__} of it there"
        else:
            fault = (
                f"has super-sdf {answer}, and here is {__version__}: install the same version "
                "there and here"
            )
        if answer != __version__:
            raise ClusterError(f"worker {address} {fault}")
    for address, answer in client.run(needs.lacking, on_error="return").items():
        if answer:
            raise ClusterError(f"worker {address} {answer}")


def completed(
    client: Client, take: Callable[[], Task | None], work: Callable[..., Any]
) -> Generator[tuple[Task, Any], None, None]:
    """Yield tasks with their results as the workers complete them.

    ``take`` returns the next task, None while there is none; ``work(task, memory)`` is called in a
    worker with the bytes that it may hold, if that is known. The result is a Death if the workers
    died that had the task, or if it raised an error. ClusterError if the connection is lost or
    there is no worker any more; SuperSdfError as a worker raised it.
    """
    running: dict[Any, Task] = {}
    seen = time.monotonic()
    lost = ClusterError(
        "the connection to the Dask scheduler was lost: run it again when the scheduler is back"
    )
    try:
        while True:
            with suppress(OSError, *TIMEOUTS):
                threads = sum(client.nthreads().values())
            if client.status != "running":
                raise lost
            seen = time.monotonic() if threads else seen
            if time.monotonic() - seen > PATIENCE_SECONDS:
                raise ClusterError(
                    f"the cluster has had no worker for {PATIENCE_SECONDS:g} s: start some, and "
                    "run it again"
                )
            while len(running) < max(threads, 1) and (task := take()) is not None:
                call = partial(_at_worker, __version__, work)
                running[client.submit(call, task, pure=False)] = task
            if not running:
                return
            done: Iterable[Any] = ()
            with suppress(*TIMEOUTS), client.as_current():
                done = wait(list(running), LOOK_SECONDS, "FIRST_COMPLETED").done
            for future in done:
                yield running.pop(future), _result_of(future)
    except CANCELLED:
        raise lost from None
    finally:
        with suppress(Exception):  # the connection may be lost: then the scheduler knows it, too
            client.cancel(list(running))


def _at_worker(version: str, work: Callable[..., Any], task: Any) -> Any:
    """Work at a task in a worker, which may have come after the others were checked."""
    worker = get_worker()
    if version != __version__:
        raise ClusterError(
            f"worker {worker.address} has super-sdf {__version__}, and {version} is needed there"
        )
    reuse_freed()
    limit = worker.memory_manager.memory_limit
    return work(task, memory=int(SHARE * limit / worker.state.nthreads) if limit else None)


def _result_of(future: Any) -> Any:
    """Return the result of a future that is done, or a Death."""
    try:
        return future.result()
    except CANCELLED:
        raise
    except SuperSdfError:
        raise
    except KilledWorker as error:
        times = error.allowed_failures + 1
        return Death(f"was lost {times} times by the cluster (most likely out of memory)")
    except ImportError as error:
        raise ClusterError(f"a worker cannot import super-sdf: {error}") from None
    except Exception as error:
        return Death(f"ended with {type(error).__name__}: {error}".split("\n")[0])


def convert_on_cluster(
    jobs: Sequence[Job],
    settings: Settings,
    stage: Path,
    take: Callable[[], Job | None],
    workers: int,
) -> Generator[tuple[Job, Any], None, None]:
    """Yield the jobs that ``take`` returns with their rows, as they are converted on a cluster.

    ``jobs`` are all jobs, for the checks before the work; ``workers`` are processes of this
    machine, for ``--cluster local``.
    """
    path, _ = find_model(settings.model, settings.precision)
    is_own = path not in shipped_models().values()
    items = settings.items and settings.items.absolute()
    model = str(Path(settings.model).absolute()) if is_own else settings.model
    there = replace(settings, folder=settings.folder.absolute(), items=items, model=model)
    files = [split_member(job.source)[0].absolute() for job in jobs]
    some = tuple(file for file in files[:: max(1, len(files) // MOST_FILES)] if file.exists())
    extras = {find_format(job.source).extra for job in jobs} - {None, ""}
    extras |= {"report"} if settings.check or settings.items else set()
    extras |= {"simplify"} if any(job.options.goals() for job in jobs) else set()
    modules = tuple(sorted({module for extra in extras for module in EXTRAS[str(extra)]}))
    here = tuple(set(modules).difference(missing_modules(modules)))  # without others, files fail
    network = (path.absolute(), (fingerprint(path) or {}).get("sha256")) if is_own else None
    work = partial(_convert, settings=there, stage=stage.absolute(), base=Path.cwd())
    memory = jobs[0].options.max_memory
    with connect(str(settings.cluster), workers=workers, max_memory=memory) as client:
        check_workers(client, Needs(some, there.folder, network, here))
        with closing(completed(client, take, work)) as results:
            yield from results


def _convert(job: Job, settings: Settings, stage: Path, base: Path, memory: int | None) -> Row:
    """Convert a file, whose path is relative to ``base``, in a worker."""
    bounds = [bound for bound in (memory, job.options.max_memory) if bound]
    options = replace(job.options, max_memory=min(bounds, default=None))
    placed = replace(job, source=base / job.source, options=options)
    return convert_job(placed, settings, stage, settings.threads or 1)
