"""What comes before the steps of a slab: the network, the band, and its cut into slabs."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from typing import TypeAlias

from ..errors import OptionError
from ..grid.cubic import cubic_grid
from ..grid.sdf_grid import SdfGrid
from ..threads import Resources, allot
from ..surface.mesh import Mesh, vertex_type
from ..network.decoder import Adapter, Decoder, adapt
from ..network.network import network_for
from ..options import MARCHING, MesherName
from ..progress import StepCounter
from ..refine.band import BandSummary
from ..refine.field import FineField, border_is_crossed
from ..surface.extract import choose_mesher
from ..refine.survey import Band, BandTooLargeError, no_surface, survey
from .cutting import Slab, peak_bytes, plan_slabs, planes_needed, refuse_band

Plan: TypeAlias = tuple[int, int | None, Resources, tuple[float, float], MesherName]
"""The factor, the receptive field, the resources, the network's bytes, the mesher."""


@dataclass(frozen=True, eq=False)
class Run:
    """What is known of a run before the first slab is refined; ``planned`` is its peak in bytes."""

    lattice: SdfGrid
    offset: float
    network: Adapter
    factor: int
    mesher: MesherName
    band: Band
    slabs: list[Slab]
    planned: int
    threads: int
    steps: StepCounter


def prepare(
    grid: SdfGrid,
    network: Decoder,
    factor: int,
    offset: float,
    max_memory: int | None,
    steps: StepCounter,
    mesher: MesherName = MARCHING,
    *,
    at_once: bool = False,
    part: tuple[tuple[int, int], BandSummary] | None = None,
) -> Run:
    """Find the band of a grid, and cut it into slabs; the arguments have been checked.

    With ``part``, some planes and what the band of the whole grid says, only these are meshed.
    """
    chosen = adapt(network_for(network, grid.field.kind))
    resources = allot(chosen.threads, max_memory)
    lattice, reach = cubic_grid(grid, offset), None if at_once else chosen.receptive_field
    mesh_with = choose_mesher(mesher, exact=lattice.field.has_exact)
    plan: Plan = factor, reach, resources, chosen.memory_bytes, mesh_with
    if part is None:
        band = _find_surface(lattice, offset, plan)
        slabs = plan_slabs(band, *plan)
    elif reach is None:
        raise OptionError(
            "the network states no receptive field, so it has to see the whole grid at once: "
            "convert the grid on one machine"
        )
    else:
        (first, last), whole = part
        more = planes_needed(reach, mesh_with, factor)
        among = max(first - more, 0), min(last + more, grid.shape[0])
        band = survey(lattice, offset, resources, among, whole)
        slabs = plan_slabs(band, *plan, (first, last))
    threads = resources.threads
    planned = peak_bytes(band, slabs, factor, chosen.memory_bytes, threads, mesh_with)
    steps.divide(len(slabs))
    steps.finish("band")
    return Run(lattice, offset, chosen, factor, mesh_with, band, slabs, planned, threads, steps)


def _find_surface(grid: SdfGrid, offset: float, plan: Plan) -> Band:
    """Return the band of a grid; GridError if no voxel can hold a surface."""
    vertex_type(grid, plan[0])  # raises if not even float64 resolves the vertices
    band = None
    with suppress(BandTooLargeError):  # and free what it holds
        band = survey(grid, offset, plan[2])  # Eqs. 2 and 4
    if band is None:
        raise refuse_band(grid, offset, *plan)
    if not band.decoded.any():
        raise no_surface(grid, offset)
    return band


@dataclass(frozen=True, eq=False)
class Piece:
    """The mesh of one slab."""

    meshes: list[Mesh]  # faces index the vertices of all slabs so far
    # counts of the slab: ``decoded_voxels``, ``nodes``, ``pinned_nodes``, ``dropped_pieces``,
    # ``lone_samples`` (see ``FineField``), ``vertices``, ``triangles``
    counts: dict[str, int]
    # counts of the whole run, the same in each piece: ``band_voxels``, ``noisy_voxels`` (see
    # ``FineField``), ``slabs``, and ``planned_bytes``, the planned peak memory of the process
    whole: dict[str, int]
    planes: tuple[int, int]  # the slab's planes of voxels, from the first to before the second
    leaves: bool  # whether the solid leaves the grid, anywhere: a sample on the border is inside
    is_cut: bool  # whether the surface leaves the grid in this slab, or may end at unknown samples
    signs: set[bool]  # which signs the slab's nodes have: True outside, False inside
    # seconds of each step, by its name in ``progress.STEPS``; the band is in the first piece
    seconds: dict[str, float] = field(default_factory=dict)
    worker: str = ""  # machine and number of the process that made it, if that was not this one


def describe_piece(
    fine: FineField, meshes: list[Mesh], planned: dict[str, int], leaves: bool
) -> Piece:
    """Return the meshes of a slab with their counts; ``leaves`` is that of the band."""
    own = fine.own_rows
    counts = {
        "decoded_voxels": own.stop - own.start,
        "nodes": fine.parts.count_nodes(fine.factor, own),
        "pinned_nodes": fine.pinned,
        "dropped_pieces": fine.dropped,
        "lone_samples": fine.lone,
        "vertices": sum(len(mesh.vertices) for mesh in meshes),
        "triangles": sum(len(mesh.faces) for mesh in meshes),
    }
    whole = {"band_voxels": fine.band_voxels, "noisy_voxels": fine.noisy_voxels, **planned}
    is_cut = fine.octants is not None or (leaves and border_is_crossed(fine))
    return Piece(meshes, counts, whole, fine.planes, leaves, is_cut, fine.signs())
