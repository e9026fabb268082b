"""Planes of the surface at its crossings with lattice edges, as the faces beside an edge have them.

    own      the field's gradient at both ends of the lattice edge, from differences that do not
             straddle a kink
    settled  near edges, the planes of crossings on flat ground replace those of crossings beside
             the kink, where the field is rounded off, step by step

The planes of a patch meet in a line or in a point: a wedge. The foot point of a sample in the cone
of normals of an edge, outside a convex one or inside a concave one, lies on the edge: ``lean``
moves the wedge's point so that planes and spheres agree. Of wedges, positions and lengths are in
coarse spacings, so sample (i, j, k) is at (i + 1/2, j + 1/2, k + 1/2), and vectors in columns.

References: Harten, Engquist, Osher and Chakravarthy, "Uniformly High Order Accurate Essentially
Non-Oscillatory Schemes", 1987, for the differences; Sellán, Batty and Stein, "Reach For the
Spheres", 2023, for wedges.

Positions are in fine spacings, from node (0, 0, 0) of the fine lattice.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...arrays import (
    CENTRE,
    STRIDES,
    BoolArray,
    Index,
    IntArray,
    Numbers,
    Vectors,
    dot,
    inner,
    unit,
)
from ...refine.bounds import SampleSpheres
from ...refine.field import FineField
from ...refine.nodes import block_ijk
from ...threads import chunks_of, map_chunks, over_threads, worthwhile_threads
from ..marching import Crossings, edge_ends, lattice_positions, values_at
from .patches import Patches

ROUNDS = 4  # in each, every crossing looks at those it shares a patch with
ROUGH = 0.02  # 1 - cosine of normals in a patch from which a crossing is not trusted
ALIGNED = 0.125  # 1 - cosine up to which planes count as the same
OFF_PLANE = 0.12  # fine spacings up to which a crossing is taken to lie on a plane
SLOPE_ERROR = 0.15  # of the field's slope, 1 for a distance, up to which a normal is trusted
WEAKENING = 0.7  # of the trust in a plane, from crossing to crossing
LEAST_TRUST = 1e-4
SETTLED = 0.3  # trust from which a crossing keeps its own plane, unless ...
SMOOTHED_RINGS = 1  # ... it lies within these of one that does not
PAIR_TEMPORARIES = 48  # numbers per crossing of a patch in a round
TEMPORARIES = 64  # numbers per crossing in the computation of its plane

# Of wedges, in coarse spacings:
ALONG = 0.6  # distance along an edge at which a sphere counts for a quarter
FARTHEST_ALONG = 1.8
CLOSE_BY = 0.3  # distance along an edge within which no sphere may be pierced: see ``Contact``
OFF_SPHERE = 0.05  # distance from a sphere at which it counts for half
FARTHEST_SPHERE = 0.3
LARGEST_RADIUS = 1.4  # samples near the band's edge, 1.5, may have been truncated there
LEAST_RADIUS = 0.05  # of spheres: of smaller ones the direction is unknown
PIERCED = 0.02  # by which a sphere outside the cone must be pierced to count
TOUCHING = 0.04  # from a sphere at which it is touched ...
TOUCHED_ALONG = 1.0  # ... if it is within this distance along the edge
ITERATIONS = 3
LONGEST_STEP = 0.25
RANK = 0.05  # eigenvalues below this share of the largest leave a direction open
NEAR = 2  # voxels to each side whose samples are looked at


@dataclass(frozen=True, eq=False)
class Planes:
    """A plane at each crossing."""

    point: Vectors  # (n, 3), on the plane; at first where the surface crosses the lattice edge
    # (n, 3), of unit length; at first of the nearer end of the edge if the ends disagree
    normal: Vectors
    # (n,), 1 where the field is a distance, less where its slope is not 1, or the ground not flat
    trust: Numbers


def planes_at_crossings(
    field: FineField, crossings: Crossings, chosen: Index, border: IntArray, threads: int = 1
) -> Planes:
    """Return the planes on chosen ones of the crossed edges that voxels own, by the field alone.

    Normals are between the gradients at both ends, in which they trust if the slope is about 1.
    """
    planes = Planes(np.empty((len(chosen), 3)), np.empty((len(chosen), 3)), np.empty(len(chosen)))
    size, nodes = len(field.blocks), block_ijk(field.factor)

    def fill(some: slice) -> None:
        row, edge = crossings.own_row.take(chosen[some]), crossings.own_edge.take(chosen[some])
        axis, node = np.divmod(edge.astype(np.int64), size)
        position = lattice_positions(field, row, edge, border)
        start = field.factor * field.voxel_ijk.take(row, 0) + nodes.take(node, 0)
        share = np.clip(np.choose(axis, position - start.T), 0, 1)
        width = int(row[-1] - row[0]) + 1  # a node at the end of many edges is worked on once
        ends = np.stack([node, edge_ends(field.factor).take(edge)]) * width + (row - row[0])
        number = np.zeros(size * width, np.int32)
        number[ends] = 1
        at = np.flatnonzero(number)
        number[at] = np.arange(len(at))
        ends = number.take(ends)
        node, row = np.divmod(at, width)[0], row[0] + at % width
        gradient = _gradient(field, row, node)
        slope = np.sqrt(inner(gradient, gradient))
        trust = (square_falloff((slope - 1) / SLOPE_ERROR) + LEAST_TRUST).take(ends)
        low, high = np.moveaxis(gradient.take(ends, 1), 1, 0)
        weight = (1 - share) * trust[0], share * trust[1]
        first, second = np.moveaxis((gradient / np.maximum(slope, 1e-12)).take(ends, 1), 1, 0)
        mean = low * weight[0] + high * weight[1]
        nearer = np.where(weight[0] >= weight[1], low, high)
        planes.point[some] = position.T
        planes.normal[some] = unit(np.where(inner(first, second) > 0.9, mean, nearer).T)
        planes.trust[some] = np.maximum(*trust)

    map_chunks(fill, len(chosen), TEMPORARIES, threads)
    return planes


def square_falloff(off: Numbers, other: Numbers | float = 0.0) -> Numbers:
    """Return 1 at 0 and a quarter at 1: rational, so that every system computes the same.

    Times that of another distance.
    """
    falloff: Numbers = 1 / ((1 + off * off) * (1 + other * other)) ** 2
    return falloff


def _gradient(field: FineField, row: NDArray[np.intp], node: NDArray[np.intp]) -> Vectors:
    """Return the field's gradient at nodes of blocks, (3, n); 1 is the slope of a distance.

    Along each axis by the parabola through three of five nodes that bends least: it does not
    straddle a kink. It is 0 where all three have missing values.
    """
    gradient, c = np.empty((3, len(row))), values_at(field, node, row).astype(np.float64)
    table = np.ascontiguousarray(field.parts.table).ravel()
    for axis, (place, end) in enumerate(_walks(field.factor)):
        beside = table.take(place.take(node, 1) * len(field.voxel_ijk) + row)
        values = values_at(field, end.take(node, 1), beside).astype(np.float64)
        values[beside < 0] = np.nan  # there is no block
        a, b, d, e = values
        least, slope = np.full(len(c), np.inf), np.zeros(len(c))
        for bend, own in (
            (c - 2 * b + a, 1.5 * c - 2 * b + 0.5 * a),
            (d - 2 * c + b, 0.5 * (d - b)),
            (e - 2 * d + c, 2 * d - 1.5 * c - 0.5 * e),
        ):
            bend = np.abs(bend)
            better = bend < least  # never of NaN
            np.copyto(least, bend, where=better)
            np.copyto(slope, own, where=better)
        gradient[axis] = slope
    return gradient * (field.factor / 2)


@lru_cache
def _walks(factor: int) -> list[tuple[Index, Index]]:
    """Return the neighbours, (4, Q), and nodes -2, -1, 1 and 2 nodes away along each axis."""
    side = factor + 1

    def walk(axis: int, step: int) -> Index:
        ijk = block_ijk(factor).astype(np.int64)
        ijk[:, axis] += step
        beyond = np.where(ijk[:, axis] > factor, 1, np.where(ijk[:, axis] < 0, -1, 0))
        ijk[:, axis] -= factor * beyond
        end = (ijk[:, 0] * side + ijk[:, 1]) * side + ijk[:, 2]
        return np.stack([CENTRE + int(STRIDES[axis]) * beyond, end])

    walks = (np.stack([walk(axis, step) for step in (-2, -1, 1, 2)], 1) for axis in range(3))
    return [(place, end) for place, end in walks]


def settle_planes(patches: Patches, own: Planes, threads: int = 1) -> Planes:
    """Return a plane for every crossing: its own, or that of flat ground beside it.

    In each round a crossing takes the mean of the planes of those with which it shares a patch,
    weighted by trust, by how alike the normals are, and by how near it lies to the plane. Two that
    share two patches count twice.
    """
    loops = [  # the crossings of the patches with 3 sides, with 4, and so on, (S, p) each
        np.ascontiguousarray(patches.crossing[patches.sides == sides, :sides].T)
        for sides in range(3, patches.crossing.shape[1] + 1)
    ]
    normal, point = np.ascontiguousarray(own.normal.T), np.ascontiguousarray(own.point.T)
    trust = own.trust * square_falloff(_roughness(normal, loops) / ROUGH) + LEAST_TRUST
    near = patches.dilate(patches.having(trust < SETTLED), SMOOTHED_RINGS, len(trust))
    chunks = [
        np.ascontiguousarray(loop[:, some])
        for loop in (loop.compress(near[loop].any(0), 1) for loop in loops)
        for some in chunks_of(loop.shape[1], PAIR_TEMPORARIES * len(loop))
    ]
    if not chunks:
        return Planes(own.point, own.normal, trust)
    rows, crossing = np.flatnonzero(near), np.concatenate([loop.ravel() for loop in chunks])
    table = np.concatenate([normal, [dot(own.point, own.normal), trust]])
    work = [(point.take(loop, 1), loop) for loop in chunks]
    start = point.take(rows, 1)
    placed = start.copy()
    threads = worthwhile_threads(PAIR_TEMPORARIES * len(crossing), threads)
    for _ in range(ROUNDS):
        sums = np.concatenate(list(over_threads(partial(_sums_in_loops, table), work, threads)), 1)
        total, off, passed_on, *mean = (
            np.bincount(crossing, each, len(trust)).take(rows) for each in sums
        )
        mine, trusted = table[:3].take(rows, 1), table[4].take(rows)
        normal = unit((np.stack(mean) + trusted * mine).T).T
        height = (off + trusted * inner(start - placed, mine)) / (total + trusted)
        placed = start - height * normal
        trusted = np.maximum(trusted, WEAKENING * passed_on / (total + 1e-12))
        table[:, rows] = *normal, inner(placed, normal), trusted
    point[:, rows] = placed
    return Planes(point.T.copy(), table[:3].T.copy(), table[4])


def _roughness(normal: Vectors, loops: list[Index]) -> Numbers:
    """Return the largest 1 - cosine of normals in the patches of each crossing, (n,)."""
    rough: Numbers = np.zeros(normal.shape[1])
    for loop in loops:
        mine, largest = normal.take(loop, 1), np.zeros(loop.shape)
        for turn in range(1, len(loop) // 2 + 1):  # a pair is met from both sides
            bend = 1 - inner(mine, np.roll(mine, turn, axis=1))
            np.maximum(largest, np.maximum(bend, np.roll(bend, -turn, axis=0)), out=largest)
        np.maximum.at(rough, loop.ravel(), largest.ravel())
    return rough


def _sums_in_loops(table: Vectors, work: tuple[Vectors, Index]) -> Vectors:
    """Return for each crossing of patches (S, p) sums over the others of its patch, (6, S p).

    Of the weights, and weighted: how far it lies off their planes, their trust, their normals. The
    ``table`` has the normal, height and trust of each plane, (5, n); ``work`` are the positions and
    the numbers of the crossings.
    """
    start, loop = work
    sides, sums, here = len(loop), np.zeros((6, *loop.shape)), table.take(loop, 1)
    twice = np.concatenate([here, here[:, :-1]], 1)  # so that the next ones follow each other
    bends: list[Numbers] = []
    for turn in range(1, sides):
        other = twice[:, turn : turn + sides]
        off = inner(start, other[:3]) - other[3]
        if turn <= sides // 2:
            bends.append((1 - inner(here[:3], other[:3])) / ALIGNED)
        back = sides - turn  # the pair is the same from the other side
        bend = bends[turn - 1] if turn <= back else np.roll(bends[back - 1], back, axis=0)
        weight = other[4] * square_falloff(bend, off / OFF_PLANE)
        sums[0] += weight
        sums[1] += weight * off
        sums[2] += weight * other[4]
        sums[3:] += weight * other[:3]
    return sums.reshape(6, -1)


class Wedges(NamedTuple):
    """Where two or more faces meet, one for each of some patches."""

    point: Vectors  # (3, f), on the edge, or the corner
    tangent: Vectors  # (3, f), direction of the edge; 0 at a corner, where three faces or more meet
    sides: Vectors  # (2, 3, f), the two normals that differ most
    cosine: Numbers  # (f,), of the angle between these
    # (f,), 1 if the solid fills less than half of the space round the edge, -1 if it fills more
    convex: Numbers
    # (f, 3, 3), mean of the squares of the normals: how the planes hold the point
    stiffness: Vectors


class Nearby(NamedTuple):
    """Pairs of a wedge and a sphere that passes near it, in the order of the wedges.

    Columns of wedges stand here once for each pair, vectors as (3, n).
    """

    wedge: Index  # (n,)
    centre: Vectors  # the sample
    radius: Numbers
    tangent: Vectors
    outward: Vectors  # (2, 3, n), the sides of the wedge, turned to where the spheres are
    cosine: Numbers
    may_touch: BoolArray  # whether it is an edge, and the sample on the side where the cone is


class Contact(NamedTuple):
    """How spheres stand to the edges that they are near."""

    direction: Vectors  # (3, n), from the sample to the edge, of unit length
    along: Numbers  # (n,), distance along the edge
    gap: Numbers  # (n,), distance from the sphere to the edge, negative if it is pierced
    in_cone: BoolArray  # (n,), whether it must touch the edge, by the normals of the two faces
    # (n,), whether it may not be pierced: further on, the edge may have ended or turned
    is_close: BoolArray


def wedges_of(point: Vectors, normal: Vectors, there: BoolArray) -> Wedges:
    """Return the wedges of patches, at the points nearest to all planes of each.

    A plane is given by a point and a normal, (3, S, f) each; ``there``, (S, f), says which are.
    Normals of the others must be 0.
    """
    count = there.sum(0)
    stiffness = np.stack([(normal[i] * normal).sum(1) for i in range(3)]) / count
    values, vectors = np.linalg.eigh(np.moveaxis(stiffness, 2, 0))
    middle = (point * there).sum(1) / count
    right = (inner(point - middle[:, None], normal) * normal).sum(1) / count
    inverse = np.where(values > RANK * values[:, -1:], 1 / np.maximum(values, 1e-9), 0)
    step = np.einsum("pij,pj->pi", vectors, inverse * np.einsum("pij,ip->pj", vectors, right))
    peak = middle + step.T
    pairs = list(combinations(range(len(there)), 2))
    cosines = [
        np.where(there[i] & there[j], inner(normal[:, i], normal[:, j]), 2) for i, j in pairs
    ]
    one, other = np.array(pairs)[np.argmin(cosines, axis=0)].T
    row = np.arange(len(count))
    first, second = normal[:, one, row], normal[:, other, row]
    above = inner(point[:, one, row] - peak, second) + inner(point[:, other, row] - peak, first)
    convex = np.where(above < 0, 1.0, -1.0)
    corner = values[:, 0] > RANK * values[:, -1]
    tangent = np.where(corner, 0, vectors[:, :, 0].T)
    sides = np.stack([first, second])
    return Wedges(peak, tangent, sides, inner(first, second), convex, np.moveaxis(stiffness, 2, 0))


def find_spheres(wedges: Wedges, voxel: IntArray, spheres: SampleSpheres) -> Nearby:
    """Return the spheres that pass within ``FARTHEST_SPHERE`` of each wedge's edge.

    Wedges of a ``voxel``, (f, 3), follow each other, and have the same samples around.
    """
    first = np.append(True, np.any(np.diff(voxel, axis=0) != 0, axis=1))[: len(voxel)]
    number = samples_around(voxel[first], spheres)
    radius = np.abs(spheres.distance) / 2
    usable, of_wedge = (number >= 0) & (radius < LARGEST_RADIUS)[number], np.cumsum(first) - 1
    steps = np.indices((2 * NEAR + 1,) * 3).reshape(3, -1) - float(NEAR)
    start = wedges.point - voxel.T - 0.5
    along = inner(start, wedges.tangent)[:, None] - wedges.tangent.T @ steps
    across = inner(start, start)[:, None] - 2 * start.T @ steps + inner(steps, steps) - along**2
    off = np.sqrt(np.maximum(across, 0))
    off -= np.where(usable, radius[number], np.inf).take(of_wedge, 0)
    kept = (np.abs(off) < FARTHEST_SPHERE) & (np.abs(along) < FARTHEST_ALONG)
    wedge, place = np.nonzero(kept)
    number = number[of_wedge[wedge], place]
    centre = np.stack(np.unravel_index(spheres.number[number], spheres.shape)) + 0.5
    tangent, convex = wedges.tangent.take(wedge, 1), wedges.convex[wedge]
    may_touch = (np.sign(spheres.distance[number]) == convex) & tangent.any(0)
    outward = -convex * wedges.sides.take(wedge, 2)
    columns = centre, radius[number].astype(np.float64), tangent, outward, wedges.cosine[wedge]
    return Nearby(wedge, *columns, may_touch)


def samples_around(voxel: IntArray, spheres: SampleSpheres) -> Index:
    """Return the numbers of the exact samples within ``NEAR`` of voxels (v, 3), -1 for none.

    A line of them along the last axis is searched for at once: (v, 125).
    """
    keys, (nx, ny, nz) = spheres.number, spheres.shape
    di, dj = np.indices((2 * NEAR + 1,) * 2).reshape(2, -1) - NEAR
    i, j, k = voxel[:, 0, None] + di, voxel[:, 1, None] + dj, voxel[:, 2, None]
    line = (i * ny + j) * nz
    start = np.searchsorted(keys, line + np.maximum(k - NEAR, 0))
    number = start[..., None] + np.arange(2 * NEAR + 1)
    there = ((i >= 0) & (i < nx) & (j >= 0) & (j < ny))[..., None] & (number < len(keys))
    place = keys.take(number, mode="clip") - (line + k - NEAR)[..., None]
    there &= place <= (np.minimum(nz - 1 - k, NEAR) + NEAR)[..., None]
    found = np.flatnonzero(there)
    around = np.full(number.size, -1)
    around[found - found % (2 * NEAR + 1) + place.ravel()[found]] = number.ravel()[found]
    return around.reshape(len(voxel), -1)


def contact_of(point: Vectors, near: Nearby) -> Contact:
    """Return how spheres stand to edges at points (3, f); none must touch a corner."""
    away = point.take(near.wedge, 1) - near.centre
    along = inner(away, near.tangent)
    across = away - along * near.tangent
    apart = np.sqrt(inner(across, across))
    direction = across / np.maximum(apart, 1e-12)
    first, second = inner(direction, near.outward[0]), inner(direction, near.outward[1])
    in_cone = (first > near.cosine * second) & (second > near.cosine * first)
    in_cone &= near.may_touch & (apart > LEAST_RADIUS)
    return Contact(direction, along, apart - near.radius, in_cone, np.abs(along) < CLOSE_BY)


def lean(wedges: Wedges, near: Nearby) -> Vectors:
    """Return the points, (3, f), at which planes and spheres agree best, by least squares."""
    point, count, wedge = wedges.point, wedges.point.shape[1], near.wedge
    tangent = wedges.tangent.T
    hold = wedges.stiffness + 1e-3 * np.eye(3) + 1e3 * tangent[:, :, None] * tangent[:, None, :]
    for _ in range(ITERATIONS):
        direction, along, gap, in_cone, is_close = contact_of(point, near)
        counts = in_cone | (is_close & (gap < -PIERCED))
        weight = counts * square_falloff(along / ALONG) / (1 + (gap / OFF_SPHERE) ** 2)
        pull = np.einsum("pij,jp->pi", wedges.stiffness, wedges.point - point)
        stiff = hold.copy()
        for i in range(3):
            pull[:, i] -= np.bincount(wedge, weight * gap * direction[i], count)
            for j in range(i + 1):
                total = np.bincount(wedge, weight * direction[i] * direction[j], count)
                stiff[:, i, j] += total
                if i != j:
                    stiff[:, j, i] += total
        step = np.linalg.solve(stiff, pull[..., None])[..., 0].T
        point = point + np.clip(step, -LONGEST_STEP, LONGEST_STEP)
    return point
