"""Who converts: this process, or one that a pool started; each loads its network once."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path

from ..chunks import count_cores
from ..cuda import available_devices
from ..errors import SuperSdfError
from ..memory import free_memory
from ..network import Network, load_network
from .job import Job, Result, attempt

# Of memory, for each process that is started unasked: the network, and a grid of 128^3.
BYTES_PER_WORKER = 10**9

Begin = Callable[[Job], None]
"""Called with a job before it begins."""


@dataclass(frozen=True)
class Loading:
    """How a worker loads its network: see ``load_network``."""

    model: str
    precision: str
    device: str
    threads: int

    def load(self) -> Network:
        """Load the network."""
        return load_network(
            self.model, device=self.device, threads=self.threads, precision=self.precision
        )


def choose_workers(device: str, jobs: int) -> int:
    """Return how many processes are best: one a core, as far as memory goes; one on a GPU."""
    if device == "cuda" or (device == "auto" and "cuda" in available_devices()):
        return 1
    free = free_memory()
    room = count_cores() if free is None else free // BYTES_PER_WORKER
    return max(1, min(count_cores(), room, jobs))


def convert_here(
    jobs: Iterator[Job], folder: Path, loading: Loading, begin: Begin
) -> Iterator[Result]:
    """Convert one file after another in this process; yield each as it is done."""
    network = loading.load()
    for job in jobs:
        begin(job)
        yield Result(job, attempt(job, folder, network))


def serve(pipe: Connection, folder: Path, loading: Loading) -> None:
    """Convert what comes by the pipe, until nobody is at its other end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=end_with_parent, daemon=True).start()
    try:
        network = loading.load()
    except SuperSdfError as error:
        pipe.send(error)
        return
    with suppress(EOFError, OSError):
        pipe.send(None)
        while True:
            pipe.send(attempt(pipe.recv(), folder, network))


def end_with_parent() -> None:
    """End this process when its parent does, however that does: an orphan would write on."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
