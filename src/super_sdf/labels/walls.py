"""Surfaces of several labels that share their walls, made of the labels' fine fields.

The label whose field is lowest holds a node of the fine lattice: in a tie the lower label, 0 last.
Label 0 is what is beside all others; its field is minus that of a label, unless two others or more
could hold the node, which no label can in a voxel round which no sample has it. A wall crosses the
edge between nodes of two labels where their fields are equal, by linear interpolation: both labels
get the very same vertex. So each surface is closed, and there is neither gap nor overlap.

A point is named by its place in the lattice of half the fine spacing; further points in a cell have
that of its middle, and a number above all places. How walls run in a cell follows from the labels
at its corners. On a face with two labels it runs as in ``surface.cell_cases``. Where three or four
meet, the point where their fields are equal is joined to all crossed edges, unless opposite corners
have the same label: they are joined, and each of the others is cut off. Both cells beside it agree.

These segments part the surface of the cell into regions, each of one label. A loop between two
labels is cut into triangles as in ``cell_cases``. Segments that hang together by points on faces
are joined to a point in the cell. A label with two regions round them would have two fans of
triangles at that point, so one of the two is cut off by a point of its own, between its corners.
That cannot be done where a label is beside the region twice.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from ..arrays import CORNERS, BoolArray, FloatArray, Index, IntArray, Vectors, sums_at
from ..refine.nodes import VoxelIndex, block_ijk
from ..simplify.walls import Walls
from ..surface.cell_cases import EDGE_BETWEEN, triangulate
from ..surface.marching import CAP_HEIGHT, FACES, cells_low_nodes, strides
from ..surface.mesh import CLEARANCE

# The numbers of points: first those of the twelve edges, then those on faces, then in the cell.
FACE_POINTS, CELL_POINTS, MOST_POINTS = 12, 18, 26
EDGE_ENDS = np.array([sorted(ends) for ends in EDGE_BETWEEN]).T  # corners, (2, 12)
ON_FACES = [CORNERS[list(face)].sum(0) // 2 for face in FACES]
IN_CELL = np.ones((MOST_POINTS - CELL_POINTS, 3), int)
# Where the points are in a cell of two steps along each axis, (26, 3).
PLACES = np.concatenate([CORNERS[EDGE_ENDS].sum(0), ON_FACES, IN_CELL])
BESIDE = 0.1  # fine spacings from the edges of a face to a point on it, at least

Labels = NDArray[np.int16]
FieldOfLabel = tuple[Index, FloatArray, BoolArray]
"""Voxels as ascending rows, (n,), their blocks, (Q, n), and which parts it could hold, (27, n)."""
Segment = tuple[int, int, int, int]
"""Two points, and the labels inside and outside: the higher is inside, counter-clockwise."""
Sides = dict[tuple[int, int], int]
"""The label beside each segment, in the direction in which its region is inside."""


@dataclass(frozen=True, eq=False)
class Labelled:
    """The fields of some labels at the nodes of the voxels in which their walls can be."""

    shape: tuple[int, int, int]  # samples of the grid along each axis
    factor: int  # K
    index: VoxelIndex  # finds the row of a voxel, counted from (-1, -1, -1)
    voxel_ijk: IntArray  # (D, 3), the voxels, in C order, also beyond the border: closed there
    holder: Labels  # (Q, D), the label of each node
    # of label 0 values are NaN, or missing, where they are minus those of any other
    fields: dict[int, FieldOfLabel]

    def apart(self, low: Index, corner: NDArray[np.intp], holder: Labels, other: Labels) -> Vectors:
        """Return by how much the field of a node's holder is lower than that of another, (k, n).

        The nodes are some corners, (k, n), of cells with low nodes (n, 3).
        """
        voxel = np.clip(low // self.factor, 0, np.array(self.shape) - 1)
        node_ijk = np.clip(low - self.factor * voxel + CORNERS[corner], 0, self.factor)
        place = node_ijk @ strides(self.factor)
        row, values = self.index.find(voxel + 1), np.full((2, *holder.shape), np.nan)
        for label, (rows, blocks, _) in self.fields.items():
            for value, own in zip(values, (holder, other)):
                node, cell = np.nonzero(own == label)
                at = np.minimum(np.searchsorted(rows, row[cell]), len(rows) - 1)
                found = blocks[place[node, cell], at]
                value[node, cell] = np.where(rows[at] == row[cell], found, np.nan)
        held, others = np.where(np.isnan(values), -values[::-1], values)
        return np.asarray(np.fmax(others - held, 0))  # what cannot hold a node may be lower


def extract_walls(field: Labelled) -> Walls:
    """Return the walls of all labels, in fine spacings from node (0, 0, 0)."""
    # the low nodes of the cells that a wall crosses, (n, 3), and their labels, (n, 8)
    node, corners = cells_low_nodes(field.factor), CORNERS @ strides(field.factor)
    is_crossed = np.zeros((len(node), len(field.voxel_ijk)), bool)
    for corner in corners[1:]:
        is_crossed |= field.holder[node + corner] != field.holder[node]
    row, nth = np.nonzero(is_crossed.T)
    label = field.holder[node[nth, None] + corners, row[:, None]]
    low = field.factor * field.voxel_ijk[row].astype(np.int64) + block_ijk(field.factor)[node[nth]]

    # of the lattice of half the fine spacing, a voxel beyond the grid to every side
    nx, ny, nz = (2 * field.factor * (n + 2) + 1 for n in field.shape)
    along = np.array([ny * nz, nz, 1], np.int64)
    steps = PLACES @ along
    steps[CELL_POINTS:] += nx * ny * nz * np.arange(len(PLACES) - CELL_POINTS)
    base = 2 * (low + field.factor) @ along

    # the triangles of each cell's case, by the names of their points
    case, of_cell = np.unique(_cases(field, low, label), return_inverse=True)
    tables = [_walls_of_cell(int(number) & (1 << 24) - 1, int(number) >> 24) for number in case]
    cell = np.repeat(np.arange(len(base)), [len(tables[nth]) for nth in of_cell])
    table = np.concatenate([np.empty((0, 5), np.int32), *(tables[nth] for nth in of_cell)])
    names, sides = base[cell, None] + steps[table[:, :3]], label[cell[:, None], table[:, 3:]]
    first, faces = np.unique(names, return_index=True, return_inverse=True)[1:]
    kind, cell, faces = table[:, :3].ravel()[first], cell[first // 3], faces.reshape(-1, 3)
    return Walls(_places(field, low[cell], label[cell], kind, faces), faces.astype(np.int32), sides)


def _places(field: Labelled, low: Index, label: Labels, kind: IntArray, faces: Index) -> Vectors:
    """Return the points of faces, in fine spacings, (n, 3), by their cells and numbers there.

    A point in a cell is the mean of those on its faces. These move once to the mean of the points
    in cells beside them: the line on which labels meet has teeth otherwise, near lattice edges.
    """
    middle = low + PLACES[kind] / 2
    rank = np.digitize(kind, (FACE_POINTS, CELL_POINTS))  # 0 on edges, 1 on faces, 2 in cells
    within = ((middle >= 0) & (middle <= field.factor * np.array(field.shape))).all(1)
    places, edge, face = np.zeros(low.shape), rank == 0, (rank == 1) & within
    places[edge] = _on_edges(field, low[edge], EDGE_ENDS[:, kind[edge]], label[edge])
    corner = np.array(FACES)[kind[face] - FACE_POINTS].T
    places[face] = _on_faces(field, low[face], corner, label[face])

    joined = faces[rank[faces].any(1)]
    pairs = np.concatenate([joined[:, ends] for ends in permutations(range(3), 2)])
    alone, reach = rank == 2, (0.5 - BESIDE) * (PLACES[kind] == 1)
    alone[pairs[(rank[pairs] == 2).all(1)]] = False  # joined to others in their cell
    for some, by in ((rank > 0) & ~face, 0), (alone, 1), (face, 2), (alone, 1):
        point, other = pairs[some[pairs[:, 0]] & (rank[pairs[:, 1]] == by)].T
        times = np.maximum(np.bincount(point, minlength=len(low)), 1)
        places[some] = (sums_at(point, places[other], len(low)) / times[:, None])[some]
        places[face] = np.clip(places, middle - reach, middle + reach)[face]
    return places


def _cases(field: Labelled, low: Index, label: Labels) -> Index:
    """Return the case of each cell: the ranks of its labels, and which faces join.

    A face joins its corners with the higher label where the difference of the labels' fields,
    interpolated bilinearly, is so at its saddle: see ``marching.choose_cases``.
    """
    case = np.zeros(len(low), np.int64)
    for other in label.T:
        case += (label > other[:, None]) @ (1 << 3 * np.arange(8))
    for n, face in enumerate(FACES):
        a, b, c, d = label[:, face].T
        unsure = np.flatnonzero((a == c) & (b == d) & (a != b))
        holder = label[unsure][:, face].T
        apart = field.apart(low[unsure], np.array(face)[:, None], holder, np.roll(holder, 1, 0))
        one, other = apart[::2].prod(0), apart[1::2].prod(0)
        joined = np.where(a[unsure] > b[unsure], one > other, other > one)
        case[unsure] |= joined.astype(np.int64) << (24 + n)
    return case


def _on_edges(field: Labelled, low: Index, corner: NDArray[np.intp], label: Labels) -> Vectors:
    """Return the points on edges between two corners, (2, n), half-way beyond the border."""
    holder = np.take_along_axis(label, corner.T, 1).T
    ends, last = low + CORNERS[corner], field.factor * np.array(field.shape)
    within = ((ends >= 0) & (ends <= last)).all((0, 2))
    one, total = np.cumsum(field.apart(low, corner, holder, holder[::-1]), 0)
    share = np.where(within & (total > 0), one / np.where(total > 0, total, 1), 0.5)
    begin, stop = np.clip(ends.astype(float), -CAP_HEIGHT, last + CAP_HEIGHT)
    return np.asarray(begin + np.clip(share, CLEARANCE, 1 - CLEARANCE)[:, None] * (stop - begin))


def _on_faces(field: Labelled, low: Index, corner: NDArray[np.intp], label: Labels) -> Vectors:
    """Return where the labels at all corners of faces, (4, n), are equal, by planes as fields."""
    holder = np.take_along_axis(label, corner.T, 1).T
    others = (np.broadcast_to(other, holder.shape) for other in holder)
    apart = np.stack([field.apart(low, corner, holder, other) for other in others], 1).T
    apart = apart - apart.mean(1, keepdims=True)  # (n, labels, corners)
    ends = CORNERS[corner.T]
    middle = ends.mean(1, keepdims=True)
    step = np.linalg.pinv(apart @ (ends - middle), 1e-3) @ apart.mean(2, keepdims=True)
    return np.asarray(low + middle[:, 0] - step[..., 0])


@lru_cache(maxsize=1 << 14)
def _walls_of_cell(ranks: int, joined: int) -> IntArray:
    """Return the triangles of a case, (n, 5): three points, and a corner on either side.

    Of ``ranks`` three bits are for each corner: how many corners have a lower label. ``joined``
    has a bit for each face with two labels at the ends of its diagonals: whether it joins those of
    the higher. Triangles are counter-clockwise seen from the second corner, whose label is lower.
    A point in the cell is the last of its triangle.
    """
    label = [ranks >> 3 * corner & 7 for corner in range(8)]
    rows = [row for n in range(6) for row in _segments_on(n, label, joined >> n & 1)]
    found, free = list[tuple[int, ...]](), iter(range(CELL_POINTS, MOST_POINTS))
    while rows:
        loop, points, some = [rows[-1][0]], {rows[-1][0]}, []
        while more := [row for row in rows if points & set(row[:2])]:  # all that hang together
            some += more
            points |= {point for row in more for point in row[:2]}
            rows = [row for row in rows if row not in more]
        if max(points) >= FACE_POINTS:
            found += _joined(some, free)
            continue
        after = {start: end for start, end, *_ in some}
        while (point := after[loop[-1]]) != loop[0]:
            loop.append(point)
        found += [(*triangle, *some[0][2:]) for triangle in triangulate(tuple(loop))]
    faces = [(*abc, label.index(high), label.index(low)) for *abc, high, low in found]
    return np.array(faces, np.int32).reshape(-1, 5)


def _segments_on(n: int, label: list[int], joined: int) -> Iterator[Segment]:
    """Yield the segments on a face of a cell with these labels at its corners."""
    a, b, c, d = of = [label[corner] for corner in FACES[n]]
    edge = [EDGE_BETWEEN[frozenset((FACES[n][at - 1], FACES[n][at]))] for at in range(4)]
    crossed = [at for at in range(4) if of[at] != of[at - 1]]
    if a == c or b == d:  # two corners are joined, and each of the others is cut off
        first = int(a == c and (b != d or (b > a) != joined))
        cut = sorted((first, first + 2), key=lambda at: (at + joined) % 4)
        found = [(edge[at], edge[(at + 1) % 4], at) for at in cut if at in crossed]
    elif len(crossed) == 2:
        found = [(edge[crossed[0]], edge[crossed[1]], crossed[0])]
    else:
        found = [(edge[at], FACE_POINTS + n, at) for at in crossed]
    for start, end, at in found:
        one, other = of[at], of[at - 1]
        yield (start, end, one, other) if one > other else (end, start, other, one)


def _joined(rows: list[Segment], free: Iterator[int]) -> Iterator[tuple[int, ...]]:
    """Yield triangles, and the labels beside them, that join segments to ``free`` points."""
    sides: Sides = {}
    for start, end, one, other in rows:
        sides[start, end], sides[end, start] = one, other
    while region := _region_to_cut(sides):
        inside, point = sides[region[0]], next(free)
        beside = [sides[end, start] for start, end in region]
        for at, (start, end) in enumerate(region):
            outside, before = beside[at], beside[at - 1]
            del sides[start, end], sides[end, start]
            ends = (start, end) if inside > outside else (end, start)
            yield (*ends, point, max(inside, outside), min(inside, outside))
            if before != outside:  # what is left beside the region meets at its point
                sides[point, start], sides[start, point] = outside, before
    point = next(free)
    for (start, end), one in sides.items():
        if one > (other := sides[end, start]):
            yield start, end, point, one, other


def _region_to_cut(sides: Sides) -> list[tuple[int, int]]:
    """Return the segments round the smallest region that has to be cut off, and can be, if any."""
    after = {(label, start): end for (start, end), label in sides.items()}
    regions: dict[int, list[list[tuple[int, int]]]] = {}
    while after:
        (label, first), point = after.popitem()
        region = [(first, point)]
        while point != first:
            region.append((point, after.pop((label, point))))
            point = region[-1][1]
        regions.setdefault(label, []).append(region)
    several = [region for some in regions.values() if len(some) > 1 for region in some]
    for region in sorted(several, key=len):
        beside = [sides[end, start] for start, end in region]
        runs = sum(beside[at - 1] != outside for at, outside in enumerate(beside))
        if runs == len(set(beside)) > 1:
            return region
    return []
