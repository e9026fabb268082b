"""Converting on the workers of a cluster, each of which loads the network once."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from ..cluster.checking import Needs, check_workers
from ..cluster.connecting import Limits, connect
from ..cluster.pool import ClusterPool, ClusterPoolOptions
from ..cluster.serving import CheckWanted, ClusterWork
from ..files.formats import find_format, split_member
from ..machine.extras import EXTRAS, all_modules, missing_modules
from ..machine.pool import Death, Tasks
from ..network.network import find_model, shipped_models
from .job import Job, Outputs, Row, attempt
from .plan import Settings
from .workers import Loading

CERTIFICATE_MODULES = ("igl", "scipy")


@dataclass(frozen=True)
class Handling:
    """What a run does with jobs whose worker died, and with warnings.

    Attributes
    ----------
    clean_up : callable
        Removes what a worker, given by its process ID, left of a job's output.
    is_suspect : callable
        Returns whether a worker died at the job before.
    warn : callable
        Tells the user a sentence.
    """

    clean_up: Callable[[Job, int], None]
    is_suspect: Callable[[Job], bool]
    warn: Callable[[str], None]


def convert_on_cluster(
    queue: Tasks[Job],
    jobs: Sequence[Job],
    settings: Settings,
    workers: int,
    handling: Handling,
) -> Generator[tuple[Job, Row | Death], None, None]:
    """Convert the jobs of a queue on a cluster.

    Parameters
    ----------
    queue : Tasks
        The jobs, as they are to be started.
    jobs : sequence of Job
        The same jobs, for the checks before the work.
    settings : Settings
        How the batch is run.
    workers : int
        Worker processes of this machine, for ``--cluster local``.
    handling : Handling
        What is done with jobs whose worker died, and with warnings.

    Yields
    ------
    job, row or Death
        Each job as it ends.

    Raises
    ------
    ClusterError
        If the cluster cannot be reached, if its workers lack something, or if it is lost.
    """
    address, memory = str(settings.cluster), jobs[0].options.max_memory
    settings = absolute(settings)
    options = ClusterPoolOptions(
        handling.clean_up, handling.is_suspect, not settings.fail_fast, handling.warn
    )
    with connect(address, workers=workers, threads=settings.threads, max_memory=memory) as cluster:
        needs = needs_of(jobs, settings)
        checked = check_workers(cluster, needs)
        for warning in checked.warnings:
            handling.warn(warning)
        prepare = partial(prepare_on_cluster, settings, socket.gethostname(), Path.cwd())
        yield from ClusterPool(cluster, checked, needs, queue, prepare, options).results()


def absolute(settings: Settings) -> Settings:
    """Return settings whose paths hold in any working folder."""
    model = settings.model
    path, _ = find_model(model, settings.precision)
    if path not in shipped_models().values():
        model = os.path.abspath(model)
    items = settings.items and Path(os.path.abspath(settings.items))
    folder = Path(os.path.abspath(settings.folder))
    return replace(settings, folder=folder, items=items, model=model)


def needs_of(jobs: Sequence[Job], settings: Settings) -> Needs:
    """Return what the jobs need of every worker."""
    files = [Path(os.path.abspath(split_member(job.source)[0])) for job in jobs]
    extras = {find_format(job.source).extra for job in jobs}
    modules = {module for extra in extras if extra for module in EXTRAS[extra]}
    if settings.check:
        modules.update(CERTIFICATE_MODULES)
    if settings.items:
        modules.update(all_modules("report"))
    if any(job.options.simplifies for job in jobs):
        modules.update(all_modules("simplify"))
    here = modules.difference(missing_modules(tuple(modules)))  # without the others, files fail
    network = settings.model, settings.precision, settings.device
    return Needs(*network, tuple(sorted(here)), files, settings.folder)


def prepare_on_cluster(settings: Settings, host: str, base: Path, limits: Limits) -> ClusterWork:
    """Load the network in a worker; return the function that converts a job and returns its row.

    Parameters
    ----------
    settings : Settings
        How the batch is run; absolute paths.
    host, base : str, Path
        The machine that runs the batch, and its working folder.
    limits : Limits
        What this worker may use.
    """
    loading = Loading(settings.model, settings.precision, settings.device, limits.threads)
    outputs = Outputs(settings.folder, settings.check, settings.items, host)
    network = loading.load()

    def work(job: Job, check_wanted: CheckWanted) -> Row:
        options = replace(job.options, max_memory=limits.memory)
        placed = replace(job, source=base / job.source, options=options)
        return attempt(placed, outputs, network, lambda done, total: check_wanted())

    return work
