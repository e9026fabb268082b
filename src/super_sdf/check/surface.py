"""Whether a mesh is closed, oriented, a manifold, free of self-intersections; and its size."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..surface.mesh import Mesh


@dataclass(frozen=True)
class Surface:
    """What a mesh is as a surface; triangles that have the same vertex twice are left out."""

    open_edges: int  # of an odd number of triangles
    crowded_edges: int  # of more than two triangles: not manifold
    flipped_edges: int  # of two triangles that pass them in the same direction
    vertices: int
    triangles: int
    pinched_vertices: int  # at which several fans of triangles meet: not manifold
    components: int  # that share no vertex
    self_intersections: int | None  # pairs that meet off a common vertex or edge; None: not counted
    volume: float  # in cubic world units, negative if the triangles face inward
    area: float

    @property
    def is_simple(self) -> bool:
        """Whether the mesh is one closed sheet with an inside, known not to meet itself."""
        return not self.faults() and self.components == 1 and self.self_intersections == 0

    def faults(self) -> list[str]:
        """Return what keeps the mesh from being the boundary of a solid, in words."""
        counts = {
            "open edges": self.open_edges,
            "edges of more than two triangles": self.crowded_edges,
            "edges between triangles of opposite orientation": self.flipped_edges,
            "vertices where several fans of triangles meet": self.pinched_vertices,
            "pairs of triangles that intersect": self.self_intersections or 0,
        }
        found = [f"{count:,} {what}" for what, count in counts.items() if count]
        return found + ["triangles that face inward"] * (self.volume <= 0)

    def report(self) -> dict[str, Any]:
        """Return the figures as they stand in JSON."""
        return {
            "closed": self.open_edges == 0,
            "oriented": self.flipped_edges == 0 and self.volume > 0,
            "manifold": self.crowded_edges == 0 and self.pinched_vertices == 0,
            **asdict(self),
        }


def examine_surface(mesh: Mesh, self_intersections: int | None = None) -> Surface:
    """Return what a mesh is as a surface; vertices at the same position must be one vertex."""
    a, b, c = mesh.faces.T
    whole = Mesh(mesh.vertices, mesh.faces[(a != b) & (b != c) & (c != a)])
    opposite, uses, flipped = whole.pair_edges()
    pinched = int(np.count_nonzero(whole.count_fans(opposite) > 1))
    edges = int((uses % 2).sum()), int((uses > 2).sum()), flipped
    counts = len(whole.vertices), len(whole.faces), pinched, whole.components()[0]
    return Surface(*edges, *counts, self_intersections, whole.volume(), whole.area())
