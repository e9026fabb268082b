"""The mesh of one slab, with counts and times."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..mesh import Mesh
from ..steps.field import FineField, border_is_crossed


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
