"""Converting one huge grid on the workers of a cluster, to the mesh file of one machine.

Everything that grows with the grid is done by the workers, in bricks of planes: the evidence of
what the values are, the survey of the band, and the meshes. Here results are put together in the
order of the planes, so they are those of one machine, and the meshes are joined.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..cluster.checking import Needs, check_workers
from ..cluster.connecting import Cluster
from ..convert import Conversion, ConvertOptions, convert_grid
from ..errors import OptionError, SuperSdfError
from ..files.expectation import Expectation
from ..files.formats import split_member
from ..grid.cubic import check_has_offsets
from ..grid.sdf_grid import SdfGrid, make_grid
from ..machine.index_width import check_count
from ..machine.memory import memory_bound
from ..mesh import vertex_type
from ..progress import TOTAL, Progress, Stopwatch
from ..slabs.cutting import check_crossings, equal_parts
from ..slabs.pieces import Piece
from ..steps.ends import check_all_seen
from ..steps.glance import Glance, look_at_band
from ..steps.survey import BYTES_PER_VOXEL, no_surface
from .meshing import Loading, Meshed, MeshTask, prepare_meshing
from .passes import Brick, Team, TeamPlanes
from .stored import WAY_OUT, Source, check_source, close_stores, opened

LEAST_PER_WORKER = 2  # bricks to mesh, so that a worker that dies does not cost much
BAND_SHARE, MESH_SHARE = 0.25, 0.125  # of a worker's memory, for the band of a brick, for its mesh
BYTES_PER_TRIANGLE = 18  # with its half of a vertex
LOOKED = 0.1  # share of the time until the bricks are cut


def check_can_brick(source: str, options: ConvertOptions, save_field: Any = None) -> None:
    """Raise OptionError if a grid cannot be converted brick by brick with some options.

    Called before anything is started.
    """
    check_source(Source(source, options.axes))
    if options.iterations > 1:
        raise OptionError(
            f"--iterations {options.iterations} refines the field of the whole grid again: "
            f"{WAY_OUT}"
        )
    if save_field is not None:
        raise OptionError(f"--save-field writes one file from the first plane on: {WAY_OUT}")


def convert_on_cluster(
    source: str | Path,
    target: str | Path,
    cluster: Cluster,
    loading: Loading,
    options: ConvertOptions,
    *,
    force: bool = False,
    progress: Progress | None = None,
    announce: Callable[[str], None] | None = None,
) -> Conversion:
    """Convert a grid file to a mesh file on the workers of a cluster; see ``convert``."""
    watch = Stopwatch()
    with closing(BricksEngine(cluster, loading, announce or (lambda text: None))) as engine:
        grid = engine.read(source, options)
        check_all_seen(grid, "convert it on one machine (without --cluster)")

        def make(expected: Expectation, shown: Progress | None) -> Iterator[Piece]:
            return engine.pieces(grid, options, expected, shown)

        done = convert_grid(
            grid,
            source,
            target,
            make,
            options,
            force=force,
            progress=progress,
            announce=announce,
            watch=watch,
        )
        warnings = (*done.warnings, *engine.warnings())
        return replace(done, warnings=warnings, engine=engine.report())


@dataclass
class BricksEngine:
    """The workers of a cluster, which read a grid and make its mesh.

    Attributes
    ----------
    cluster : Cluster
        The connection.
    loading : Loading
        How each worker loads its network.
    warn : callable
        Called with sentences about workers, while the work goes on.
    """

    cluster: Cluster
    loading: Loading
    warn: Callable[[str], None] = lambda text: None
    team: Team = field(init=False)
    source: Source = field(init=False)
    told: list[str] = field(default_factory=list)
    bricks: int = 0
    workers: dict[str, Meshed] = field(default_factory=dict)

    def read(self, source: str | Path, options: ConvertOptions) -> SdfGrid:
        """Return the grid in a file, whose samples the workers read.

        Raises
        ------
        ClusterError
            If a worker lacks something, such as the file.
        SuperSdfError
            As in ``read_grid``; OptionError if the values need the whole grid at once.
        """
        self.source = absolute(str(source), options)
        given = {name: getattr(options, name) for name in ("spacing", "origin", "direction")}
        facts = opened(self.source).facts(given)
        close_stores()
        self.team = self._team()
        grid = make_grid(
            TeamPlanes(self.source, facts, self.team),
            **facts.place,
            **options.values(),
        )
        check_is_local(grid)
        check_has_offsets(grid, options.offset)
        return grid.noted(facts.notes)

    def _team(self) -> Team:
        """Check the workers; return them."""
        file, _ = split_member(self.source.path)
        modules = () if self.source.is_npy else ("zarr",)
        needs = Needs(*self.loading, modules, (file,))
        checked = check_workers(self.cluster, needs)
        self.told += checked.warnings
        return Team(self.cluster, checked, needs, self._warn)

    def _warn(self, text: str) -> None:
        self.told.append(text)
        self.warn(text)

    def close(self) -> None:
        """Let the workers close the store, and free what they have unpacked of it."""
        with suppress(SuperSdfError):  # the connection may be lost
            if not self.cluster.is_local:
                self.cluster.run(close_stores, workers=list(self.cluster.workers()))

    def warnings(self) -> tuple[str, ...]:
        """Return sentences on workers."""
        return tuple(dict.fromkeys(self.told))

    def report(self) -> dict[str, Any]:
        """Return bricks and workers, with the most memory that each has held, in bytes."""
        workers = [
            {"process": process, "peak_bytes": last.peak, "max_memory": last.bound}
            for process, last in sorted(self.workers.items())
        ]
        return {"bricks": self.bricks, "workers": workers}

    def pieces(
        self,
        grid: SdfGrid,
        options: ConvertOptions,
        expected: Expectation,
        progress: Progress | None,
    ) -> Iterator[Piece]:
        """Yield the mesh brick by brick, in order; see ``reconstruct_slabs``."""
        watch, show = Stopwatch(), progress or (lambda done, total: None)
        seen = look_at_band(grid, options.offset)
        tasks = self._tasks(grid, options, expected, seen)
        self.bricks = len(tasks)
        watch.lap("band")
        show(round(LOOKED * TOTAL), TOTAL)
        joining = Joining(seen, keeping_last(self.workers))
        prepare = partial(prepare_meshing, self.source, self.loading)
        for number, made in enumerate(self.team.in_order(tasks, prepare), 1):
            watch.lap("bricks")
            piece = joining.add(made)
            show(round(TOTAL * (LOOKED + (1 - LOOKED) * number / len(tasks))), TOTAL)
            piece.seconds.update(watch.seconds)
            watch.seconds = {}
            del made
            yield piece
            del piece  # before the next one is taken
            watch.start()  # the time since the yield was the caller's
        if len(joining.signs) < 2:
            raise no_surface(grid, options.offset)

    def _tasks(
        self, grid: SdfGrid, options: ConvertOptions, expected: Expectation, seen: Glance
    ) -> list[Brick]:
        """Cut the grid into bricks with about the same number of decoded voxels.

        Raises
        ------
        GridError
            If no voxel can hold a surface, or not even float64 resolves the vertices.
        OptionError
            If the mesh will certainly have too many vertices.
        """
        vertex_type(grid, options.factor)
        if not any(seen.decoded):
            raise no_surface(grid, options.offset)
        check_crossings(seen.crossings, options.factor)
        count = self._count_bricks(expected, seen)
        before = np.append(0, np.cumsum(seen.decoded))
        return [
            Brick(number, *planes, MeshTask(grid, planes, seen.summary, options))
            for number, planes in enumerate(equal_parts(before, count))
        ]

    def _count_bricks(self, expected: Expectation, seen: Glance) -> int:
        """Return how many bricks to cut: some for each worker, more if its memory asks for it."""
        bounds = [m.limits.memory or memory_bound() for m in self.team.checked.members]
        room = min((bound for bound in bounds if bound), default=1 << 32)
        mesh = expected.triangles * BYTES_PER_TRIANGLE / (MESH_SHARE * room)
        band = seen.summary.voxels * BYTES_PER_VOXEL / (BAND_SHARE * room)
        return max(LEAST_PER_WORKER * self.team.size, int(mesh) + 1, int(band) + 1)


def absolute(source: str, options: ConvertOptions) -> Source:
    """Return a grid file by its absolute path."""
    file, member = split_member(Path(source))
    path = str(file.absolute())
    path = path if member is None else f"{path}:{member}"
    return Source(path, options.axes, options.direction is not None, secrets.token_hex(8))


def check_is_local(grid: SdfGrid) -> None:
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


class Joining:
    """Puts the meshes of bricks together: numbers vertices, adds up counts.

    Parameters
    ----------
    seen : Glance
        The band of the whole grid.
    workers : dict
        Gets the last result of each worker, without the mesh.
    """

    def __init__(self, seen: Glance, workers: Callable[[Meshed], None]) -> None:
        self.seen, self.note = seen, workers
        self.vertices = self.slabs = 0
        self.signs: set[bool] = set()

    def add(self, made: Meshed) -> Piece:
        """Return a brick as one piece of the mesh, its vertices numbered after those before."""
        self.note(made)
        summary, parts = self.seen.summary, made.pieces
        meshes = [mesh for part in parts for mesh in part.meshes]
        counts = {name: sum(part.counts[name] for part in parts) for name in parts[0].counts}
        check_count(self.vertices + counts["vertices"], "vertices")
        for mesh in meshes:
            np.add(mesh.faces, np.int32(self.vertices), out=mesh.faces)
        self.vertices += counts["vertices"]
        self.slabs += len(parts)
        self.signs.update(*(part.signs for part in parts))
        whole = {
            "band_voxels": summary.voxels,
            "noisy_voxels": summary.noisy,
            "slabs": self.slabs,
            "planned_bytes": max(part.whole["planned_bytes"] for part in parts),
        }
        planes = parts[0].planes[0], parts[-1].planes[1]
        is_cut = any(part.is_cut for part in parts)
        seen = summary.leaves, is_cut, set(self.signs)
        return Piece(meshes, counts, whole, planes, *seen, worker=made.worker)


def keeping_last(workers: dict[str, Meshed]) -> Callable[[Meshed], None]:
    """Return a function that keeps the last result of each worker, without its mesh."""

    def keep(made: Meshed) -> None:
        workers[made.worker] = replace(made, pieces=[])

    return keep
