"""Whether a mesh is closed, oriented, a manifold, free of self-intersections; and its size."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ..arrays import IntArray
from ..mesh import Mesh

FACES_AT_ONCE = 1 << 18  # for area and volume


@dataclass(frozen=True)
class Edges:
    """Numbers of edges that are not shared by exactly two triangles of the same orientation.

    Attributes
    ----------
    open_edges : int
        Edges of one triangle.
    crowded_edges : int
        Edges of more than two triangles: not manifold.
    flipped_edges : int
        Edges of two triangles that pass them in the same direction: not consistently oriented.
    """

    open_edges: int
    crowded_edges: int
    flipped_edges: int


@dataclass(frozen=True)
class Surface:
    """What a mesh is as a surface.

    Attributes
    ----------
    vertices, triangles : int
        Numbers of them; without triangles that have the same vertex twice.
    edges : Edges
        Faults of edges.
    pinched_vertices : int
        Vertices at which more than one fan of triangles meets: not manifold.
    components : int
        Pieces that share no vertex.
    self_intersections : int, optional
        Pairs of triangles that intersect or touch where they share no vertex or edge; None if they
        were not counted.
    volume, area : float
        In cubic and square world units; the volume is negative if the triangles face inward.
    """

    vertices: int
    triangles: int
    edges: Edges
    pinched_vertices: int
    components: int
    self_intersections: int | None
    volume: float
    area: float

    @property
    def closed(self) -> bool:
        """Whether no edge is open."""
        return self.edges.open_edges == 0

    @property
    def oriented(self) -> bool:
        """Whether neighbouring triangles have the same orientation, and the volume is positive."""
        return self.edges.flipped_edges == 0 and self.volume > 0

    @property
    def manifold(self) -> bool:
        """Whether all edges and vertices are manifold; open edges are allowed."""
        return self.edges.crowded_edges == 0 and self.pinched_vertices == 0

    @property
    def is_simple(self) -> bool:
        """Whether the mesh is one closed sheet with an inside, known not to meet itself."""
        whole = self.closed and self.oriented and self.manifold and self.components == 1
        return whole and self.self_intersections == 0

    def faults(self) -> list[str]:
        """Return what keeps the mesh from being the boundary of a solid, in words."""
        edges = self.edges
        counts = {
            "open edges": edges.open_edges,
            "edges of more than two triangles": edges.crowded_edges,
            "edges between triangles of opposite orientation": edges.flipped_edges,
            "vertices where several fans of triangles meet": self.pinched_vertices,
            "pairs of triangles that intersect": self.self_intersections or 0,
        }
        found = [f"{count:,} {what}" for what, count in counts.items() if count]
        return found + ["triangles that face inward"] * (self.volume <= 0)

    def report(self) -> dict[str, Any]:
        """Return the figures as they stand in JSON."""
        figures = asdict(self)
        edges = figures.pop("edges")
        said = {"closed": self.closed, "oriented": self.oriented, "manifold": self.manifold}
        return {**said, **edges, **figures}


def examine_surface(mesh: Mesh, self_intersections: int | None = None) -> Surface:
    """Return what a mesh is as a surface.

    Parameters
    ----------
    mesh : Mesh
        Vertices at the same position must be one vertex.
    self_intersections : int, optional
        What ``slabs.search`` has counted; None if it was not asked to.
    """
    faces = without_collapsed(mesh.faces)
    opposite, edges = pair_edges(faces, len(mesh.vertices))
    pinched = int(np.count_nonzero(count_fans(faces, opposite) > 1))
    del opposite
    volume, area = measure(mesh.vertices, faces)
    return Surface(
        len(mesh.vertices),
        len(faces),
        edges,
        pinched,
        count_components(faces, len(mesh.vertices)),
        self_intersections,
        volume,
        area,
    )


def without_collapsed(faces: IntArray) -> IntArray:
    """Return the faces (m, 3) without those that have a vertex twice, and so no area."""
    a, b, c = faces.T
    whole = (a != b) & (b != c) & (c != a)
    return faces if whole.all() else faces[whole]


def pair_edges(faces: IntArray, count: int) -> tuple[IntArray, Edges]:
    """Find the neighbour of each triangle across each of its edges.

    Half-edge 3 f + i runs from corner i of face f to the next corner.

    Parameters
    ----------
    faces : (m, 3) int32
        Corners of the triangles.
    count : int
        Number of vertices.

    Returns
    -------
    (3 m,) int32, Edges
        The half-edge that runs along the same edge in the other direction, -1 unless the edge has
        exactly these two; and the numbers of all other edges.
    """
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    key = np.minimum(start, end).astype(np.int64)
    key *= count
    key += np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    key = key[order]
    order = order.astype(np.int32)  # meshes are large: half of the memory
    first = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
    del key
    uses = np.diff(np.append(first, faces.size))
    pair = first[uses == 2]
    one, other = order[pair], order[pair + 1]
    against = start[one] == end[other]
    opposite = np.full(faces.size, -1, np.int32)
    opposite[one[against]], opposite[other[against]] = other[against], one[against]
    numbers = (uses == 1).sum(), (uses > 2).sum(), (~against).sum()
    return opposite, Edges(*map(int, numbers))


def count_fans(faces: IntArray, opposite: IntArray) -> NDArray[np.int64]:
    """Return for each vertex, (n,), how many fans of triangles meet there: 1 in a manifold.

    The half-edges of a vertex are walked from triangle to triangle, in steps of 1, 2, 4, ... A fan
    is a cycle, counted at its lowest half-edge, or ends at an edge without a neighbour.
    """
    start, half = faces.ravel(), np.arange(faces.size, dtype=np.int32)
    step = opposite[half.reshape(-1, 3)[:, [2, 0, 1]].ravel()]
    ends = step < 0
    step = np.where(ends, half, step)
    lowest = half
    for _ in range(int(np.bincount(start).max(initial=1)).bit_length()):
        lowest = np.minimum(lowest, lowest[step])
        step = step[step]
    cycles = (lowest == half) & ~ends[step]
    size = int(start.max(initial=-1)) + 1
    return np.bincount(start[ends], minlength=size) + np.bincount(start[cycles], minlength=size)


def count_components(faces: IntArray, count: int) -> int:
    """Return the number of pieces of a mesh that share no vertex; unused vertices do not count."""
    pairs = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), (count, count))
    found, _ = connected_components(graph, directed=False)
    used = np.zeros(count, bool)
    used[faces] = True
    return int(found - np.count_nonzero(~used))


def measure(vertices: NDArray[Any], faces: IntArray) -> tuple[float, float]:
    """Return the enclosed volume and the area, in cubic and square world units."""
    middle = vertices.mean(0, dtype=np.float64)
    volume = area = 0.0
    for first in range(0, len(faces), FACES_AT_ONCE):
        a, b, c = vertices[faces[first : first + FACES_AT_ONCE].T] - middle
        volume += float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6
        area += float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
    return volume, area
