"""The method on a page: the paper's Section 4, one named step per line.

    grid -> cubic lattice -> band -> patches and neighbour table -> network -> averaged shared nodes
         -> surface moved to touch the samples' spheres -> values kept within the samples' bounds
         -> isosurface

A grid that is too large to be refined at once is refined slab by slab (see ``slabs``); the mesh is
the same.

>>> from super_sdf import make_grid, reconstruct
>>> mesh = reconstruct(make_grid(values, spacing=0.1))            # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from .arrays import FloatArray, IntArray
from .errors import OptionError
from .grid.cubic import cubic_grid
from .grid.field import MASK
from .grid.planes import SampleArray
from .grid.sdf_grid import SdfGrid, check_grid
from .machine.memory import give_back
from .machine.resources import Resources, allot
from .mesh import Mesh, join_meshes, vertex_type
from .neighbourhood import CENTRE
from .network.decoder import Decoder, decode
from .network.kinds import network_for
from .options import (
    DEFAULT_MESHER,
    check_cap,
    check_distance,
    check_factor,
    check_iterations,
    check_max_memory,
    check_network,
    check_progress,
)
from .progress import STEPS, Progress, StepCounter, Stopwatch, part_of
from .slabs.cutting import DEFAULT, Slab, peak_bytes, plan_slabs, planes_needed, refuse_band
from .slabs.footprint import NETWORK_BYTES
from .slabs.pieces import Piece, count_input, describe_piece
from .steps.bounds import keep_within_bounds
from .steps.cap import close
from .steps.debris import count_between, drop_debris
from .steps.ends import check_all_seen, check_can_close, seen_octants
from .steps.exact import BandSummary
from .steps.field import FineField, SampleSpheres
from .steps.foot_points import spheres_of_band
from .steps.holding import hold_sides
from .steps.lattice import fine_grid
from .steps.meshers import Mesher, extract_pieces, find_mesher
from .steps.nodes import (
    average_shared,
    block_offsets,
    pin_to_skipped,
    share_parts,
    signs_of_skipped,
)
from .steps.spheres import fit_to_spheres
from .steps.spline import spline_blocks
from .steps.survey import Band, BandTooLargeError, no_surface, survey
from .steps.voxel_index import VoxelIndex

SaveField = Callable[[FineField], None]
"""Called with the field of each slab, in order, before its surface is extracted."""


def upsample(
    grid: SdfGrid,
    network: Decoder,
    factor: int = 4,
    *,
    offset: float = 0.0,
    max_memory: int | None = None,
    progress: Progress | None = None,
) -> FineField:
    """Refine a coarse grid near its surface, all at once.

    Parameters
    ----------
    grid : SdfGrid
        Coarse signed distances in world units, negative inside. If the spacing differs between
        axes, they are resampled to the finest first; the field has that spacing.
    network : Network
        From ``load_network``.
    factor : int
        How many times finer per axis, K: an even number from 2 to 16.
    offset : float
        Refine the surface at this distance from the solid (world units) instead of the solid's own
        (Sec. 5.3). Positive is outwards, whichever sign the input had inside, since ``grid.values``
        are always negative inside. The distances must reach 1.5 spacings beyond the offset.
    max_memory : int, optional
        Bytes that the process may hold in all; by default a share of the free memory.
    progress : callable, optional
        Called with (done, total), see ``progress.Progress``; an exception in it ends the work.

    Returns
    -------
    FineField
        Values at the nodes of spacing h/K in every voxel that can hold the surface.

    Raises
    ------
    OptionError
        If the factor is odd or out of range, or another argument is invalid.
    OutOfMemoryError
        If the fine values would not fit in memory.
    ModelError
        If the network returns values that are not finite.
    GridError
        If the distances end within 1.5 spacings of the offset; if the grid is so far from the
        origin that floating-point numbers cannot resolve its vertices; if there is no surface. The
        last is raised only at the end, since a thin part may lie between samples that are all
        outside.
    """
    check_grid(grid)
    check_network(network)
    check_progress(progress)
    factor, offset = check_factor(factor), check_distance(offset)
    network = network_for(network, grid.field.kind)
    resources = allot(getattr(network, "threads", 0), check_max_memory(max_memory))
    steps = StepCounter(progress, [name for name in STEPS if name != "isosurface"])
    lattice = cubic_grid(grid, offset)
    needs = factor, None, resources, memory_needs(network)
    band = find_surface(lattice, offset, *needs)
    (slab,) = plan_slabs(band, *needs)
    steps.finish("band")
    field = refine(band, network, factor, slab, resources.threads, steps)
    if len(field.signs()) < 2:
        raise no_surface(grid, offset)
    return replace(field, grid=lattice, offset=offset)


def reconstruct(
    grid: SdfGrid,
    network: Decoder | None = None,
    factor: int = 4,
    *,
    offset: float = 0.0,
    cap: bool = False,
    mesher: str = DEFAULT_MESHER,
    iterations: int = 1,
    max_memory: int | None = None,
    progress: Progress | None = None,
) -> Mesh:
    """Turn a coarse grid into a fine mesh.

    Parameters and errors are those of ``upsample``, except for these:

    Parameters
    ----------
    network : Network, optional
        By default the shipped network ``base``.
    cap : bool
        Close a surface that leaves the grid along the grid's border, as the command does unless it
        gets ``--open``. By default it is left open there, so that meshes of neighbouring grids can
        be joined. A surface leaves the grid where samples on the border are inside.
    mesher : str
        "marching" for marching cubes, which cuts off edges and corners; "sharp" also puts vertices
        on them.
    iterations : int
        How often to refine by the factor: each run takes the fine lattice of the one before as its
        grid (see ``fine_grid``), which is sparse in memory.
    max_memory : int, optional
        Bytes that the process may hold in all, besides the mesh; by default a share of the free
        memory.

    Returns
    -------
    Mesh
        In world units; closed, unless the surface leaves the grid and ``cap`` is False.
    """
    check_grid(grid)
    if network is None:
        from .network.network import load_network

        network = load_network()
    pieces = reconstruct_slabs(
        grid,
        network,
        factor,
        offset=offset,
        cap=cap,
        mesher=mesher,
        iterations=iterations,
        max_memory=max_memory,
        progress=progress,
    )
    return join_meshes([mesh for piece in pieces for mesh in piece.meshes])


def reconstruct_slabs(
    grid: SdfGrid,
    network: Decoder,
    factor: int = 4,
    *,
    offset: float = 0.0,
    cap: bool = False,
    mesher: str = DEFAULT_MESHER,
    iterations: int = 1,
    max_memory: int | None = None,
    progress: Progress | None = None,
    save: SaveField | None = None,
    look: Callable[[Band], None] | None = None,
) -> Iterator[Piece]:
    """Yield the mesh of ``reconstruct`` slab by slab, in as few slabs as fit in memory.

    Joined, the pieces are the same mesh, bit for bit, for any number of slabs and threads. ``save``
    is called with the field of each slab, final in the slab's own planes and in the one before;
    ``look`` with the band of the grid, but not if there are several iterations.
    """
    check_grid(grid)
    check_network(network)
    check_progress(progress)
    run = Run(
        network,
        check_factor(factor),
        find_mesher(mesher),
        check_cap(cap),
        check_max_memory(max_memory),
        save,
        look if iterations == 1 else None,
    )
    offset = check_distance(offset)
    check_can_close(grid, cap=cap)
    if check_iterations(iterations) > 1:
        check_all_seen(grid, "refine once, by a larger factor (--iterations 1)")
        return _iterated(run, grid, offset, iterations, progress)
    return _slabs(run, grid, offset, progress)


@dataclass(frozen=True)
class Run:
    """The arguments of ``reconstruct_slabs`` that are the same for all grids and iterations."""

    network: Decoder
    factor: int
    mesher: Mesher
    cap: bool
    max_memory: int | None
    save: SaveField | None
    look: Callable[[Band], None] | None = None


def _iterated(
    run: Run, grid: SdfGrid, offset: float, iterations: int, progress: Progress | None
) -> Iterator[Piece]:
    """Yield the pieces of the last of several runs, each on the fine lattice of the one before.

    What is counted of the input, such as its noisy voxels, is that of the first run.
    """
    share = 1 / (1 + run.factor**2)  # of the time, that the runs before the last take
    shown = part_of(progress, 0, share)
    counts: dict[str, int] = {}
    watch = Stopwatch()
    for nth in range(iterations - 1):
        field = upsample(
            grid,
            run.network,
            run.factor,
            offset=offset,
            max_memory=run.max_memory,
            progress=None if nth else shown,
        )
        counts = counts or count_input(field)
        grid, offset = fine_grid(field), 0.0
    watch.lap("runs before")
    spent, pinned = watch.seconds, counts.pop("pinned_nodes")
    for piece in _slabs(run, grid, offset, part_of(progress, share, 1)):
        piece.whole.update(counts)
        piece.counts["pinned_nodes"], pinned = pinned, 0
        piece.seconds.update(spent)
        spent = {}
        yield piece
        del piece  # before the next one is made


def _slabs(run: Run, grid: SdfGrid, offset: float, progress: Progress | None) -> Iterator[Piece]:
    """Yield the pieces of one run; its arguments have been checked."""
    network, factor, mesher = network_for(run.network, grid.field.kind), run.factor, run.mesher
    resources = allot(getattr(network, "threads", 0), run.max_memory)
    steps = StepCounter(progress)
    lattice = cubic_grid(grid, offset)
    reach, needed = getattr(network, "receptive_field", None), memory_needs(network)
    band = find_surface(lattice, offset, factor, reach, resources, needed, mesher)
    slabs = plan_slabs(band, factor, reach, resources, needed, mesher)
    planned = peak_bytes(band, slabs, factor, needed, resources.threads, mesher)
    if run.look:
        run.look(band)
    steps.divide(len(slabs))
    steps.finish("band")
    seen: set[bool] = set()
    placed = replace(run, network=network), lattice, offset
    for piece in _mesh_slabs(placed, band, slabs, planned, resources.threads, steps):
        seen |= piece.signs
        yield piece
        del piece  # before the next one is made
    if len(seen) < 2:
        raise no_surface(grid, offset)


def _mesh_slabs(
    placed: tuple[Run, SdfGrid, float],
    band: Band,
    slabs: list[Slab],
    planned: int,
    threads: int,
    steps: StepCounter,
) -> Iterator[Piece]:
    """Yield the piece of each slab of a band: the run, its lattice and offset are ``placed``."""
    run, lattice, offset = placed
    factor, mesher = run.factor, run.mesher
    beside, vertices = mesher.planes_beside(factor), 0
    for slab in slabs:
        if len(slabs) > 1:
            give_back()
        field = refine(band, run.network, factor, slab, threads, steps)
        field = replace(field, grid=lattice, offset=offset)
        if run.save:
            run.save(field)
            steps.watch.lap("save field")
        whole = close(field, cap=run.cap, beside=beside)
        meshes = extract_pieces(whole, lattice, vertices, threads, mesher)
        planned_work = {"slabs": len(slabs), "planned_bytes": planned}
        piece = describe_piece(field, meshes, planned_work, band.leaves)
        del field, whole, meshes  # before those of the next slab are made
        steps.finish("isosurface")
        piece.seconds.update(steps.take_seconds())
        vertices += piece.counts["vertices"]
        yield piece
        del piece  # before the next one is made
        steps.watch.start()  # the time since the yield was the caller's


def reconstruct_planes(
    grid: SdfGrid,
    network: Decoder,
    factor: int,
    planes: tuple[int, int],
    *,
    whole: BandSummary,
    offset: float = 0.0,
    cap: bool = False,
    mesher: str = DEFAULT_MESHER,
    max_memory: int | None = None,
    progress: Progress | None = None,
) -> Iterator[Piece]:
    """Yield the pieces of ``reconstruct_slabs`` in some planes; it is a brick of a huge grid.

    Only these planes are read, and those beside them on which the mesh depends. The pieces of all
    bricks, in order, are the same mesh, bit for bit. Vertices are counted from the first of the
    brick: those of the brick before have numbers below 0.

    Parameters
    ----------
    planes : two ints
        The first plane of the brick, and that after its last.
    whole : BandSummary
        Of the band of the whole grid, see ``look_at_band``.

    Raises
    ------
    OptionError
        If the network states no receptive field, so that it has to see the whole grid.
    OutOfMemoryError
        If not even a plane of the brick fits in memory.
    """
    mesh_with = find_mesher(mesher)
    run = Run(network, check_factor(factor), mesh_with, check_cap(cap), max_memory, None)
    reach = receptive_field_for(network, grid)
    network, needed = network_for(network, grid.field.kind), memory_needs(network)
    resources = allot(getattr(network, "threads", 0), max_memory)
    steps = StepCounter(progress)
    lattice = cubic_grid(grid, offset)
    more = planes_needed(reach, mesh_with, factor)
    among = max(planes[0] - more, 0), min(planes[1] + more, grid.shape[0])
    band = survey(lattice, offset, resources, among, whole)
    slabs = plan_slabs(band, factor, reach, resources, needed, mesh_with, planes)
    planned = peak_bytes(band, slabs, factor, needed, resources.threads, mesh_with)
    steps.divide(len(slabs))
    steps.finish("band")
    own = band.rows(*planes)
    counts = {"band_voxels": own.stop - own.start, "noisy_voxels": band.count_noisy(own)}
    placed = replace(run, network=network), lattice, offset
    for piece in _mesh_slabs(placed, band, slabs, planned, resources.threads, steps):
        piece.whole.update(counts)
        yield piece
        del piece  # before the next one is made


def receptive_field_for(network: Decoder, grid: SdfGrid) -> int:
    """Return the receptive field of the network for a grid.

    Raises
    ------
    OptionError
        If it states none.
    """
    reach: int | None = getattr(network_for(network, grid.field.kind), "receptive_field", None)
    if reach is None:
        raise OptionError(
            "the network states no receptive field, so it has to see the whole grid at once: "
            "convert the grid on one machine"
        )
    return reach


def memory_needs(network: Decoder) -> tuple[float, float]:
    """Return the memory of a network in bytes, per voxel that it sees and per value."""
    needed: tuple[float, float] = getattr(network, "memory_bytes", NETWORK_BYTES)
    return needed


def find_surface(
    grid: SdfGrid,
    offset: float,
    factor: int,
    receptive_field: int | None,
    resources: Resources,
    network_bytes: tuple[float, float],
    mesher: Mesher = DEFAULT,
) -> Band:
    """Return the band of a grid; GridError if no voxel can hold a surface.

    The parameters are those of ``plan_slabs``, for what is said if it does not fit in memory.
    """
    vertex_type(grid, factor)  # raises if not even float64 resolves the vertices
    band = None
    with suppress(BandTooLargeError):  # and free what it holds
        band = survey(grid, offset, resources)  # Eqs. 2 and 4
    if band is None:
        plan = factor, receptive_field, resources, network_bytes, mesher
        raise refuse_band(grid, offset, *plan)
    if not band.decoded.any():
        raise no_surface(grid, offset)
    return band


def refine(
    band: Band,
    network: Decoder,
    factor: int,
    slab: Slab,
    threads: int = 1,
    steps: StepCounter | None = None,
) -> FineField:
    """Return the fine field of a slab: the steps from the network to the final values."""
    steps = steps or StepCounter()
    patches, table, voxels = inputs = band.network_inputs(slab.seen, slab.decoded)
    progress = steps.within("network")
    if band.smooth is None:
        blocks = decode(network, inputs, block_offsets(factor), progress, threads)  # Eqs. 3, 5
    else:
        blocks = interpolate(band, band.smooth, network, factor, slab, inputs, threads)
    steps.finish("network")

    parts = share_parts(rows_among(voxels, len(table))[table[voxels]])
    average_shared(blocks, parts, factor, threads)  # Eq. 7
    seen_ijk, exact = band.voxel_ijk[slab.seen], np.flatnonzero(band.exact[slab.seen])
    own_ijk = seen_ijk[voxels]
    spheres = spheres_of_band(seen_ijk, patches, exact, band.shape, band.limits, threads)
    index = VoxelIndex(own_ijk, band.shape)
    fit_to_spheres(blocks, parts, factor, spheres, index, threads)
    del spheres
    keep_within_bounds(blocks, parts, factor, own_ijk, band.trusted, threads)
    if band.kind == MASK:
        hold_sides(blocks, factor, patches, voxels)
    skipped = signs_of_skipped(parts, own_ijk, patches, voxels, band.shape)
    pinned = pin_to_skipped(blocks[:, :-1], parts, factor, skipped)
    touching = SampleSpheres(band.shape, seen_ijk[exact], patches[exact, CENTRE].copy())
    dropped, lone = drop_debris(blocks, factor, parts, index, touching)
    steps.finish("nodes")
    field = FineField(band.shape, factor, own_ijk, blocks[:, :-1], parts, slab.planes)
    return replace(
        field,
        band_voxels=len(band.voxel_ijk),
        noisy_voxels=band.noisy_voxels,
        pinned=int(pinned[field.own_rows].sum()),
        dropped=count_between(dropped, slab.planes),
        lone=count_between(lone, slab.planes),
        spheres=touching,
        decoded_voxels=int(band.decoded_before[-1]),
        leaves=band.leaves,
        octants=None if band.unseen is None else seen_octants(band.unseen, own_ijk),
    )


def interpolate(
    band: Band,
    smooth: SampleArray,
    network: Decoder,
    factor: int,
    slab: Slab,
    inputs: tuple[FloatArray, IntArray, IntArray],
    threads: int = 1,
) -> FloatArray:
    """Return the blocks of a field that is no distance: its spline, and the network at kinks.

    Of a field that is far from a distance, or was cut off, the network adds nothing.
    """
    patches, table, voxels = inputs
    own_ijk = band.voxel_ijk[slab.seen][voxels]
    blocks, share = spline_blocks(smooth, own_ijk, factor, band.half_voxel, uneven=band.is_uneven)
    blocks[:, :-1] -= np.float32(band.level)
    some = np.flatnonzero(share)
    if band.has_kinks and len(some):
        kinked = patches, table, voxels[some]
        added = decode(network, kinked, block_offsets(factor), None, threads)[:, :-1]
        blocks[:, some] += share[some] * (added - blocks[:, some])
    return blocks


def rows_among(voxels: IntArray, count: int) -> IntArray:
    """Return the row in ``voxels`` of each of ``count`` voxels, -1 if it is not among them.

    The result, (count + 1,) int32, has one more -1 at the end, for the index -1 of absent
    neighbours.
    """
    row_of = np.full(count + 1, -1, np.int32)
    row_of[voxels] = np.arange(len(voxels), dtype=np.int32)
    return row_of
