"""Planes of the surface at its crossings with lattice edges, as the faces beside an edge have them.

    own      the field's gradient at both ends of the lattice edge, from differences that do not
             straddle a kink
    settled  near edges, the planes of crossings on flat ground replace those of crossings beside
             the kink, where the field is rounded off, step by step

Reference: Harten, Engquist, Osher and Chakravarthy, "Uniformly High Order Accurate Essentially
Non-Oscillatory Schemes", 1987, for the differences.

Positions are in fine spacings, from node (0, 0, 0) of the fine lattice.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from ...arrays import CENTRE, STRIDES, Index, IntArray, Numbers, Vectors, dot, length, unit
from ...refine.field import FineField
from ...refine.nodes import block_ijk
from ...threads import chunks_of, map_chunks, map_threads, worthwhile_threads
from ..marching import Crossings, edge_ends, lattice_positions
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


@dataclass(frozen=True, eq=False)
class Planes:
    """A plane at each crossing."""

    point: Vectors  # (n, 3), on the plane; at first where the surface crosses the lattice edge
    # (n, 3), of unit length; at first of the nearer end of the edge if the ends disagree
    normal: Vectors
    # (n,), 1 where the field is a distance, less where its slope is not 1, or the ground not flat
    trust: Numbers

    @cached_property
    def height(self) -> Numbers:
        """How far each plane lies from node (0, 0, 0), along its normal, (n,)."""
        return dot(self.point, self.normal)


def planes_at_crossings(
    field: FineField, crossings: Crossings, chosen: Index, border: IntArray, threads: int = 1
) -> Planes:
    """Return the planes on chosen ones of the crossed edges that voxels own, by the field alone.

    Normals are between the gradients at both ends, in which they trust if the slope is about 1.
    """
    planes = Planes(np.empty((len(chosen), 3)), np.empty((len(chosen), 3)), np.empty(len(chosen)))
    size = len(field.blocks)

    def fill(some: slice) -> None:
        row, edge = crossings.own_row[chosen[some]], crossings.own_edge[chosen[some]]
        axis, node = np.divmod(edge.astype(np.int64), size)
        position = lattice_positions(field, row, edge, border).T
        each = np.arange(len(row))
        start = field.factor * field.voxel_ijk[row, axis] + block_ijk(field.factor)[node, axis]
        share = np.clip(position[each, axis] - start, 0, 1)
        width = int(row[-1] - row[0]) + 1  # a node at the end of many edges is worked on once
        ends = np.stack([node, edge_ends(field.factor)[edge]]) * width + (row - row[0])
        number = np.zeros(size * width, np.int32)
        number[ends] = 1
        at = np.flatnonzero(number)
        number[at] = np.arange(len(at))
        ends = number[ends]
        node, row = np.divmod(at, width)[0], row[0] + at % width
        gradient = _gradient(field, row, node)
        slope_trust = square_falloff((length(gradient) - 1) / SLOPE_ERROR) + LEAST_TRUST
        low, high = gradient[ends]
        trust = slope_trust[ends]
        weight = (1 - share) * trust[0], share * trust[1]
        agree = dot(*unit(gradient)[ends]) > 0.9
        mean = low * weight[0][:, None] + high * weight[1][:, None]
        nearer = np.where((weight[0] >= weight[1])[:, None], low, high)
        planes.point[some] = position
        planes.normal[some] = unit(np.where(agree[:, None], mean, nearer))
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
    """Return the field's gradient at nodes of blocks, (n, 3); 1 is the slope of a distance.

    Along each axis by the parabola through three of five nodes that bends least: it does not
    straddle a kink. It is 0 where all three have missing values.
    """
    gradient, c = np.empty((len(row), 3)), field.blocks[node, row].astype(np.float64)
    for axis, walk in enumerate(_walks(field.factor)):
        found = []
        for place, end in walk:
            beside = field.parts.table[place[node], row]
            value = field.blocks[end[node], beside].astype(np.float64)
            value[beside < 0] = np.nan  # there is no block
            found.append(value)
        a, b, d, e = found
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
        gradient[:, axis] = slope
    return gradient * (field.factor / 2)


@lru_cache
def _walks(factor: int) -> list[list[tuple[Index, Index]]]:
    """Return the neighbours, (Q,), and nodes, (Q,), -2, -1, 1 and 2 nodes away along each axis."""
    side = factor + 1

    def walk(axis: int, step: int) -> tuple[Index, Index]:
        ijk = block_ijk(factor).astype(np.int64)
        ijk[:, axis] += step
        beyond = np.where(ijk[:, axis] > factor, 1, np.where(ijk[:, axis] < 0, -1, 0))
        ijk[:, axis] -= factor * beyond
        end = (ijk[:, 0] * side + ijk[:, 1]) * side + ijk[:, 2]
        return CENTRE + int(STRIDES[axis]) * beyond, end

    return [[walk(axis, step) for step in (-2, -1, 1, 2)] for axis in range(3)]


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
    rough: Numbers = np.zeros(len(own.trust))  # the largest 1 - cosine of normals in a patch
    for loop in _chunks_of_loops(loops):
        normal = own.normal.T[:, loop]
        for turn in range(1, len(loop) // 2 + 1):  # a pair is met from both sides
            bend = 1 - _along(normal, np.roll(normal, turn, axis=1))
            np.maximum.at(rough, loop, np.maximum(bend, np.roll(bend, -turn, axis=0)))
    trust = own.trust * square_falloff(rough / ROUGH) + LEAST_TRUST
    unsettled = patches.having(trust < SETTLED)
    near = patches.dilate(unsettled, SMOOTHED_RINGS, len(trust))
    planes, rows = Planes(own.point, own.normal, trust), np.flatnonzero(near)
    chunks = _chunks_of_loops([loop[:, near[loop].any(0)] for loop in loops])
    threads = worthwhile_threads(PAIR_TEMPORARIES * sum(loop.size for loop in chunks), threads)
    if not chunks:
        return planes
    crossing = np.concatenate([loop.ravel() for loop in chunks])
    start = own.point[rows]
    for _ in range(ROUNDS):
        parts = map_threads(partial(_sums_in_loops, planes, own), chunks, threads)
        sums = np.concatenate(parts, 1)
        summed = np.stack([np.bincount(crossing, each, len(trust))[rows] for each in sums])
        total, off, passed_on = summed[:3]
        mine, trusted = planes.normal[rows], planes.trust[rows]
        mean = unit(summed[3:].T + trusted[:, None] * mine)
        here = dot(start - planes.point[rows], mine)
        height = (off + trusted * here) / (total + trusted)
        planes = Planes(planes.point.copy(), planes.normal.copy(), planes.trust.copy())
        planes.point[rows], planes.normal[rows] = start - height[:, None] * mean, mean
        planes.trust[rows] = np.maximum(trusted, WEAKENING * passed_on / (total + 1e-12))
    return planes


def _chunks_of_loops(loops: list[Index]) -> list[Index]:
    return [
        loop[:, some]
        for loop in loops
        for some in chunks_of(loop.shape[1], PAIR_TEMPORARIES * len(loop))
    ]


def _sums_in_loops(planes: Planes, own: Planes, loop: Index) -> Vectors:
    """Return for each crossing of patches (S, p) sums over the others of its patch, (6, S p).

    Of the weights, and weighted: how far it lies off their planes, their trust, their normals.
    """
    sides, sums = len(loop), np.zeros((6, *loop.shape))
    twice = np.concatenate([loop, loop[:-1]])  # so that the next ones of all follow each other
    start, normal = own.point.T[:, loop], planes.normal.T[:, twice]
    height, trust = planes.height[twice], planes.trust[twice]
    for turn in range(1, sides):
        here = slice(turn, turn + sides)
        off = _along(start, normal[:, here]) - height[here]
        turned = (1 - _along(normal[:, :sides], normal[:, here])) / ALIGNED
        weight = trust[here] * square_falloff(turned, off / OFF_PLANE)
        sums[0] += weight
        sums[1] += weight * off
        sums[2] += weight * trust[here]
        sums[3:] += weight * normal[:, here]
    return sums.reshape(6, -1)


def _along(a: Vectors, b: Vectors) -> Numbers:
    """Return the products of vectors (3, ...)."""
    product: Numbers = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product
