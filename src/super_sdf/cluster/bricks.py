"""Converting one huge grid on the workers of a cluster, to the mesh file of one machine.

Everything that grows with the grid is done by the workers, in bricks of planes: the evidence of
what the values are, the survey of the band, and the meshes. Here results are put together in the
order of the planes, so they are those of one machine, and the meshes are joined.
"""

from __future__ import annotations

import os
import secrets
import socket
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..convert import Conversion, convert_grid
from ..errors import ClusterError, OptionError, SuperSdfError
from ..files.formats import split_member
from ..files.volume import PLACE
from ..grid.cubic import check_has_offsets
from ..grid.planes import Ranges, Result, SamplePlanes
from ..grid.sdf_grid import SdfGrid, make_grid
from ..machine.memory import give_back, held_memory, memory_bound
from ..batch.pool import Death
from ..threads import Resources, check_count
from ..surface.mesh import vertex_type
from ..network.network import Network, load_network
from ..options import ConvertOptions
from ..pipeline import reconstruct_planes
from ..progress import TOTAL, Progress, Stopwatch
from ..slabs.cutting import check_crossings, equal_parts
from ..slabs.preparing import Piece
from ..refine.band import BandSummary
from ..surface.cap import check_all_seen
from ..refine.survey import BYTES_PER_VOXEL, Glance, look_at_band, no_surface
from .checking import Needs
from .connecting import Cluster
from .crew import CheckWanted, Crew
from .stored import WAY_OUT, Source, Store, StoredPlanes, check_source, close_stores, opened

PASS_BRICKS, MESH_BRICKS = 4, 2  # for each worker: one that dies costs little
BAND_SHARE, MESH_SHARE = 0.25, 0.125  # of a worker's memory, for the band of a brick, for its mesh
BYTES_PER_TRIANGLE = 18  # with its half of a vertex
LOOKED = 0.1  # share of the time until the bricks are cut


class RangesTask(NamedTuple):
    """A function, and the ranges of planes of which it is called with the samples."""

    samples: SamplePlanes
    work: Callable[..., Any]
    ranges: Ranges

    @property
    def planes(self) -> tuple[int, int]:
        """The first plane, and that after the last."""
        return self.ranges[0][0], self.ranges[-1][1]


class MeshTask(NamedTuple):
    """A brick to mesh: the planes of a grid whose whole band is known; options as in a file."""

    grid: SdfGrid
    planes: tuple[int, int]
    whole: BandSummary
    options: ConvertOptions


@dataclass(eq=False)
class Meshed:
    """The mesh of a brick: the pieces of its slabs, in which vertices are counted from its first.

    The ``worker`` is machine and number of the process that made it; ``peak`` and ``bound`` are the
    bytes that it has held at most so far, and that it might hold.
    """

    pieces: list[Piece]
    worker: str
    peak: int | None
    bound: int | None


@dataclass(eq=False)
class BrickWork:
    """What works at bricks, in a worker."""

    source: Source
    needs: Needs
    limits: Resources

    def __call__(self, task: RangesTask | MeshTask, check: CheckWanted) -> Any:
        """Return the result of each range of planes, or the mesh of a brick."""
        opened(self.source).bound = self.limits.memory
        if isinstance(task, MeshTask):
            return self.mesh(task, check)
        results = []
        for first, last, *more in task.ranges:
            check()
            results.append(task.work(task.samples[first:last], *more))
        return results

    @cached_property
    def network(self) -> Network:
        """The network, loaded for the first mesh."""
        needs, threads = self.needs, self.limits.threads
        return load_network(
            needs.model, device=needs.device, threads=threads, precision=needs.precision
        )

    def mesh(self, task: MeshTask, check: CheckWanted) -> Meshed:
        """Return the mesh of a brick."""
        give_back()
        pieces = reconstruct_planes(
            task.grid,
            self.network,
            task.options.factor,
            task.planes,
            whole=task.whole,
            offset=task.options.offset,
            cap=task.options.cap,
            mesher=task.options.mesher,
            max_memory=self.limits.memory,
            progress=lambda done, total: check(),
        )
        made, worker = list(pieces), f"{socket.gethostname()}:{os.getpid()}"
        return Meshed(made, worker, held_memory(peak=True), self.limits.memory)


class ClusterPlanes(StoredPlanes):
    """The samples of a store as the workers of a cluster see them; here, none is read."""

    def __init__(self, source: Source, store: Store, crew: Crew) -> None:
        super().__init__(source, store.shape, store.dtype)
        self.crew = crew
        planes = -(-self.shape[0] // (PASS_BRICKS * max(len(crew.members), 1)))
        self.brick = -(-planes // store.layer) * store.layer  # whole layers

    def read(self, first: int, last: int) -> Any:
        """Raise ClusterError: what reads planes here needs the whole grid."""
        raise ClusterError(
            f"{self.name} has unknown samples (NaN, or numbers that may stand for them), labels, "
            "none inside, or not the label that is asked for: to look into that takes the whole "
            "grid, so convert it on one machine (without --cluster)"
        )

    @property
    def block(self) -> int:
        """Planes that are read at a time when iterating over all: no more than a brick."""
        return min(super().block, self.brick)

    def over(
        self, samples: SamplePlanes, work: Callable[..., Result], ranges: Ranges
    ) -> Iterator[Result]:
        """Yield what a function makes of ranges of ``samples``, in order, made by the workers."""
        bricks = groupby(ranges, lambda planes: sum(planes[:2]) // 2 // self.brick)
        tasks = [RangesTask(samples, work, tuple(group)) for _, group in bricks]
        for results in _in_order(self.crew, tasks):
            yield from results


def _in_order(crew: Crew, tasks: list[Any]) -> Iterator[Any]:
    """Yield the results of tasks; ClusterError if workers died of one."""
    for task, result in zip(tasks, crew.in_order(tasks)):
        if isinstance(result, Death):
            first, last = task.planes
            raise ClusterError(
                f"the work on planes {first} to {last - 1} {result.cause}: see the logs of the "
                "workers, or give less memory (--max-memory)"
            )
        yield result
        del result  # before the next one is taken


def check_can_brick(source: str, options: ConvertOptions, save_field: Any = None) -> None:
    """Raise OptionError if a grid cannot be converted brick by brick with some options."""
    check_source(Source(source, options.axes))
    if options.space is not None:
        raise OptionError(
            f"space is {options.space}: {source} states neither RAS nor LPS, leave it out"
        )
    if save_field is not None:
        raise OptionError(f"--save-field writes one file from the first plane on: {WAY_OUT}")


def convert_on_cluster(
    source: str | Path,
    target: str | Path,
    cluster: Cluster,
    needs: Needs,
    options: ConvertOptions,
    *,
    force: bool = False,
    progress: Progress | None = None,
) -> Conversion:
    """Convert a grid file to a mesh file on the workers of a cluster; see ``convert``.

    ``needs`` name the network; ``announce`` also gets sentences about workers, while the work goes
    on. ClusterError if a worker lacks something, such as the file, or the cluster is lost;
    OptionError if the values need the whole grid at once.
    """
    watch, told = Stopwatch(), dict[str, None]()

    def warn(text: str) -> None:
        told[text] = None
        if announce:
            announce(text)

    file, member = split_member(Path(source))
    path = f"{file.absolute()}" + (f":{member}" if member is not None else "")
    placed = Source(path, options.axes, options.direction is not None, secrets.token_hex(8))
    modules = () if placed.is_npy else ("zarr",)
    needs = replace(needs, modules=modules, files=(file.absolute(),))
    opened(placed)  # what cannot be read is said before the workers are checked
    with Crew(cluster, needs, partial(BrickWork, placed, needs), warn) as crew:
        bricks = _Bricks(crew, _read_stored(placed, crew, options), options)
        try:
            done = convert_grid(
                bricks.grid,
                source,
                target,
                bricks.pieces,
                options,
                force=force,
                progress=progress,
                watch=watch,
            )
        finally:
            with suppress(SuperSdfError):  # the connection may be lost
                if not cluster.is_local:
                    cluster.run(close_stores, workers=list(crew.members))
    workers = [{"process": name, **bricks.workers[name]} for name in sorted(bricks.workers)]
    engine = {"bricks": bricks.count, "workers": workers}
    return replace(done, warnings=(*done.warnings, *told), engine=engine)


def _read_stored(source: Source, crew: Crew, options: ConvertOptions) -> SdfGrid:
    """Return the grid in a file, whose samples the workers read."""
    store = opened(source)
    given = {name: getattr(options, name) for name in PLACE}
    place, notes = store.place(given)
    close_stores()
    grid = make_grid(
        ClusterPlanes(source, store, crew),
        **place,
        **options.values(),
    )
    _check_is_local(grid)
    check_has_offsets(grid, options.offset)
    check_all_seen(grid, WAY_OUT)
    return grid.noted(notes)


class _Bricks:
    """The mesh of a grid, made by the workers; ``workers`` has the most that each has held."""

    def __init__(self, crew: Crew, grid: SdfGrid, options: ConvertOptions) -> None:
        self.crew, self.grid, self.options = crew, grid, options
        self.count = 0
        self.workers: dict[str, dict[str, int | None]] = {}

    def pieces(self, progress: Progress | None) -> Iterator[Piece]:
        """Yield the mesh brick by brick, in order; see ``reconstruct_slabs``."""
        watch, show = Stopwatch(), progress or (lambda done, total: None)
        seen = look_at_band(self.grid, self.options.offset)
        tasks = self._tasks(seen)
        self.count = len(tasks)
        watch.lap("band")
        show(round(LOOKED * TOTAL), TOTAL)
        signs: set[bool] = set()
        for number, piece in enumerate(joined(self._meshed(tasks), seen), 1):
            watch.lap("bricks")
            signs |= piece.signs
            show(round(TOTAL * (LOOKED + (1 - LOOKED) * number / len(tasks))), TOTAL)
            piece.seconds.update(watch.seconds)
            watch.seconds = {}
            yield piece
            del piece  # before the next one is taken
            watch.start()  # the time since the yield was the caller's
        if len(signs) < 2:
            raise no_surface(self.grid, self.options.offset)

    def _tasks(self, seen: Glance) -> list[MeshTask]:
        """Cut the grid into bricks with about the same number of decoded voxels.

        GridError without a surface, or if not even float64 resolves the vertices; OptionError if
        the mesh will certainly have too many.
        """
        grid, options = self.grid, self.options
        vertex_type(grid, options.factor)
        if not any(seen.decoded):
            raise no_surface(grid, options.offset)
        check_crossings(seen.crossings, options.factor)
        members = self.crew.members.values()
        bounds = [limits.memory or memory_bound() for limits in members]
        room = min((bound for bound in bounds if bound), default=1 << 32)
        triangles = 2 * options.factor**2 * seen.crossings
        mesh = triangles * BYTES_PER_TRIANGLE / (MESH_SHARE * room)
        band = seen.summary.voxels * BYTES_PER_VOXEL / (BAND_SHARE * room)
        count = max(MESH_BRICKS * len(members), int(mesh) + 1, int(band) + 1)
        before = np.append(0, np.cumsum(seen.decoded))
        parts = equal_parts(before, count)
        return [MeshTask(grid, planes, seen.summary, options) for planes in parts]

    def _meshed(self, tasks: list[MeshTask]) -> Iterator[Meshed]:
        for made in _in_order(self.crew, tasks):
            self.workers[made.worker] = {"peak_bytes": made.peak, "max_memory": made.bound}
            yield made
            del made  # before the next one is taken


def _check_is_local(grid: SdfGrid) -> None:
    """Raise OptionError if the mesh of some planes depends on more than the planes beside them."""
    if grid.field.smooth is not None:
        raise OptionError(
            f"the values are taken as {grid.field.kind}, and their spline goes through the whole "
            f"grid at once: {WAY_OUT}; or give --field exact, if they are distances"
        )
    if not (grid.is_cubic or grid.field.on_lattice):
        each = ", ".join(f"{h:g}" for h in grid.spacing)
        raise OptionError(
            f"the spacing {each} differs between axes, and the whole grid is resampled for that: "
            f"{WAY_OUT}"
        )


def joined(bricks: Iterable[Meshed], seen: Glance) -> Iterator[Piece]:
    """Yield each brick as one piece of the mesh: vertices numbered, counts added up."""
    vertices = slabs = 0
    whole = {"band_voxels": seen.summary.voxels, "noisy_voxels": seen.summary.noisy}
    for made in bricks:
        parts = made.pieces
        meshes = [mesh for part in parts for mesh in part.meshes]
        counts = {name: sum(part.counts[name] for part in parts) for name in parts[0].counts}
        check_count(vertices + counts["vertices"], "vertices")
        for mesh in meshes:
            np.add(mesh.faces, np.int32(vertices), out=mesh.faces)
        vertices, slabs = vertices + counts["vertices"], slabs + len(parts)
        planned = max(part.whole["planned_bytes"] for part in parts)
        yield Piece(
            meshes,
            counts,
            {**whole, "slabs": slabs, "planned_bytes": planned},
            (parts[0].planes[0], parts[-1].planes[1]),
            leaves=seen.summary.leaves,
            is_cut=any(part.is_cut for part in parts),
            signs=set().union(*(part.signs for part in parts)),
            worker=made.worker,
        )
        del made, parts, meshes  # before the next one is taken
