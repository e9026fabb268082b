"""A triangle mesh: volume, open edges, components, and the precision that its vertices need."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import IntArray
from ..errors import GridError, MeshError, OptionTypeError, seen
from ..grid.sdf_grid import SdfGrid
from ..threads import chunks_of

# A vertex stays this share of its lattice edge away from both ends. Otherwise vertices would
# coincide where a node's value is 0, and programs that merge points would tear the mesh.
CLEARANCE = 1e-3
MIXER = np.uint64(0x9E3779B97F4A7C15)  # of the bits of a number: 2^64 by the golden ratio


@dataclass(frozen=True, eq=False, repr=False)
class Mesh:
    """Triangles of a surface, counter-clockwise seen from outside.

    Attributes
    ----------
    vertices : (n, 3) float32 or float64
        World positions; float64 where float32 does not resolve neighbouring vertices.
    faces : (m, 3) int32
        Indices of the corners in ``vertices``.
    notes, warnings : tuple of str
        What was inferred when the mesh was made, and what may be wrong with it.
    """

    vertices: NDArray[Any]
    faces: IntArray
    _: KW_ONLY
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        text = f"{len(self.vertices):,} vertices {self.vertices.dtype}, {len(self.faces):,} faces"
        if len(self.vertices):
            low, high = self.vertices.min(0), self.vertices.max(0)
            box = ", ".join(f"{a:.6g} to {b:.6g}" for a, b in zip(low, high))
            text += f", x, y, z from {box}"
        return f"Mesh({text})"

    def transformed(self, linear: NDArray[Any], shift: NDArray[Any]) -> Mesh:
        """Return the mesh with ``vertices @ linear.T + shift`` (``linear`` keeps orientation)."""
        return replace(self, vertices=self.vertices @ linear.T + shift)

    def volume(self) -> float:
        """Return the enclosed volume, in cubic world units; positive if normals point outward."""
        volume = 0.0
        middle = self.vertices.mean(0, dtype=np.float64) if len(self.faces) else 0
        for some in chunks_of(len(self.faces), 4):
            a, b, c = self.vertices[self.faces[some].T] - middle
            volume += float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6
        return volume

    def area(self) -> float:
        """Return the area, in square world units."""
        area = 0.0
        for some in chunks_of(len(self.faces), 4):
            a, b, c = self.vertices[self.faces[some].T].astype(np.float64)
            area += float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
        return area

    def boundary(self) -> IntArray:
        """Return the open edges, which an odd number of triangles share, (n, 2).

        To avoid sorting all edges, every vertex gets a mark of 46 random bits. At a vertex inside
        the surface, each neighbour follows the vertex in one triangle and precedes the vertex in
        another, so marks of followers less marks of predecessors sum to 0. Only edges between
        vertices with another sum are sorted. Sums are hardly ever 0 by chance.
        """
        count = len(self.vertices)
        bits = np.arange(1, count + 1, dtype=np.uint64) * MIXER
        marks = ((bits ^ bits >> np.uint64(29)) * MIXER >> np.uint64(18)).astype(np.float64)
        sums, chunks = np.zeros(count), chunks_of(len(self.faces), 8)
        for some in chunks:
            corners = np.ascontiguousarray(self.faces[some].T)
            mark = marks.take(corners)
            for nth, corner in enumerate(corners):
                np.add.at(sums, corner, mark[nth - 2] - mark[nth - 1])
        loose, edges = sums != 0, [np.empty((0, 2), np.int32)]
        for some in chunks if loose.any() else ():
            ends = np.stack([self.faces[some], np.roll(self.faces[some], -1, 1)], -1)
            edges.append(ends[loose[ends].all(2) & (ends[..., 0] != ends[..., 1])])
        start, end = np.concatenate(edges).T.astype(np.int64)
        key = np.minimum(start, end) * count + np.maximum(start, end)
        _, first, times = np.unique(key, return_index=True, return_counts=True)
        odd = first[times % 2 == 1]
        return np.stack([start[odd], end[odd]], 1).astype(np.int32)

    def open_edges(self) -> int:
        """Count the edges that an odd number of triangles share: 0 in a closed mesh."""
        return len(self.boundary())

    def is_closed(self) -> bool:
        """Return whether the mesh has faces and no open edge."""
        return len(self.faces) > 0 and self.open_edges() == 0

    def components(self) -> tuple[int, NDArray[np.int32]]:
        """Return the number of connected components, and the component of each vertex, (n,).

        Unused vertices are not counted, but have component numbers.
        """
        start, end = self.faces[:, :2].ravel(), self.faces[:, 1:].ravel()
        piece = _connected(start, end, len(self.vertices))
        return len(np.unique(piece[self.faces[:, 0]])), piece

    def cavities(self) -> int:
        """Count the walls of cavities: components of negative volume, if the mesh's is positive."""
        piece, middle = self.components()[1][self.faces[:, 0]], self.vertices.mean(0, np.float64)
        volumes = np.bincount(piece, np.linalg.det(self.vertices[self.faces] - middle))
        return int(np.count_nonzero(volumes < 0)) * bool(volumes.sum() > 0)

    def pair_edges(self) -> tuple[IntArray, NDArray[np.intp], int]:
        """Find the neighbour of each triangle across each of its edges, by sorting all edges.

        Half-edge 3 f + i runs from corner i of face f to the next corner. Returned are the opposite
        half-edge of each, (3 m,), -1 unless exactly two triangles share the edge in opposite
        directions; the triangles of each edge; and how many pairs have the same direction.
        """
        faces = self.faces
        start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
        key = np.minimum(start, end).astype(np.int64) * len(self.vertices) + np.maximum(start, end)
        order = np.argsort(key, kind="stable")
        key = key[order]
        order = order.astype(np.int32)  # meshes are large: half of the memory
        first = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
        uses = np.diff(np.append(first, faces.size))
        pair = first[uses == 2]
        one, other = order[pair], order[pair + 1]
        against = start[one] == end[other]
        opposite = np.full(faces.size, -1, np.int32)
        opposite[one[against]], opposite[other[against]] = other[against], one[against]
        return opposite, uses, int((~against).sum())

    def count_fans(self, opposite: IntArray) -> NDArray[np.int64]:
        """Return the number of fans of triangles at each vertex, (n,): 1 in a manifold.

        A fan is a set of half-edges at a vertex, connected from triangle to triangle.
        ``opposite`` is from ``pair_edges``.
        """
        half = np.arange(self.faces.size)
        step = opposite[half.reshape(-1, 3)[:, [2, 0, 1]].ravel()]
        fan = _connected(half[step >= 0], step[step >= 0], len(half))
        one_of_each = self.faces.ravel()[np.unique(fan, return_index=True)[1]]
        return np.bincount(one_of_each, minlength=len(self.vertices))


def _connected(start: NDArray[Any], end: NDArray[Any], count: int) -> NDArray[np.int32]:
    """Return the number of the piece, (count,), of nodes that edges from start to end connect."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(start), bool), (start, end)), (count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def check_mesh(mesh: Any) -> None:
    """Raise OptionTypeError if ``mesh`` is no ``Mesh``, MeshError if its arrays are no mesh."""
    if not isinstance(mesh, Mesh):
        raise OptionTypeError(f"mesh is {seen(mesh)}: give one from reconstruct(grid)")
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    for name, array, kinds in (("vertices", vertices, "f"), ("faces", faces, "iu")):
        if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in kinds:
            said = f"the {name} of the mesh are {array.dtype} of shape {array.shape}"
            raise MeshError(f"{said}: give rows of three {'floats' if kinds == 'f' else 'indices'}")
    if faces.size and not (faces.min() >= 0 and faces.max() < len(vertices)):
        worst = int(faces.min() if faces.min() < 0 else faces.max())
        raise MeshError(f"a face of the mesh names vertex {worst} of {len(vertices):,}: repair it")
    if not np.isfinite(vertices).all():
        raise MeshError("a vertex of the mesh is not finite: repair it")


def row_keys(rows: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return a hash of each row of numbers, (n,): equal rows have equal ones, others hardly ever.

    Zeros of either sign are equal.
    """
    keys = np.zeros(len(rows), np.uint64)
    for column in np.ascontiguousarray(rows.T + 0.0).view(np.uint64):
        keys = (keys ^ column) * MIXER
        keys ^= keys >> np.uint64(29)
    return keys


def vertex_type(grid: SdfGrid, factor: int) -> type[np.float32] | type[np.float64]:
    """Return the dtype that resolves neighbouring vertices: float32 if possible, else float64."""
    reach, least = grid.reach, CLEARANCE / 2 * grid.voxel_size / factor
    for kind in (np.float32, np.float64):
        finfo = np.finfo(kind)
        is_fine = max(float(finfo.tiny), float(finfo.eps) * reach) < least
        if is_fine and reach < float(finfo.max):
            return kind
    raise GridError(
        f"the grid reaches to {reach:.6g}, too far from the origin for its spacing, "
        f"{grid.voxel_size:.6g}: vertices could not be told apart; give a nearer origin"
    )
