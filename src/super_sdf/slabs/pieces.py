"""The mesh of one slab, and the counts that belong to it."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..mesh import Mesh
from ..steps.field import FineField, border_is_crossed


@dataclass(frozen=True, eq=False)
class Piece:
    """The mesh of one slab.

    Attributes
    ----------
    meshes : list of Mesh
        Triangles of the slab: rows of all vertices so far, those of the slab among them.
    counts : dict
        Of the slab: ``decoded_voxels``, ``nodes``, ``pinned_nodes``, ``vertices``, ``triangles``.
    whole : dict
        Of all pieces, the same in each: ``band_voxels``, ``noisy_voxels`` (see ``FineField``), the
        number of ``slabs``, and ``planned_bytes``, what the process holds at most by the plan.
    is_cut : bool
        Whether the surface runs out of the grid here.
    signs : set of bool
        Whether there are outer nodes (True), and others (False).
    seconds : dict
        The time of each step, by its name in ``progress.STEPS``; the first piece's has the band's.
    """

    meshes: list[Mesh]
    counts: dict[str, int]
    whole: dict[str, int]
    is_cut: bool
    signs: set[bool]
    seconds: dict[str, float] = field(default_factory=dict)


def describe_piece(fine: FineField, meshes: list[Mesh], planned: dict[str, int]) -> Piece:
    """Return the meshes of a slab with their counts."""
    own = fine.own_rows
    counts = {
        "decoded_voxels": own.stop - own.start,
        "nodes": fine.parts.count_nodes(fine.factor, own),
        "pinned_nodes": fine.pinned,
        "vertices": sum(len(mesh.vertices) for mesh in meshes),
        "triangles": sum(len(mesh.faces) for mesh in meshes),
    }
    whole = {"band_voxels": fine.band_voxels, "noisy_voxels": fine.noisy_voxels, **planned}
    return Piece(meshes, counts, whole, border_is_crossed(fine), fine.signs())
