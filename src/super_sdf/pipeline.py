"""The method on a page: Section 4 of "SUPER-SDF", the paper, one named step a line.

    grid -> cubic lattice -> band -> patches and neighbour table -> network -> averaged shared nodes
         -> surface moved to touch the samples' spheres -> values kept within the samples' bounds
         -> isosurface

>>> from super_sdf import make_grid, reconstruct
>>> mesh = reconstruct(make_grid(values, spacing=0.1))            # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from . import options
from .arrays import CENTRE
from .errors import OptionError, OptionTypeError, OutOfMemoryError, seen, tell
from .grid.sdf_grid import SdfGrid, as_grid, crop, cubic_grid
from .network.contract import Adapter, Decoder, adapt
from .network.network import load_network, network_for
from .options import Options
from .refine import nodes
from .refine.band import Band, BandSummary, neighbour_table, no_surface, survey
from .refine.bounds import SampleSpheres, keep_within_bounds
from .refine.field import FineField
from .refine.prediction import interpolate, predict
from .refine.spheres import fit_to_spheres
from .surface.cap import check_can_close, seen_octants
from .surface.extract import extract
from .surface.mesh import Mesh, vertex_type
from .threads import MESHING, Progress, Steps, in_words, useful_threads
from .tiles import Part, Room, Tile, check_closed, join, margin_of, own_part, plan


def refine_band(
    band: Band, network: Adapter, factor: int, threads: int = 1, steps: Steps | None = None
) -> FineField:
    """Return the fine field of a band: the steps from the network to the final values."""
    steps = steps or Steps()
    grid, patches = band.grid, band.patches
    table = neighbour_table(band.voxel_ijk, grid.shape, threads)
    voxels = np.flatnonzero(band.decoded).astype(np.int32)
    own_ijk = band.voxel_ijk[voxels]
    if grid.field.network is not None:
        blocks = predict(band, table, voxels, network, factor, threads, steps.within("network"))
    else:
        blocks = interpolate(band, voxels, factor)
    steps.finish("network")

    row_of = np.full(len(table) + 1, -1, np.int32)  # of each voxel of the band, if it is decoded
    row_of[voxels] = np.arange(len(voxels), dtype=np.int32)
    parts = nodes.share_parts(row_of[table[voxels]])
    del table
    nodes.average_shared(blocks, parts, factor, threads)  # Eq. 7
    fit_to_spheres(blocks, parts, factor, band, nodes.VoxelIndex(own_ijk, grid.shape), threads)
    keep_within_bounds(blocks, parts, factor, own_ijk, band.trusted, threads)
    decoded = blocks[:, :-1]
    if grid.field.sides_only:
        nodes.hold_sides(decoded, factor, patches[voxels, CENTRE])
    nodes.pin_to_skipped(decoded, parts, factor, own_ijk, patches[voxels], grid.shape)
    nodes.take_lone_points_out(decoded, factor)
    steps.finish("nodes")
    unseen, leaves, exact = grid.field.unseen, band.whole.leaves, band.exact
    number = np.ravel_multi_index(tuple(band.voxel_ijk[exact].T), grid.shape)
    spheres = SampleSpheres(grid.shape, number, patches[exact, CENTRE])
    octants = None if unseen is None else seen_octants(unseen, own_ijk)
    made: Any = {"spheres": spheres, "leaves": leaves, "octants": octants}
    return FineField(grid.shape, factor, own_ijk, decoded, parts, grid, band.offset, **made)


def upsample(
    grid: SdfGrid,
    network: Decoder,
    factor: int | None = None,
    *,
    offset: float = 0.0,
    progress: Progress | None = None,
) -> FineField:
    """Refine a coarse grid near its surface.

    Parameters
    ----------
    grid : SdfGrid
        Coarse signed distances in world units, negative inside. If the spacing differs between
        axes, distances are first resampled to the finest spacing, which the field then has.
    network : Network
        From ``load_network``.
    factor, offset, progress
        As in ``reconstruct``.

    Returns
    -------
    FineField
        Values at the nodes of spacing h/K in every voxel that can hold the surface.
    """
    asked = Options(factor, offset=offset)  # checks them
    steps = Steps(progress, MESHING[:-1])
    lattice, decoder, factor = _prepared(grid, network, asked)
    threads = useful_threads(decoder.threads)
    band = survey(lattice, asked.offset, threads=threads)  # Eqs. 2 and 4
    if not band.decoded.any():
        raise no_surface(grid, asked.offset)
    steps.finish("band")
    field = refine_band(band, decoder, factor, threads, steps)
    if not field.blocks.min(initial=1) <= 0 < field.blocks.max(initial=0):
        raise no_surface(grid, asked.offset)
    return field


def extract_mesh(
    field: FineField,
    grid: SdfGrid | None = None,
    *,
    mesher: options.MesherName = "auto",
    cap: bool = True,
) -> Mesh:
    """Return the zero level of a field as a mesh in world coordinates; nodes of 0 are inside.

    Parameters
    ----------
    field : FineField
        From ``upsample`` or ``read_field``.
    grid : SdfGrid, optional
        A coarse grid for spacing, origin and direction. Default: the grid from which the field was
        made.
    mesher, cap
        As in ``reconstruct``; "auto" is "sharp" if samples of the field were taken as exact.
    """
    if not isinstance(field, FineField):
        raise OptionTypeError(f"field is {seen(field)}: give one from upsample(grid, network)")
    grid, asked = as_grid(field.grid if grid is None else grid), Options(mesher=mesher, cap=cap)
    chosen = asked.mesher_for(exact=len(field.spheres.distance) > 0)
    check_can_close(grid, cap=cap)
    return extract(field, cubic_grid(grid), mesher=chosen, cap=cap)[0]


def reconstruct(
    grid: SdfGrid | ArrayLike | None = None,
    network: Decoder | None = None,
    factor: int | None = None,
    *,
    function: Callable[[Any], Any] | None = None,
    bounds: ArrayLike | None = None,
    spacing: ArrayLike | None = None,
    origin: ArrayLike | None = None,
    direction: ArrayLike | None = None,
    inside: options.Inside = "auto",
    field: options.FieldKind = "auto",
    label: int | None = None,
    level: float | None = None,
    scale: float | None = None,
    unknown: float | None = None,
    quality: options.Quality | str | Path | None = None,
    device: options.Device | None = None,
    precision: options.Precision | None = None,
    threads: int | None = None,
    offset: float = 0.0,
    cap: bool = True,
    mesher: options.MesherName = "auto",
    max_memory: int | None = None,
    progress: Progress | None = None,
) -> Mesh:
    """Turn an array, a grid or a function into a fine mesh.

    Parameters
    ----------
    grid : SdfGrid or (nx, ny, nz) array_like, optional
        Coarse signed distances, or other values: see ``make_grid``. An array may be of NumPy
        (memory maps, too), PyTorch on any device, h5py, Zarr, Dask or xarray, with further leading
        axes of length 1. Without a grid the function is sampled.
    network : Network, optional
        From ``load_network``, to load the network once for many grids.
    factor : int, optional
        Fine voxels per voxel of the grid along each axis, K: an even number from 2 to 16; by
        default 2 for masks, else 4.
    function : callable, torch.nn.Module or DistanceFunction, optional
        The function of which the grid has samples; vertices are moved to its zeros.
    bounds, spacing : optional
        The box and the spacing of the samples of a function; see ``DistanceFunction.sample``.
    spacing, origin, direction, inside, field, label, level, scale, unknown : optional
        Position and kind of the values of an array; see ``make_grid``.
    quality, device, precision, threads : optional
        The network to load if none is given, and where it runs: see ``load_network``.
    offset : float
        Mesh the surface at this world distance from the solid, positive outwards (Sec. 5.3). The
        distances must reach 1.5 spacings beyond the offset.
    cap, mesher, max_memory
        As the options of ``super-sdf upsample``. With ``cap=False`` meshes of neighbouring grids
        can be joined.
    progress : callable, optional
        Called with (done, total), see ``threads.Progress``; an exception there ends the work.

    Returns
    -------
    Mesh
        In world units; closed, unless the surface leaves the grid and ``cap`` is False.
        ``Mesh.notes`` say what was inferred, and are logged, level INFO, to "super_sdf".
        ``Mesh.warnings`` say what may be wrong; each is also issued as a ``SuperSdfWarning``.

    Raises
    ------
    OptionError, GridError, ModelError, OutOfMemoryError
        If an argument is invalid; if there is no surface at the offset; if the network returns
        values that are not finite; if not even small tiles of the grid fit in memory.
    """
    chosen = Options(factor, offset=offset, cap=cap, mesher=mesher, max_memory=max_memory)
    told = {"spacing": spacing, "origin": origin, "direction": direction, "inside": inside}
    told |= {"field": field, "label": label, "level": level, "scale": scale, "unknown": unknown}
    if (grid is None and function is not None) or bounds is not None:
        from .functions.function import sampled  # imported here, as few need it

        grid = sampled(grid, function, bounds, told, chosen.offset)
    else:
        grid = as_grid(grid, **told)
    where = {"quality": quality, "device": device, "precision": precision, "threads": threads}
    asked: dict[str, Any] = {name: value for name, value in where.items() if value is not None}
    if network is None:
        network = load_network(asked.pop("quality", options.DEFAULT_QUALITY), **asked)
    elif asked:
        raise OptionError(f"a network and {next(iter(asked))} are given: give only one of them")
    made = mesh_grid(grid, network, chosen, steps=Steps(progress))
    mesh, (notes, warnings) = made.mesh, made.said(grid)
    if function is not None:
        from .functions.zero import put_on_zero

        factor = chosen.factor_for(mask=grid.field.sides_only)
        mesh, doubts = put_on_zero(mesh, function, grid, factor, offset)
        warnings += doubts
    said, doubted = tell(notes, warnings)
    return replace(mesh, notes=said, warnings=doubted)


def _prepared(grid: SdfGrid, network: Decoder, chosen: Options) -> tuple[SdfGrid, Adapter, int]:
    """Check what is given; return the cubic lattice of a grid, its field's network and factor."""
    options.NETWORK.check(network, "network")
    lattice = cubic_grid(as_grid(grid), chosen.offset)
    factor = chosen.factor_for(mask=grid.field.sides_only)
    vertex_type(lattice, factor)  # raises if not even float64 resolves the vertices
    return lattice, adapt(network_for(network, grid.field.network)), factor


@dataclass(frozen=True, eq=False)
class Result:
    """The mesh of a grid, and what is known of how it was made."""

    mesh: Mesh
    lattice: SdfGrid  # the grid, made cubic
    whole: BandSummary
    open_edges: int
    tiles: int
    options: Options

    @property
    def capped(self) -> bool:
        """Whether the surface leaves the grid and is closed along its border."""
        return self.options.cap and self.whole.leaves

    def said(self, grid: SdfGrid) -> tuple[list[str], list[str]]:
        """Return what was inferred of a grid, and what may be wrong with its mesh, in sentences."""
        notes, warnings, field = list(self.lattice.flagged), list[str](), grid.field
        if self.capped:
            closed = "its surface is closed along the border (leave it open with --open)"
            notes.append(f"the solid runs out of the grid: {closed}")
        if self.options.mesher == "sharp" and not self.lattice.field.has_exact:
            notes.append(f"{field.kind} values show no edges: the mesh is that of marching cubes")
        if self.open_edges and field.unseen is not None:
            warnings.append("the surface ends where samples are unknown, and is open there")
        elif self.open_edges:
            where = "the surface runs out of the grid and is open there"
            warnings.append(f"{where} (close it with --cap)")
        if grid.low >= self.options.offset:
            thin = "no sample lies inside: the solid is thinner than the spacing"
            warnings.append(f"{thin}, and its mesh may have holes")
        if self.whole.noisy and field.has_exact:
            share = 100 * self.whole.noisy / self.whole.count
            differ = f"in {share:.3g} % of the band the values differ by more than distances can"
            warnings.append(f"{differ}: they are taken as noisy there, and corrected")
        return notes, warnings


@dataclass(frozen=True, eq=False)
class Task:
    """All that a tile is made of, besides the network; it can be sent to another process."""

    tile: Tile
    grid: SdfGrid  # the samples of the tile
    shape: tuple[int, int, int]  # samples of the whole grid
    options: Options  # with the mesher that is used
    factor: int
    threads: int
    whole: BandSummary | None = None  # of a tile that is not the whole grid


MapTiles = Callable[[Callable[[Task], Part], Iterator[Task]], Iterable[Part]]
"""Calls a function, which can be pickled, with each task, and returns the parts in any order."""


def mesh_grid(
    grid: SdfGrid,
    network: Decoder,
    chosen: Options,
    *,
    steps: Steps | None = None,
    save_field: Callable[[FineField], None] | None = None,
    map_tiles: MapTiles | None = None,
    least_tiles: int = 1,
) -> Result:
    """Return the mesh of a grid: in one piece, or in tiles if it does not fit in memory.

    ``save_field`` is called with the fine field, which needs one piece. ``map_tiles`` has tiles
    made elsewhere, ``least_tiles`` or more, each within the memory bound.
    """
    lattice, decoder, factor = _prepared(grid, network, chosen)
    check_can_close(grid, cap=chosen.cap)
    chosen = replace(chosen, mesher=chosen.mesher_for(exact=lattice.field.has_exact))
    steps, shape = steps or Steps(), lattice.shape
    everything, threads = Tile((0, 0, 0), shape, (0, 0, 0), shape), useful_threads(decoder.threads)
    task = Task(everything, lattice, shape, chosen, factor, threads)
    room = Room.of(chosen.max_memory, factor, decoder.memory_bytes)
    most_at_once = room.voxels() if map_tiles is None and least_tiles == 1 else -1  # voxels
    bands = [survey(lattice, chosen.offset, threads=threads, most=most_at_once)]
    steps.finish("band")
    whole = bands[0].whole
    if whole.count <= most_at_once:
        # popped, so that nothing here keeps the band in memory
        parts = [make_tile(task, decoder, bands.pop(), steps, save_field)]
    elif save_field:
        said = f"the refined field does not fit in the {in_words(room.bound)} that may be used"
        way_out = "use a smaller factor, allow more (--max-memory), or leave --save-field out"
        raise OutOfMemoryError(f"{said}: {way_out}")
    else:
        margin = margin_of(lattice, decoder.receptive_field, chosen.mesher, factor)
        tiles, parts = plan(shape, whole, margin, room, least_tiles), list[Part]()
        tasks = (
            replace(task, tile=tile, grid=crop(lattice, tile.low, tile.high), whole=whole)
            for tile in tiles
        )
        for part in (map_tiles or map)(partial(make_tile, network=decoder), tasks):
            parts.append(part)
            steps.show(steps.done + (1 - steps.done) * len(parts) / len(tiles))
        parts.sort(key=lambda part: part.tile.low)
    mesh, names = join(parts)
    if not len(mesh.faces):
        raise no_surface(grid, chosen.offset)
    edges = check_closed(mesh, lattice, names, cap=chosen.cap)
    steps.finish("isosurface")
    return Result(mesh, lattice, whole, edges, len(names), chosen)


def make_tile(
    task: Task,
    network: Adapter,
    band: Band | None = None,
    steps: Steps | None = None,
    save_field: Callable[[FineField], None] | None = None,
) -> Part:
    """Return the part of the mesh that belongs to a tile, which may be the whole grid."""
    tile, chosen, factor, threads = task.tile, task.options, task.factor, task.threads
    band = band or survey(task.grid, chosen.offset, threads=threads, whole=task.whole)
    if not band.decoded.any():
        return Part.without_surface(tile)
    field = refine_band(band, network, factor, threads, steps)
    del band
    if save_field:
        save_field(field)
    how: Any = {"mesher": chosen.mesher, "cap": chosen.cap, "threads": threads}
    mesh, keys = extract(field, task.grid, first=tile.low, shape=task.shape, **how)
    del field
    return own_part(mesh, keys, tile, task.shape, factor)
