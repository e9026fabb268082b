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
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import dask
from distributed import Client, KilledWorker, LocalCluster, Security, get_worker, wait
from distributed.comm import core as comm

from .. import __version__
from ..errors import ClusterError, SuperSdfError
from ..files.formats import split_member
from ..network.network import find_model, shipped_models
from ..threads import count_cores
from .job import Job, Settings, convert_job
from .pool import Death
from .record import Row

Task = TypeVar("Task")
LOCAL = "local"
CONNECT_SECONDS = 5  # that a scheduler has to answer
FIRST_WORKER_SECONDS = 10  # that a cluster has to show a worker
LOOK_SECONDS = 1.0  # between two looks at whether there are workers
PATIENCE_SECONDS = 60.0  # without any worker
MOST_FILES = 100  # whose presence each worker checks
SHARE = 0.75  # of a worker's limit: Dask gives it no more work at 0.8, and kills it at 0.95
CONFIG = {
    "distributed.nanny.pre-spawn-environ": {},  # it would stay in the environment of this process
    "distributed.scheduler.allowed-failures": 1,
    "distributed.worker.memory.spill": False,
}
CANCELLED = concurrent.futures.CancelledError, asyncio.CancelledError
TIMEOUTS = TimeoutError, asyncio.TimeoutError  # the same from Python 3.11 on


@contextmanager
def connect(address: str, workers: int = 0, max_memory: int | None = None) -> Iterator[Client]:
    """Connect to a cluster; at the end, and after errors, everything that was started is closed.

    The address is "local", for processes of this machine (``workers`` of them, 0: one per core),
    that of a Dask scheduler, such as tcp://10.0.0.1:8786, or its scheduler file. ``max_memory`` are
    the bytes of all workers together for "local". ClusterError if nobody answers, or if there is no
    worker of this version of super-sdf.
    """
    with ExitStack() as stack:
        logging.disable(logging.CRITICAL)  # what Dask has to say comes as one line
        stack.callback(logging.disable, logging.NOTSET)
        server: Any = {"address": address}
        if address != LOCAL and Path(address).is_file():
            server = {"scheduler_file": address}
        try:
            if address == LOCAL:
                os.environ.setdefault("PYTHONSAFEPATH", "1")  # import nothing from this folder
                stack.enter_context(dask.config.set(CONFIG))
                cluster = LocalCluster(
                    n_workers=workers or count_cores(),
                    threads_per_worker=1,
                    host="127.0.0.1",  # nobody else hears them
                    dashboard_address=None,
                    worker_dashboard_address=None,
                    memory_limit=(max_memory or 0) // (workers or count_cores()),
                    silence_logs=logging.CRITICAL,
                )
                server = {"address": stack.enter_context(cluster)}
            elif "address" in server:
                asyncio.run(_greet(address))
            client = Client(**server, timeout=CONNECT_SECONDS, set_as_default=False)
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
        # This question needs nothing of super-sdf where it is answered.
        answers = client.run(pkgutil.resolve_name, "super_sdf:__version__", on_error="return")
        if not answers:
            way_out = f"start some with 'dask worker {address}'"
            raise ClusterError(f"the Dask scheduler at {address} has no workers: {way_out}")
        for worker, answer in answers.items():
            if answer != __version__:
                has = "none" if isinstance(answer, Exception) else answer
                raise ClusterError(
                    f"worker {worker} has another super-sdf ({has}) than here ({__version__}): "
                    "install the same version there and here"
                )
        yield client


async def _greet(address: str) -> None:
    """Raise if a scheduler does not answer in time: a Client would wait for ever."""
    arguments = Security().get_connection_args("client")
    peer = await asyncio.wait_for(comm.connect(address, **arguments), CONNECT_SECONDS)
    await peer.close()


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
    threads, seen = 0, time.monotonic()
    try:
        while True:
            with suppress(OSError, *TIMEOUTS):
                threads = sum(client.nthreads().values())
            seen = time.monotonic() if threads else seen
            if client.status != "running" or time.monotonic() - seen > PATIENCE_SECONDS:
                raise ClusterError("the Dask scheduler, or all workers, were lost: run it again")
            while len(running) < max(threads, 1) and (task := take()) is not None:
                call = partial(_at_worker, __version__, work)
                running[client.submit(call, task, pure=False)] = task
            if not running:
                return
            done = set[Any]()
            with suppress(*TIMEOUTS), client.as_current():
                done = wait(list(running), LOOK_SECONDS, "FIRST_COMPLETED").done
            for future in done:
                yield running.pop(future), _result_of(future)
    except CANCELLED:
        raise ClusterError("the Dask scheduler was lost: run it again") from None
    finally:
        with suppress(Exception):  # the connection may be lost: then the scheduler knows it, too
            client.cancel(list(running))


def _at_worker(version: str, work: Callable[..., Any], task: Any) -> Any:
    """Work at a task in a worker, which may have come after the others were checked."""
    worker = get_worker()
    if version != __version__:
        said = f"worker {worker.address} has super-sdf {__version__}, and here is {version}"
        raise ClusterError(f"{said}: install the same version there and here")
    limit = worker.memory_manager.memory_limit
    return work(task, memory=int(SHARE * limit / worker.state.nthreads) if limit else None)


def _result_of(future: Any) -> Any:
    """Return the result of a future that is done, or a Death."""
    try:
        return future.result()
    except (SuperSdfError, *CANCELLED):
        raise
    except KilledWorker as error:
        times = error.allowed_failures + 1
        return Death(f"was lost {times} times by the cluster (most likely out of memory)")
    except ImportError as error:
        raise ClusterError(f"a worker cannot import super-sdf: {error}") from None
    except Exception as error:
        return Death(f"ended with {type(error).__name__}: {error}".split("\n")[0])


def tiles_on(client: Client) -> Callable[..., Iterator[Any]]:
    """Return the ``map_tiles`` of ``mesh_grid`` that has tiles made on a cluster.

    ClusterError if workers died of a tile.
    """

    def map_tiles(make: Callable[[Any], Any], tasks: Iterator[Any]) -> Iterator[Any]:
        work = partial(_make_tile, make=make)
        for task, part in completed(client, lambda: next(tasks, None), work):
            if isinstance(part, Death):
                raise ClusterError(f"a worker at {task.tile} {part.cause}: give it more memory")
            yield part

    return map_tiles


def _make_tile(task: Any, memory: int | None, make: Callable[[Any], Any]) -> Any:
    """Make a tile in a worker, and say which worker it was."""
    return replace(make(replace(task, threads=1)), worker=get_worker().address)


def convert_on_cluster(
    jobs: Sequence[Job],
    settings: Settings,
    stage: Path,
    take: Callable[[], Job | None],
    workers: int,
) -> Generator[tuple[Job, Any], None, None]:
    """Yield the jobs that ``take`` returns with their rows, as they are converted on a cluster.

    ``jobs`` are all jobs, for the check of the workers: they have to see the inputs and the output
    folder by the same paths. ``workers`` are processes of this machine, for ``--cluster local``.
    """
    path, _ = find_model(settings.model, settings.precision)
    model = settings.model if path in shipped_models().values() else os.path.abspath(settings.model)
    items = settings.items and settings.items.absolute()
    there = replace(settings, folder=settings.folder.absolute(), items=items, model=model)
    files = [split_member(job.source)[0].absolute() for job in jobs]
    some = [file for file in files[:: len(files) // MOST_FILES + 1] if file.exists()]
    some += [Path(model)] if model != settings.model else []
    work = partial(_convert, settings=there, stage=stage.absolute(), base=Path.cwd())
    memory = jobs[0].options.max_memory
    with connect(str(settings.cluster), workers, memory) as client:
        for worker, lack in client.run(_lacking, some, stage.absolute()).items():
            if lack:
                raise ClusterError(f"worker {worker} {lack}")
        with closing(completed(client, take, work)) as results:
            yield from results


def _lacking(files: Sequence[Path], folder: Path) -> str:
    """Return what this process lacks, "" if nothing."""
    for path in files:
        if not path.exists():
            return f"does not see {path}: put it where all machines see it by this path"
    if not os.access(folder, os.W_OK):
        return f"cannot write to {folder.parents[1]}: give a folder that all machines share"
    return ""


def _convert(job: Job, settings: Settings, stage: Path, base: Path, memory: int | None) -> Row:
    """Convert a file, whose path is relative to ``base``, in a worker."""
    bounds = [bound for bound in (memory, job.options.max_memory) if bound]
    options = replace(job.options, max_memory=min(bounds, default=None))
    placed = replace(job, source=base / job.source, options=options)
    return convert_job(placed, settings, stage, settings.threads or 1)
