"""Work on a Dask cluster (extra ``cluster``): the files of a batch, or the tiles of one grid.

Dask gives the tasks of a worker that died to another one, as often as its scheduler allows
(``allowed-failures``). Each thread of a worker has one task, and its share of the memory.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import logging
import os
import pkgutil
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import dask
from distributed import Client, KilledWorker, LocalCluster, Security, get_worker, wait
from distributed.comm import core as comm

from .. import __version__
from ..errors import ClusterError, SuperSdfError
from ..files.formats import split_member
from ..threads import count_cores
from .inputs import Job
from .record import Row
from .work import Death, Settings, Task, convert_job

CONNECT_SECONDS = 5  # that a scheduler has to answer
FIRST_WORKER_SECONDS = 10  # that a cluster has to show a worker
LOOK_SECONDS = 1.0  # between two looks at whether there are workers
PATIENCE_SECONDS = 60.0  # without any worker
SHARE = 0.75  # of a worker's limit: Dask gives it no more work at 0.8, and kills it at 0.95
ALONE = {"threads_per_worker": 1, "host": "127.0.0.1", "silence_logs": logging.CRITICAL} | {
    f"{prefix}dashboard_address": None for prefix in ("", "worker_")
}
CONFIG = {
    "distributed.nanny.pre-spawn-environ": {},  # it would stay in the environment of this process
    "distributed.scheduler.allowed-failures": 1,
    "distributed.worker.memory.spill": False,
}
TIMEOUTS = TimeoutError, asyncio.TimeoutError  # the same from Python 3.11 on
CANCELLED = concurrent.futures.CancelledError, asyncio.CancelledError


@contextmanager
def connect(address: str, workers: int = 0, max_memory: int | None = None) -> Iterator[Client]:
    """Connect to a cluster; at the end, and after errors, everything that was started is closed.

    The address is that of a Dask scheduler, such as tcp://10.0.0.1:8786, or its scheduler file, or
    "local", for ``workers`` processes of this machine (0: one per core), which share the bytes of
    ``max_memory``. ClusterError if nobody answers, or if a worker has another version.
    """
    with ExitStack() as stack:
        logging.disable(logging.CRITICAL)  # what Dask has to say comes as one line
        stack.callback(logging.disable, logging.NOTSET)
        is_file = address != "local" and Path(address).is_file()
        server: Any = {"scheduler_file" if is_file else "address": address}
        try:
            if address == "local":
                os.environ.setdefault("PYTHONSAFEPATH", "1")  # import nothing from this folder
                stack.enter_context(dask.config.set(CONFIG))
                count = workers or count_cores()
                share = {"n_workers": count, "memory_limit": (max_memory or 0) // count}
                server = {"address": stack.enter_context(LocalCluster(**share, **ALONE))}
            elif not is_file:
                known = Security().get_connection_args("client")  # a Client would wait for ever
                asyncio.run(asyncio.wait_for(comm.connect(address, **known), CONNECT_SECONDS))
            client = Client(**server, timeout=CONNECT_SECONDS, set_as_default=False)
        except Exception as error:  # of many kinds: a bad address, a refused or silent port, TLS
            start = "start one with 'dask scheduler' and workers with 'dask worker ADDRESS'"
            said = f"no Dask scheduler answers at {address}: {start}, or give 'local'"
            raise ClusterError(said) from error
        stack.callback(client.close, timeout=CONNECT_SECONDS)
        with suppress(*TIMEOUTS):
            client.wait_for_workers(1, timeout=FIRST_WORKER_SECONDS)
        # This question needs nothing of super-sdf where it is answered.
        answers = client.run(pkgutil.resolve_name, "super_sdf:__version__", on_error="return")
        if not answers:
            lack = f"the Dask scheduler at {address} has no workers"
            raise ClusterError(f"{lack}: start some with 'dask worker {address}'")
        for worker, version in answers.items():
            if version != __version__:
                said = f"worker {worker} has another super-sdf ({version}) than here"
                raise ClusterError(f"{said} ({__version__}): install the same on both sides")
        yield client


def completed(
    client: Client, take: Callable[[], Task | None], work: Callable[..., Any]
) -> Generator[tuple[Task, Any], None, None]:
    """Yield tasks with their results as the workers complete them.

    ``take`` returns the next task, None while there is none; ``work(task, memory)`` is called in a
    worker with the bytes that it may hold, if known. The result is a Death if workers died of it or
    a bug was met. ClusterError if the scheduler or all workers are lost.
    """

    def at_worker(task: Task) -> Any:
        worker = get_worker()
        limit = worker.memory_manager.memory_limit or 0
        return work(task, memory=int(SHARE * limit / worker.state.nthreads) or None)

    running, threads, seen = dict[Any, Task](), 0, time.monotonic()
    try:
        while True:
            with suppress(OSError, *TIMEOUTS):
                threads = sum(client.nthreads().values())
            seen = time.monotonic() if threads else seen
            if client.status != "running" or time.monotonic() - seen > PATIENCE_SECONDS:
                raise ClusterError("the Dask scheduler, or all workers, were lost: run it again")
            while len(running) < max(threads, 1) and (task := take()) is not None:
                running[client.submit(at_worker, task, pure=False)] = task
            if not running:
                return
            done = set[Any]()
            with suppress(*TIMEOUTS), client.as_current():
                done = wait(list(running), LOOK_SECONDS, "FIRST_COMPLETED").done
            for future in done:
                task = running.pop(future)
                try:
                    result = future.result()
                except (SuperSdfError, *CANCELLED):
                    raise
                except Exception as error:
                    said = f"ended with {type(error).__name__}: {error}".split("\n")[0]
                    if isinstance(error, KilledWorker):
                        said = f"was lost {error.allowed_failures + 1} times by the cluster (most "
                        said += "likely out of memory)"
                    result = Death(said)
                yield task, result
    except CANCELLED:
        raise ClusterError("the Dask scheduler was lost: run it again") from None
    finally:
        with suppress(Exception):  # the connection may be lost: then the scheduler knows it, too
            client.cancel(list(running))


def tiles_on(client: Client) -> Callable[..., Iterator[Any]]:
    """Return the ``map_tiles`` of ``mesh_grid`` that has tiles made, and signed, by workers."""

    def map_tiles(make: Callable[[Any], Any], tasks: Iterator[Any]) -> Iterator[Any]:
        def work(task: Any, memory: int | None) -> Any:
            return replace(make(replace(task, threads=1)), worker=get_worker().address)

        for task, part in completed(client, lambda: next(tasks, None), work):
            if isinstance(part, Death):
                raise ClusterError(f"a worker at {task.tile} {part}: give it more memory")
            yield part

    return map_tiles


def convert_on_cluster(
    first: Job, settings: Settings, stage: Path, take: Callable[[], Job | None], workers: int
) -> Generator[tuple[Job, Any], None, None]:
    """Yield the jobs that ``take`` returns with their rows, as they are converted on a cluster.

    Workers have to see inputs, of which the ``first`` is looked for, and outputs by the same paths.
    """
    options, items, base = settings.options, settings.items, Path.cwd()
    files = [p for p in (base / stage, base / split_member(first.source)[0]) if p.exists()]
    if options.model and Path(options.model).exists():
        options = replace(options, model=str(base / options.model))
    there = replace(settings, options=options, folder=base / settings.folder)
    there = replace(there, items=items and base / items)

    def work(job: Job, memory: int | None) -> Row:
        placed = replace(job, source=base / job.source)
        return convert_job(placed, there, files[0], options.threads or 1, memory)

    with connect(str(settings.cluster), workers, options.max_memory) as client:
        unseen = client.run(lambda: [str(path) for path in files if not os.access(path, os.R_OK)])
        for worker, paths in unseen.items():
            if paths:
                way_out = "put it where all machines see it by this path, and may write the output"
                raise ClusterError(f"worker {worker} does not see {paths[0]}: {way_out}")
        with closing(completed(client, take, work)) as results:
            yield from results
