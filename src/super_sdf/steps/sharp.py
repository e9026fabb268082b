"""Sharp edges and corners: marching cubes with a further vertex on each feature of the solid.

Marching cubes has its vertices on lattice edges, so it cuts the solid's edges off. Here every patch
of the surface in a cell that holds an edge or a corner gets a vertex there and becomes a fan round
it; the side between two fans is turned so that it joins their vertices (extended marching cubes).
Elsewhere the mesh is that of marching cubes, and it is a closed manifold for the same reason.

Where a feature lies is read off the planes of the faces beside it:

    normals     of the field on both ends of every crossed lattice edge, from differences that do
                not straddle a kink
    planes      near features, the planes of crossings on flat ground replace those of crossings
                beside the kink, where the field is rounded off, step by step
    vertices    of the features where the planes of a patch meet; those beside are moved onto them

References: Kobbelt, Botsch, Schwanecke and Seidel, "Feature Sensitive Surface Extraction from
Volume Data", 2001; Harten, Engquist, Osher and Chakravarthy, "Uniformly High Order Accurate
Essentially Non-Oscillatory Schemes", 1987, for the differences.

Positions are in fine spacings, from node (0, 0, 0) of the fine lattice.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, IntArray
from ..grid.sdf_grid import SdfGrid
from ..machine.index_width import check_count
from ..machine.threads import map_chunks
from ..mesh import CLEARANCE, Mesh, vertex_type
from ..neighbourhood import CENTRE, STRIDES
from .cell_cases import loop_table
from .field import FineField
from .marching import (
    CAP_HEIGHT,
    NO_FACES,
    Crossings,
    cells_low_nodes,
    edge_steps,
    find_crossings,
    lattice_positions,
    number_edges,
    to_world,
)
from .nodes import block_ijk

Vectors = NDArray[np.float64]
Index = NDArray[np.int64]

SHARP_COSINE = 0.85  # normals of a patch that differ by more, 32 degrees, make a feature
RINGS = 8  # patches round a feature, counted from it, in which planes are sought
ROUNDS = 8  # in each, every crossing looks at those it shares a patch with
MOVED_RINGS = 2  # round a feature, in which vertices are moved onto the planes
FARTHEST_MOVE = 0.5  # fine spacings
OUTSIDE_CELL = 0.5  # fine spacings by which a feature's vertex may leave its cell
ROUGH = 0.02  # 1 - cosine of normals in a patch from which a crossing is not trusted
ALIGNED = 0.125  # 1 - cosine up to which planes count as the same
OFF_PLANE = 0.12  # fine spacings up to which a crossing is taken to lie on a plane
SLOPE_ERROR = 0.15  # of the field's slope, 1 for a distance, up to which a normal is trusted
WEAKENING = 0.7  # of the trust in a plane, from crossing to crossing
LEAST_TRUST = 1e-4
LEAST_SUPPORT = 0.1  # trust in the settled planes of a feature
LEAST_SLOPE_TRUST = 0.02  # of every crossing of a feature
RANK = 0.05  # eigenvalues below this share of the largest leave a direction open
# Cells to every side that a vertex depends on.
REACH_IN_CELLS = RINGS + ROUNDS + MOVED_RINGS + 4


@dataclass(frozen=True, eq=False)
class Patches:
    """The patches of the surface in the crossed cells of some blocks, in the order of the cells.

    Attributes
    ----------
    row : (P,) int32
        The voxel of each.
    low : (P, 3) float64
        The low corner of its cell.
    loop : (P,) int64
        Which row of ``loop_table`` it is.
    sides : (P,) int64
        How many crossings it has.
    crossing : (P, S) int64
        Its crossings in order, counter-clockwise from outside, -1 after the last.
    """

    row: IntArray
    low: Vectors
    loop: Index
    sides: Index
    crossing: Index

    def chosen(self, rows: Index) -> Patches:
        """Return some of the patches."""
        return Patches(
            self.row[rows], self.low[rows], self.loop[rows], self.sides[rows], self.crossing[rows]
        )


@dataclass(frozen=True, eq=False)
class Planes:
    """A plane at each crossing.

    Attributes
    ----------
    point : (n, 3) float64
        On the plane; at first where the surface crosses the lattice edge.
    normal : (n, 3) float64
        Of unit length; at first of the nearer end of the edge if the ends disagree.
    trust : (n,) float64
        1 where the field is a distance, less where its slope is not 1, or the ground not flat.
    """

    point: Vectors
    normal: Vectors
    trust: NDArray[np.float64]


def extract_sharp_pieces(
    field: FineField, grid: SdfGrid, first_vertex: int = 0, threads: int = 1
) -> list[Mesh]:
    """Return the mesh of a field's planes with its edges and corners, as a list of one piece.

    Vertices and faces are numbered as by ``marching.extract_pieces``.

    Raises
    ------
    OptionError
        If there are more vertices than can be numbered, those before among them.
    """
    rows = _rows_around(field)
    before = field.plane_before(rows).start if rows.start < rows.stop else rows.start
    crossings = find_crossings(field, slice(before, rows.stop), threads)
    if not len(crossings.own_row):
        return [Mesh(np.empty((0, 3), vertex_type(grid, field.factor)), NO_FACES)]
    patches = find_patches(field, crossings, rows, before)
    own = planes_at_crossings(field, crossings, threads)
    positions, features, peaks = place_features(patches, own)
    positions = _kept_in_grid(positions, own.point, field)
    peaks = _kept_in_grid(peaks, patches.low[features] + 0.5, field)
    numbers = _number_vertices(field, crossings, patches, features, first_vertex)
    faces = _faces(field, patches, features, numbers)
    vertices = np.empty((numbers.own, 3))
    for row, number, position in (
        (crossings.own_row, numbers.of_crossing, positions),
        (patches.row[features], numbers.of_feature, peaks),
    ):
        mine = _within(row, field.own_rows)
        vertices[number[mine] - first_vertex] = position[mine]
    return [Mesh(to_world(vertices.T, field, grid), faces)]


def _kept_in_grid(position: Vectors, start: Vectors, field: FineField) -> Vectors:
    """Return positions (n, 3) that do not leave the grid, nor its border if they started there.

    An open surface ends on the border, and a cap is flat there. ``start``, (n, 3), is where a
    vertex was on its lattice edge, or the middle of its cell.
    """
    last = np.array(field.shape, np.float64) * field.factor
    at_border = (start <= 0) | (start >= last)
    border = np.clip(start, -CAP_HEIGHT, last + CAP_HEIGHT)
    return np.where(at_border, border, np.clip(position, CLEARANCE, last - CLEARANCE))


def planes_beside(factor: int) -> int:
    """Return how many coarse planes to either side a slab's mesh depends on."""
    return -(-(REACH_IN_CELLS + 1) // factor)


def _rows_around(field: FineField) -> slice:
    """Return the rows of the field's own planes and of those that they depend on."""
    beside = planes_beside(field.factor)
    return field.rows(field.planes[0] - beside, field.planes[1] + beside)


def find_patches(field: FineField, crossings: Crossings, rows: slice, before: int) -> Patches:
    """Return the patches in the crossed cells of some voxels.

    The crossings are those of the voxels from ``before`` on, the first of the plane before, since
    these own edges of the cells.
    """
    table, factor = loop_table(), field.factor
    edges = 3 * len(field.blocks)
    edge_at = number_edges(field, crossings, before, rows, 0)
    some = crossings.cells(rows)
    case = crossings.case[some]
    count = table.count[case]
    cell = np.repeat(np.arange(len(count)), count)
    loop = table.first[case[cell]] + _nth(cell, count)
    row = crossings.cell_row[some][cell]
    low_node = cells_low_nodes(factor)[crossings.cell[some][cell]]
    at = ((row - np.int64(before)) * edges + low_node)[:, None] + edge_steps(factor)[
        table.edges[loop]
    ]
    crossing = np.where(table.edges[loop] >= 0, edge_at.take(at, mode="clip"), np.int64(-1))
    low = factor * field.voxel_ijk[row] + block_ijk(factor)[low_node]
    return Patches(row, low.astype(np.float64), loop, table.sides[loop], crossing)


def planes_at_crossings(field: FineField, crossings: Crossings, threads: int = 1) -> Planes:
    """Return the planes on the crossed edges that voxels own, by the field alone."""
    parts = map_chunks(
        lambda some: _planes_of_chunk(field, crossings, some), len(crossings.own_row), 256, threads
    )
    return Planes(*(np.concatenate(arrays) for arrays in zip(*parts)))


def _planes_of_chunk(
    field: FineField, crossings: Crossings, some: slice
) -> tuple[Vectors, Vectors, NDArray[np.float64]]:
    """Return the arrays of ``Planes`` for some crossings."""
    row = crossings.own_row[some]
    axis, node = np.divmod(crossings.own_edge[some].astype(np.int64), len(field.blocks))
    low_ijk = block_ijk(field.factor)[node]
    high_ijk = low_ijk.copy()
    high_ijk[np.arange(len(row)), axis] += 1
    position = lattice_positions(field, row, crossings.own_edge[some]).T
    start = (field.factor * field.voxel_ijk[row] + low_ijk)[np.arange(len(row)), axis]
    share = np.clip(position[np.arange(len(row)), axis] - start, 0, 1)
    gradients = _gradient(field, row, low_ijk), _gradient(field, row, high_ijk)
    return position, *_mean_normal(*gradients, share)


def _mean_normal(
    low: Vectors, high: Vectors, share: NDArray[np.float64]
) -> tuple[Vectors, NDArray[np.float64]]:
    """Return normals (n, 3) between the gradients at both ends of edges, and the trust in them."""
    trust = [_near_one(_length(gradient)) for gradient in (low, high)]
    weight = (1 - share) * trust[0], share * trust[1]
    agree = _dot(_unit(low), _unit(high)) > 0.9
    mean = low * weight[0][:, None] + high * weight[1][:, None]
    nearer = np.where((weight[0] >= weight[1])[:, None], low, high)
    return _unit(np.where(agree[:, None], mean, nearer)), np.maximum(*trust)


def _near_one(slope: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how near slopes are to that of a distance: 1 at 1, quickly less beside it."""
    off = (slope - 1) / SLOPE_ERROR
    trust: NDArray[np.float64] = 1 / (1 + off * off) ** 2 + LEAST_TRUST
    return trust


def _gradient(field: FineField, row: IntArray, node_ijk: IntArray) -> Vectors:
    """Return the field's gradient at nodes of blocks, (n, 3); 1 is the slope of a distance.

    Along each axis by the parabola through three of five nodes that bends least: it does not
    straddle a kink.
    """
    gradient = np.zeros((len(row), 3))
    for axis in range(3):
        a, b, c, d, e = (_shifted(field, row, node_ijk, axis, step) for step in range(-2, 3))
        bend = np.abs(np.stack([c - 2 * b + a, d - 2 * c + b, e - 2 * d + c]))
        slopes = np.stack([1.5 * c - 2 * b + 0.5 * a, 0.5 * (d - b), 2 * d - 1.5 * c - 0.5 * e])
        bend[~np.isfinite(bend)] = np.inf
        least = bend.argmin(0)
        chosen = slopes[least, np.arange(len(row))]
        gradient[:, axis] = np.where(np.isfinite(chosen), chosen, 0)
    return gradient * (field.factor / 2)


def _value(field: FineField, row: NDArray[Any], node_ijk: IntArray) -> NDArray[np.float64]:
    """Return the values of nodes of blocks, (n,); NaN where there is no block, row -1."""
    side = field.factor + 1
    node = (node_ijk[:, 0] * side + node_ijk[:, 1]) * side + node_ijk[:, 2]
    values: NDArray[np.float64] = field.blocks[node, row].astype(np.float64)
    values[row < 0] = np.nan
    return values


def _shifted(
    field: FineField, row: IntArray, node_ijk: IntArray, axis: int, step: int
) -> NDArray[np.float64]:
    """Return the values some nodes further along an axis, maybe in the next block."""
    ijk, factor = node_ijk.copy(), field.factor
    ijk[:, axis] += step
    beyond = np.where(ijk[:, axis] > factor, 1, np.where(ijk[:, axis] < 0, -1, 0))
    ijk[:, axis] -= factor * beyond
    voxel = np.where(beyond == 0, row, field.parts.table[CENTRE + int(STRIDES[axis]) * beyond, row])
    return _value(field, voxel, ijk)


def place_features(patches: Patches, own: Planes) -> tuple[Vectors, Index, Vectors]:
    """Return positions of all crossings, which patches have a feature, and its vertices.

    Returns
    -------
    (n, 3) float64, (f,) int64, (f, 3) float64
        Positions; rows of ``patches``; positions of the features' vertices.
    """
    seeds = _is_sharp(patches, own.normal, own.trust)
    near = _dilate(patches, seeds, RINGS, len(own.point))
    inside = np.flatnonzero((near[patches.crossing] | (patches.crossing < 0)).all(1))
    if not len(inside):
        return own.point, inside, np.empty((0, 3))
    some = patches.chosen(inside)
    planes = settle_planes(some, own)
    is_feature = _is_sharp(some, planes.normal, own.trust) & _is_supported(some, planes)
    sharp = np.flatnonzero(is_feature)
    features = inside[sharp]
    chosen = np.zeros(len(patches.row), bool)
    chosen[features] = True
    moved = _dilate(patches, chosen, MOVED_RINGS, len(near)) & near
    shift = planes.point - own.point
    shift *= np.minimum(1, FARTHEST_MOVE / np.maximum(_length(shift), 1e-12))[:, None]
    position = own.point + np.where(moved[:, None], shift, 0)
    return position, features, _meet(some.chosen(sharp), planes)


def _is_sharp(patches: Patches, normal: Vectors, trust: NDArray[np.float64]) -> BoolArray:
    """Return which patches, (P,), have normals that differ by more than ``SHARP_COSINE``.

    Only where the field is a distance at every crossing: of others normals say little.
    """
    sharp: BoolArray = np.zeros(len(patches.row), bool)
    for one in range(patches.crossing.shape[1]):
        for other in range(one):
            pair = patches.crossing[:, one], patches.crossing[:, other]
            rows = np.flatnonzero((pair[0] >= 0) & (pair[1] >= 0))
            sharp[rows] |= _dot(normal[pair[0][rows]], normal[pair[1][rows]]) < SHARP_COSINE
    known = (trust[patches.crossing] >= LEAST_SLOPE_TRUST) | (patches.crossing < 0)
    return sharp & known.all(1)


def _is_supported(patches: Patches, planes: Planes) -> BoolArray:
    """Return which patches, (P,), have flat ground beside for the plane of every crossing."""
    known = (planes.trust[patches.crossing] >= LEAST_SUPPORT) | (patches.crossing < 0)
    return cast(BoolArray, known.all(1))


def _dilate(patches: Patches, chosen: BoolArray, rings: int, count: int) -> BoolArray:
    """Return which of ``count`` crossings lie within some rings of patches round chosen ones."""
    near: BoolArray = np.zeros(count, bool)
    there = patches.crossing >= 0
    for _ in range(rings):
        mine = patches.crossing[chosen]
        near[mine[mine >= 0]] = True
        chosen = cast(BoolArray, np.any(near[patches.crossing] & there, axis=1))
    return near


def settle_planes(patches: Patches, own: Planes) -> Planes:
    """Return a plane for every crossing: its own, or near features that of flat ground beside.

    In each round a crossing takes the mean of the planes of those with which it shares a patch,
    weighted by trust, by how alike the normals are, and by how near it lies to the plane.
    """
    one, other = _pairs(patches, len(own.trust))
    rough = np.zeros(len(own.trust))
    np.maximum.at(rough, one, 1 - _dot(own.normal[one], own.normal[other]))
    trust = own.trust / (1 + (rough / ROUGH) ** 2) ** 2 + LEAST_TRUST
    planes = Planes(own.point, own.normal, trust)
    for _ in range(ROUNDS):
        planes = _settle_once(planes, own, one, other)
    return planes


def _pairs(patches: Patches, count: int) -> tuple[Index, Index]:
    """Return every ordered pair of crossings that share a patch, once, in order."""
    pairs = []
    for one in range(patches.crossing.shape[1]):
        for other in range(patches.crossing.shape[1]):
            a, b = patches.crossing[:, one], patches.crossing[:, other]
            there = (a >= 0) & (b >= 0) & (a != b)
            pairs.append(a[there] * count + b[there])
    return tuple(np.divmod(np.unique(np.concatenate(pairs)), count))  # type: ignore[return-value]


def _settle_once(planes: Planes, own: Planes, one: Index, other: Index) -> Planes:
    """Return the planes after one round."""
    count, normal = len(planes.trust), planes.normal[other]
    off = _dot(own.point[one] - planes.point[other], normal)
    turned = (1 - _dot(planes.normal[one], normal)) / ALIGNED
    weight = planes.trust[other] / (1 + turned * turned) ** 2 / (1 + (off / OFF_PLANE) ** 2) ** 2
    total = np.bincount(one, weight, count)
    sums = [np.bincount(one, weight * normal[:, a], count) for a in range(3)]
    mean: Vectors = np.stack(sums, 1).astype(np.float64)
    mean = _unit(mean + planes.trust[:, None] * planes.normal)
    here = _dot(own.point - planes.point, planes.normal)
    height = (np.bincount(one, weight * off, count) + planes.trust * here) / (total + planes.trust)
    passed_on = np.bincount(one, weight * planes.trust[other], count) / (total + 1e-12)
    trust: NDArray[np.float64] = np.maximum(planes.trust, WEAKENING * passed_on)
    return Planes(own.point - height[:, None] * mean, mean, trust)


def _meet(patches: Patches, planes: Planes) -> Vectors:
    """Return the points nearest to all planes of each patch, kept near its cell, (P, 3)."""
    there = patches.crossing >= 0
    point, normal = planes.point[patches.crossing], planes.normal[patches.crossing]
    normal = normal * there[..., None]
    middle = (point * there[..., None]).sum(1) / patches.sides[:, None]
    matrix = np.einsum("pei,pej->pij", normal, normal)
    height = ((point - middle[:, None]) * normal).sum(2)
    right = (height[..., None] * normal).sum(1)
    values, vectors = np.linalg.eigh(matrix)
    inverse = np.where(values > RANK * values[:, -1:], 1 / np.maximum(values, 1e-9), 0)
    step = np.einsum("pij,pj->pi", vectors, inverse * np.einsum("pij,pi->pj", vectors, right))
    low = patches.low - OUTSIDE_CELL
    peaks: Vectors = np.clip(middle + step, low, low + 1 + 2 * OUTSIDE_CELL)
    return peaks


@dataclass(frozen=True, eq=False)
class Numbers:
    """The numbers of vertices: voxel by voxel, on edges that it owns, then of its features.

    Attributes
    ----------
    of_crossing : (n,) int64
        Of the vertex on each crossing.
    of_feature : (f,) int64
        Of the vertex of each feature.
    own : int
        How many belong to the field's own voxels.
    """

    of_crossing: Index
    of_feature: Index
    own: int


def _number_vertices(
    field: FineField, crossings: Crossings, patches: Patches, features: Index, first_vertex: int
) -> Numbers:
    """Number the vertices: the first of the field's own voxels is ``first_vertex``."""
    count, row = len(field.voxel_ijk) + 1, patches.row[features]
    edges = np.bincount(crossings.own_row, minlength=count)
    peaks = np.bincount(row, minlength=count)
    before = np.cumsum(edges + peaks) - edges - peaks
    core = field.own_rows
    own = int(before[core.stop] - before[core.start])
    check_count(first_vertex + own, "vertices")
    before += first_vertex - before[core.start]
    of_crossing = before[crossings.own_row] + _nth(crossings.own_row, edges)
    return Numbers(of_crossing, before[row] + edges[row] + _nth(row, peaks), own)


def _nth(row: NDArray[Any], counts: NDArray[Any]) -> Index:
    """Return the place of each entry among those of its row; rows come in order."""
    first: Index = np.cumsum(counts) - counts
    nth: Index = np.arange(len(row)) - first[row]
    return nth


def _within(row: IntArray, rows: slice) -> BoolArray:
    """Return which rows lie in a slice."""
    inside: BoolArray = (row >= rows.start) & (row < rows.stop)
    return inside


def _faces(field: FineField, patches: Patches, features: Index, numbers: Numbers) -> IntArray:
    """Return the triangles of the field's own voxels, in the order of their patches.

    A side between two fans becomes two triangles of the later patch.
    """
    peak_of = np.full(len(patches.row), -1, np.int64)
    peak_of[features] = numbers.of_feature
    parts = [
        _flat_faces(patches, peak_of < 0, numbers),
        *_fan_faces(patches, peak_of, features, numbers),
    ]
    patch = np.concatenate([rows for rows, _ in parts])
    faces = np.concatenate([triangles for _, triangles in parts])
    order = np.argsort(patch, kind="stable")
    order = order[_within(patches.row[patch[order]], field.own_rows)]
    return faces[order].astype(np.int32)


Triangles = tuple[Index, Index]
"""Patches (t,), and the numbers of the corners of a triangle of each, (t, 3)."""


def _flat_faces(patches: Patches, chosen: BoolArray, numbers: Numbers) -> Triangles:
    """Return the triangles of patches without a feature: those of marching cubes."""
    rows = np.flatnonzero(chosen)
    patch = np.repeat(rows, patches.sides[rows] - 2)
    nth = _nth(patch, np.bincount(patch, minlength=len(chosen)))
    corners = loop_table().triangles[patches.loop[patch], nth]
    crossing = np.take_along_axis(patches.crossing[patch], corners, 1)
    return patch, numbers.of_crossing[crossing]


def _fan_faces(
    patches: Patches, peak_of: Index, features: Index, numbers: Numbers
) -> Iterator[Triangles]:
    """Yield the triangles of patches with a feature: fans, and pairs across turned sides."""
    patch = np.repeat(features, patches.sides[features])
    nth = _nth(patch, np.bincount(patch, minlength=len(peak_of)))
    start = patches.crossing[patch, nth]
    end = patches.crossing[patch, (nth + 1) % patches.sides[patch]]
    one, other = _shared_sides(start, end, peak_of[patch])
    kept = np.ones(len(patch), bool)
    kept[one] = kept[other] = False
    corners = [numbers.of_crossing[start], numbers.of_crossing[end], peak_of[patch]]
    yield patch[kept], np.stack(corners, 1)[kept]
    a, b, peak, beyond = (
        corners[0][other],
        corners[1][other],
        peak_of[patch[other]],
        peak_of[patch[one]],
    )
    yield patch[other], np.stack([a, beyond, peak], 1)
    yield patch[other], np.stack([b, peak, beyond], 1)


def _shared_sides(start: Index, end: Index, peak: Index) -> tuple[Index, Index]:
    """Return the sides that two fans share, as rows of the earlier and of the later one.

    Two fans that share two sides, across an ambiguous face, keep both: turned, their vertices would
    be joined twice.
    """
    size = int(max(start.max(initial=0), end.max(initial=0))) + 1
    key, reverse = start * size + end, end * size + start
    order = np.argsort(key)
    partner = (
        order[np.minimum(np.searchsorted(key[order], reverse), len(key) - 1)] if len(key) else key
    )
    one = np.flatnonzero((key[partner] == reverse) & (np.arange(len(key)) < partner))
    other = partner[one]
    joined = peak[one] * (int(peak.max(initial=0)) + 1) + peak[other]
    _, index, times = np.unique(joined, return_inverse=True, return_counts=True)
    once = times[index] == 1
    return one[once], other[once]


def _unit(vectors: Vectors) -> Vectors:
    """Return vectors (n, 3) of length 1; 0 stays 0."""
    unit: Vectors = vectors / np.maximum(_length(vectors), 1e-12)[:, None]
    return unit


def _length(vectors: Vectors) -> NDArray[np.float64]:
    """Return the lengths of vectors (n, 3)."""
    length: NDArray[np.float64] = np.sqrt(_dot(vectors, vectors))
    return length


def _dot(a: Vectors, b: Vectors) -> NDArray[np.float64]:
    """Return the products of vectors (n, 3), summed in their order."""
    product: NDArray[np.float64] = a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]
    return product
