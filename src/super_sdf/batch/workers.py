"""Converting in this process or in workers, each of which loads the network once."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

from ..machine.memory import free_memory
from ..machine.pool import Tasks
from ..machine.serving import Work
from ..machine.threads import count_cores
from ..network.cuda import available_devices
from ..network.network import Network, load_network
from .job import Job, Outputs, Row, attempt

BYTES_PER_WORKER = 10**9  # for the network and a grid of 128^3, where --jobs is not given
MIN_BYTES_PER_WORKER = 3 * 10**8  # with less a worker cannot convert anything


@dataclass(frozen=True)
class Loading:
    """How a worker loads its network: see ``load_network``."""

    model: str
    precision: str
    device: str
    threads: int

    def load(self) -> Network:
        """Return the network."""
        return load_network(
            self.model, device=self.device, threads=self.threads, precision=self.precision
        )


def choose_workers(device: str, jobs: int, max_memory: int | None = None) -> int:
    """Return how many processes to use: one per core if memory allows; one on a GPU."""
    if device == "cuda" or (device == "auto" and "cuda" in available_devices()):
        return 1
    free = max_memory or free_memory()
    room = count_cores() if free is None else free // BYTES_PER_WORKER
    return max(1, min(count_cores(), room, jobs))


def useful_workers(asked: int, jobs: int, max_memory: int | None = None) -> tuple[int, str | None]:
    """Return how many of the processes asked for are useful, and a note if that is fewer."""
    cores = count_cores()
    limits = [
        (jobs, "there is no more to do"),
        (cores, "this process may use no more cores"),
    ]
    if max_memory is not None:
        limits.append(
            (max(1, max_memory // MIN_BYTES_PER_WORKER), "--max-memory has no room for more")
        )
    most, cause = min(limits)
    return min(asked, most), None if asked <= most else f"--jobs {asked} is cut to {most}: {cause}"


def prepare_worker(loading: Loading, outputs: Outputs) -> Work:
    """Load the network; return the function that converts a job and returns its row."""
    network = loading.load()
    return lambda job, tell: attempt(job, outputs, network)


def convert_here(
    jobs: Tasks[Job], loading: Loading, outputs: Outputs
) -> Generator[tuple[Job, Row], None, None]:
    """Convert one file after another in this process; yield each job and its row."""
    network = loading.load()
    while len(jobs):
        job = jobs.popleft()
        yield job, attempt(job, outputs, network)
