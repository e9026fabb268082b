"""The method on a page: the paper's Section 4, one named step per line of ``refine``.

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
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from . import options
from .functions.function import Function, as_function, sampled
from .grid.sdf_grid import SdfGrid, check_grid
from .machine.memory import give_back
from .surface.mesh import Mesh, join_meshes
from .network.neighbourhood import CENTRE
from .network.decoder import Decoder, decode
from .network.network import given_or_loaded
from .progress import STEPS, Progress, StepCounter
from .slabs.cutting import Slab
from .slabs.preparing import Piece, Run, describe_piece, prepare
from .refine import nodes
from .refine.band import BandSummary
from .refine.bounds import keep_within_bounds
from .surface.cap import check_can_close, seen_octants
from .refine.debris import count_between, drop_debris
from .refine.field import FineField, SampleSpheres
from .surface.extract import extract
from .refine.spheres import fit_to_spheres, spheres_of_band
from .refine.spline import interpolate
from .refine.survey import Band, no_surface


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
    seen_ijk, exact = band.voxel_ijk[slab.seen], np.flatnonzero(band.exact[slab.seen])
    own_ijk = seen_ijk[voxels]
    if band.field.smooth is None:
        progress, offsets = steps.within("network"), nodes.block_offsets(factor)
        blocks = decode(network, inputs, offsets, progress, threads)  # Eqs. 3, 5
    else:
        blocks = interpolate(band, network, factor, own_ijk, inputs, threads)
    steps.finish("network")

    parts = nodes.share_parts(nodes.rows_among(voxels, len(table))[table[voxels]])
    index = nodes.VoxelIndex(own_ijk, band.shape)
    nodes.average_shared(blocks, parts, factor, threads)  # Eq. 7
    spheres = spheres_of_band(seen_ijk, patches, exact, band.shape, band.limits, threads)
    fit_to_spheres(blocks, parts, factor, spheres, index, threads)
    del spheres
    keep_within_bounds(blocks, parts, factor, own_ijk, band.trusted, threads)
    if band.field.kind == options.MASK:
        nodes.hold_sides(blocks, factor, patches, voxels)
    skipped = nodes.signs_of_skipped(parts, own_ijk, patches, voxels, band.shape)
    pinned = nodes.pin_to_skipped(blocks[:, :-1], parts, factor, skipped)
    touching = SampleSpheres(band.shape, seen_ijk[exact], patches[exact, CENTRE].copy())
    dropped, lone = drop_debris(blocks, factor, parts, index, touching)
    steps.finish("nodes")
    field = FineField(band.shape, factor, own_ijk, blocks[:, :-1], parts, slab.planes)
    return replace(
        field,
        band_voxels=len(band.voxel_ijk),
        noisy_voxels=band.count_noisy(),
        pinned=int(pinned[field.own_rows].sum()),
        dropped=count_between(dropped, slab.planes),
        lone=count_between(lone, slab.planes),
        spheres=touching,
        decoded_voxels=int(band.decoded_before[-1]),
        leaves=band.leaves,
        octants=None if band.field.unseen is None else seen_octants(band.field.unseen, own_ijk),
    )


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
    options.check_network(network)
    options.check_progress(progress)
    factor, offset = options.check_factor(factor), options.check_distance(offset)
    steps = StepCounter(progress, [name for name in STEPS if name != "isosurface"])
    run = prepare(
        grid, network, factor, offset, options.check_max_memory(max_memory), steps, at_once=True
    )
    field = refine(run.band, run.network, factor, run.slabs[0], run.threads, steps)
    if len(field.signs()) < 2:
        raise no_surface(grid, offset)
    return replace(field, grid=run.lattice, offset=offset)


def reconstruct(
    grid: SdfGrid | None = None,
    network: Decoder | None = None,
    factor: int = 4,
    *,
    function: Function | None = None,
    bounds: ArrayLike | None = None,
    spacing: ArrayLike | None = None,
    quality: options.Quality | str | Path | None = None,
    offset: float = 0.0,
    cap: bool = True,
    mesher: options.MesherName = options.DEFAULT_MESHER,
    max_memory: int | None = None,
    progress: Progress | None = None,
    device: options.Device | None = None,
    precision: options.Precision | None = None,
    threads: int | None = None,
) -> Mesh:
    """Turn a coarse grid, or a function, into a fine mesh.

    Parameters and errors are those of ``upsample``, except for these:

    Parameters
    ----------
    grid : SdfGrid, optional
        Coarse signed distances. Without a grid the function is sampled.
    network : Network, optional
        From ``load_network``, to load it once for many grids.
    function : callable or DistanceFunction, optional
        What the grid has samples of; vertices are then put where it is 0. See
        ``DistanceFunction``.
    bounds, spacing : optional
        The box and the distance of the samples, without a grid; see ``DistanceFunction.sample``.
    quality : str or path, optional
        Without a network: "fast", "base" (default) or "best", or an ONNX file.
    device, precision, threads : optional
        Without a network, where it runs: see ``load_network``.
    cap : bool
        Close a surface that leaves the grid along the grid's border. Left open there, meshes of
        neighbouring grids can be joined. A surface leaves the grid where samples on the border are
        inside.
    mesher : str
        "marching" for marching cubes, which cuts off edges and corners; "sharp" also puts vertices
        on them; "auto" is "sharp" for distances and "marching" for masks and noise.
    max_memory : int, optional
        Bytes that the process may hold in all, besides the mesh; by default a share of the free
        memory.

    Returns
    -------
    Mesh
        In world units; closed, unless the surface leaves the grid and ``cap`` is False.

    Raises
    ------
    OptionError
        If there is a network, and besides what would load one.
    """
    exact = None if function is None else as_function(function)
    grid = sampled(grid, exact, bounds, spacing, options.check_distance(offset))
    network = given_or_loaded(network, quality, device=device, precision=precision, threads=threads)
    pieces = reconstruct_slabs(
        grid,
        network,
        factor,
        offset=offset,
        cap=cap,
        mesher=mesher,
        max_memory=max_memory,
        progress=progress,
    )
    mesh = join_meshes([mesh for piece in pieces for mesh in piece.meshes])
    if exact is None:
        return mesh
    from .functions.zero import put_on_zero  # imported here, as few call it

    return put_on_zero(mesh, exact, grid, factor, offset)


def reconstruct_slabs(
    grid: SdfGrid,
    network: Decoder,
    factor: int = 4,
    *,
    offset: float = 0.0,
    cap: bool = True,
    mesher: options.MesherName = options.DEFAULT_MESHER,
    max_memory: int | None = None,
    progress: Progress | None = None,
    save: Callable[[FineField], None] | None = None,
    look: Callable[[Band], None] | None = None,
) -> Iterator[Piece]:
    """Yield the mesh of ``reconstruct`` slab by slab, in as few slabs as fit in memory.

    Joined, the pieces are the same mesh, bit for bit, for any number of slabs and threads. ``save``
    is called with the field of each slab, final in the slab's own planes and in the one before;
    ``look`` with the band of the grid.
    """
    check_grid(grid)
    options.check_network(network)
    options.check_progress(progress)
    factor, offset, cap = (
        options.check_factor(factor),
        options.check_distance(offset),
        options.check_cap(cap),
    )
    mesher, bound = options.check_mesher(mesher), options.check_max_memory(max_memory)
    check_can_close(grid, cap=cap)

    def pieces() -> Iterator[Piece]:
        run = prepare(grid, network, factor, offset, bound, StepCounter(progress), mesher)
        if look:
            look(run.band)
        seen: set[bool] = set()
        for piece in _mesh_slabs(run, cap, save):
            seen |= piece.signs
            yield piece
            del piece  # before the next one is made
        if len(seen) < 2:
            raise no_surface(grid, offset)

    return pieces()


def reconstruct_planes(
    grid: SdfGrid,
    network: Decoder,
    factor: int,
    planes: tuple[int, int],
    *,
    whole: BandSummary,
    offset: float = 0.0,
    cap: bool = True,
    mesher: options.MesherName = options.DEFAULT_MESHER,
    max_memory: int | None = None,
    progress: Progress | None = None,
) -> Iterator[Piece]:
    """Yield the pieces of ``reconstruct_slabs`` in some planes; it is a brick of a huge grid.

    Only these planes, from the first to before the second, are read, and those beside them on which
    the mesh depends. The pieces of all bricks, in order, are the same mesh, bit for bit. Vertices
    are counted from the first of the brick: those of the brick before have numbers below 0.
    ``whole`` is of the band of the whole grid, see ``look_at_band``.
    """
    part, steps = (planes, whole), StepCounter(progress)
    run = prepare(grid, network, factor, offset, max_memory, steps, mesher, part=part)
    own = run.band.rows(*planes)
    counts = {"band_voxels": own.stop - own.start, "noisy_voxels": run.band.count_noisy(own)}
    for piece in _mesh_slabs(run, cap, None):
        piece.whole.update(counts)
        yield piece
        del piece  # before the next one is made


def _mesh_slabs(run: Run, cap: bool, save: Callable[[FineField], None] | None) -> Iterator[Piece]:
    """Yield the piece of each slab of a run."""
    steps, mesher = run.steps, run.mesher
    work = {"slabs": len(run.slabs), "planned_bytes": run.planned}
    for slab in run.slabs:
        if len(run.slabs) > 1:
            give_back()
        field = refine(run.band, run.network, run.factor, slab, run.threads, steps)
        field = replace(field, grid=run.lattice, offset=run.offset)
        if save:
            save(field)
            steps.watch.lap("save field")
        mesh, _ = extract(field, run.lattice, mesher=mesher, cap=cap, threads=run.threads)
        piece = describe_piece(field, [mesh], work, run.band.leaves)
        del field, mesh  # before those of the next slab are made
        steps.finish("isosurface")
        piece.seconds.update(steps.take_seconds())
        yield piece
        del piece  # before the next one is made
        steps.watch.start()  # the time since the yield was the caller's
