"""Converting on the workers of a cluster, each of which loads the network once."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from ..cluster.checking import Needs
from ..cluster.connecting import connect
from ..cluster.crew import CheckWanted, ClusterWork, Crew
from ..files.formats import find_format, split_member
from ..machine.extras import EXTRAS, missing_modules
from .pool import Death, Tasks
from ..threads import Resources
from ..network.network import find_model, shipped_models
from .job import Job, Settings, attempt, failed_row
from .ledger import Row

CERTIFICATE_MODULES = ("igl", "scipy")


def convert_on_cluster(
    queue: Tasks[Job],
    jobs: Sequence[Job],
    settings: Settings,
    workers: int,
    warn: Callable[[str], None],
) -> Generator[tuple[Job, Row], None, None]:
    """Yield the jobs of a queue with their rows, as they are converted on a cluster.

    ``jobs`` are the same jobs, for the checks before the work; ``workers`` are processes of this
    machine, for ``--cluster local``. ``warn`` tells the user a sentence. ClusterError if no
    cluster can be reached, its workers lack something, or it is lost.
    """
    address, memory = str(settings.cluster), jobs[0].options.max_memory
    settings = _absolute(settings)
    prepare = partial(_prepare, settings, Path.cwd())
    with (
        connect(address, workers=workers, threads=settings.threads, max_memory=memory) as cluster,
        Crew(cluster, _needs_of(jobs, settings), prepare, warn) as crew,
    ):
        for job, row in crew.completed(queue):
            if isinstance(row, Death):
                row = failed_row(job, f"the process that converted it {row.cause}")
            yield job, row


def _absolute(settings: Settings) -> Settings:
    model = settings.model
    path, _ = find_model(model, settings.precision)
    if path not in shipped_models().values():
        model = os.path.abspath(model)
    items = settings.items and settings.items.absolute()
    return replace(settings, folder=settings.folder.absolute(), items=items, model=model)


def _needs_of(jobs: Sequence[Job], settings: Settings) -> Needs:
    files = [Path(os.path.abspath(split_member(job.source)[0])) for job in jobs]
    extras = {find_format(job.source).extra for job in jobs}
    modules = {module for extra in extras if extra for module in EXTRAS[extra]}
    if settings.check:
        modules.update(CERTIFICATE_MODULES)
    if settings.items:
        modules.update(EXTRAS["report"])
    if any(job.options.goals() for job in jobs):
        modules.update(EXTRAS["simplify"])
    here = modules.difference(missing_modules(tuple(modules)))  # without the others, files fail
    network = settings.model, settings.precision, settings.device
    return Needs(*network, tuple(sorted(here)), files, settings.folder)


def _prepare(settings: Settings, base: Path, limits: Resources) -> ClusterWork:
    """Load the network in a worker; return what converts a job, whose path is relative to base."""
    network = settings.load_network(limits.threads)

    def work(job: Job, check_wanted: CheckWanted) -> Row:
        options = replace(job.options, max_memory=limits.memory)
        placed = replace(job, source=base / job.source, options=options)
        return attempt(placed, settings, network, lambda done, total: check_wanted())

    return work
