"""The workers' side: passes over ranges of planes, and the mesh of a brick."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from ..convert import ConvertOptions
from ..errors import SuperSdfError
from ..grid.planes import Ranges, SamplePlanes
from ..grid.sdf_grid import SdfGrid
from ..machine.memory import give_back, held_memory
from ..network.network import Network, load_network
from ..pipeline import reconstruct_planes
from ..slabs.pieces import Piece
from ..steps.band import BandSummary
from .stored import Source, opened

if TYPE_CHECKING:
    from ..cluster.connecting import Limits
    from ..cluster.serving import CheckWanted

    Work = Callable[[Any, CheckWanted], Any]


class Failed(NamedTuple):
    """Result: the error that a task raised."""

    error: SuperSdfError


class RangesTask(NamedTuple):
    """A function, and the ranges of planes that it is called with."""

    samples: SamplePlanes
    work: Callable[..., Any]
    ranges: Ranges


class Loading(NamedTuple):
    """How a worker loads its network: see ``load_network``."""

    model: str
    precision: str
    device: str

    def load(self, threads: int) -> Network:
        """Return the network."""
        return load_network(
            self.model, device=self.device, threads=threads, precision=self.precision
        )


class MeshTask(NamedTuple):
    """A brick to mesh.

    Attributes
    ----------
    grid : SdfGrid
        Its samples are read where the brick is meshed.
    planes : two ints
        Its first plane, and that after its last.
    whole : BandSummary
        Of the band of the whole grid.
    options : ConvertOptions
        Factor, offset, cap and mesher.
    """

    grid: SdfGrid
    planes: tuple[int, int]
    whole: BandSummary
    options: ConvertOptions


@dataclass(frozen=True, eq=False)
class Meshed:
    """The mesh of a brick.

    Attributes
    ----------
    pieces : list of Piece
        Those of its slabs. Vertices are counted from the first of the brick.
    worker : str
        Machine and number of the process that made it.
    peak, bound : int or None
        The most memory that this process has held so far, and that it might hold, in bytes.
    """

    pieces: list[Piece]
    worker: str
    peak: int | None
    bound: int | None


def prepare_ranges(source: Source, limits: Limits) -> Work:
    """Open the store; return the function that works at ranges of planes."""
    opened(source).bound = limits.memory
    return partial(_answering, work_at_ranges)


def prepare_meshing(source: Source, loading: Loading, limits: Limits) -> Work:
    """Open the store and load the network; return the function that meshes a brick."""
    opened(source).bound = limits.memory
    network = loading.load(limits.threads)
    return partial(_answering, partial(mesh_brick, network, limits))


def _answering(work: Work, brick: Any, check: CheckWanted) -> Any:
    """Return the result of a brick's task, or its error if it is one for users."""
    try:
        check()
        return work(brick.task, check)
    except SuperSdfError as error:
        check()  # nobody wants it: that is its own error
        return Failed(error)


def work_at_ranges(task: RangesTask, check: CheckWanted) -> list[Any]:
    """Return what the function makes of each range."""
    found = []
    for first, last, *more in task.ranges:
        check()
        found.append(task.work(task.samples[first:last], *more))
    return found


def mesh_brick(network: Network, limits: Limits, task: MeshTask, check: CheckWanted) -> Meshed:
    """Return the mesh of a brick."""
    give_back()
    options = task.options
    pieces = reconstruct_planes(
        task.grid,
        network,
        options.factor,
        task.planes,
        whole=task.whole,
        offset=options.offset,
        cap=options.cap,
        mesher=options.mesher,
        max_memory=limits.memory,
        progress=lambda done, total: check(),
    )
    made = list(pieces)
    worker = f"{socket.gethostname()}:{os.getpid()}"
    return Meshed(made, worker, held_memory(peak=True), limits.memory)
