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

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ...arrays import BoolArray, IntArray
from ...threads import chunks_of, map_chunks
from ...network.neighbourhood import CENTRE, STRIDES
from ...refine.field import FineField
from ..marching import Crossings, edge_ends, lattice_positions
from ...refine.nodes import block_ijk
from .patches import Index, Numbers, Patches, Vectors, dilate, dot, length, unit

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
TEMPORARIES = 256  # numbers per crossing in the computation of its plane


def sums(row: NDArray[np.int64], vectors: Vectors, count: int) -> Vectors:
    """Return the sums of the vectors of each of ``count`` rows, (count, 3), in their order."""
    return np.stack([np.bincount(row, component, count) for component in vectors.T], 1)


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
    """Return the planes on chosen ones of the crossed edges that voxels own, by the field alone."""
    parts = map_chunks(
        lambda some: _planes_of_chunk(
            field, crossings.own_row[chosen[some]], crossings.own_edge[chosen[some]], border
        ),
        len(chosen),
        TEMPORARIES,
        threads,
    )
    empty = np.empty((0, 3)), np.empty((0, 3)), np.empty(0)
    return Planes(*(np.concatenate(arrays) for arrays in zip(empty, *parts)))


def _planes_of_chunk(
    field: FineField, row: IntArray, edge: NDArray[np.int16], border: IntArray
) -> tuple[Vectors, Vectors, Numbers]:
    """Return the arrays of ``Planes`` for some edges of voxels' blocks.

    Normals are between the gradients at both ends, in which they trust if the slope is about 1.
    """
    axis, node = np.divmod(edge.astype(np.int64), len(field.blocks))
    low_ijk = block_ijk(field.factor)[node]
    position = lattice_positions(field, row, edge, border).T
    start = (field.factor * field.voxel_ijk[row] + low_ijk)[np.arange(len(row)), axis]
    share = np.clip(position[np.arange(len(row)), axis] - start, 0, 1)
    low, high = (_gradient(field, row, end) for end in (node, edge_ends(field.factor)[edge]))
    trust = [
        square_falloff((length(gradient) - 1) / SLOPE_ERROR) + LEAST_TRUST
        for gradient in (low, high)
    ]
    weight = (1 - share) * trust[0], share * trust[1]
    agree = dot(unit(low), unit(high)) > 0.9
    mean = low * weight[0][:, None] + high * weight[1][:, None]
    nearer = np.where((weight[0] >= weight[1])[:, None], low, high)
    return position, unit(np.where(agree[:, None], mean, nearer)), np.maximum(*trust)


def square_falloff(off: Numbers, other: Numbers | float = 0.0) -> Numbers:
    """Return 1 at 0 and a quarter at 1: rational, so that every system computes the same.

    Times that of another distance.
    """
    falloff: Numbers = 1 / ((1 + off * off) * (1 + other * other)) ** 2
    return falloff


def _gradient(field: FineField, row: IntArray, node: Index) -> Vectors:
    """Return the field's gradient at nodes of blocks, (n, 3); 1 is the slope of a distance.

    Along each axis by the parabola through three of five nodes that bends least: it does not
    straddle a kink.
    """

    def values(row: NDArray[Any], node: NDArray[Any]) -> Numbers:
        found: Numbers = field.blocks[node, row].astype(np.float64)
        found[row < 0] = np.nan  # there is no block
        return found

    gradient, here = np.empty((len(row), 3)), values(row, node)
    for axis, walk in enumerate(_walks(field.factor)):
        a, b, d, e = (values(field.parts.table[place[node], row], end[node]) for place, end in walk)
        gradient[:, axis] = _slope((a, b, here, d, e))
    return gradient * (field.factor / 2)


def _slope(values: tuple[Numbers, ...]) -> Numbers:
    """Return the slope at the third of five nodes, (n,): 0 where values are missing."""
    a, b, c, d, e = values
    parabolas = (
        (c - 2 * b + a, 1.5 * c - 2 * b + 0.5 * a),
        (d - 2 * c + b, 0.5 * (d - b)),
        (e - 2 * d + c, 2 * d - 1.5 * c - 0.5 * e),
    )
    least, slope = np.full(len(c), np.inf), np.zeros(len(c))
    for bend, own in parabolas:
        bend = np.abs(bend)
        better = bend < least  # never of NaN
        least, slope = np.where(better, bend, least), np.where(better, own, slope)
    return slope


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


def settle_planes(patches: Patches, own: Planes) -> Planes:
    """Return a plane for every crossing: its own, or that of flat ground beside it.

    In each round a crossing takes the mean of the planes of those with which it shares a patch,
    weighted by trust, by how alike the normals are, and by how near it lies to the plane. Two that
    share two patches count twice.
    """
    loops = _loops_of(patches)
    trust = own.trust * square_falloff(_roughness(own, loops) / ROUGH) + LEAST_TRUST
    unsettled = np.any((trust < SETTLED)[patches.crossing] & patches.there, axis=1)
    beside = dilate(patches, cast(BoolArray, unsettled), SMOOTHED_RINGS, len(trust))
    planes, rows = Planes(own.point, own.normal, trust), np.flatnonzero(beside)
    chunks = list(_chunks_of_loops([loop[:, beside[loop].any(0)] for loop in loops]))
    for _ in range(ROUNDS):
        planes = _settle_once(planes, own, chunks, rows)
    return planes


def _loops_of(patches: Patches) -> list[Index]:
    """Return the crossings of the patches with 3 sides, with 4, and so on, (S, p) each."""
    return [
        np.ascontiguousarray(patches.crossing[patches.sides == sides, :sides].T)
        for sides in range(3, patches.crossing.shape[1] + 1)
    ]


def _roughness(own: Planes, loops: list[Index]) -> Numbers:
    """Return the largest 1 - cosine of a crossing's normal and another's in a patch, (n,)."""
    rough: Numbers = np.zeros(len(own.trust))
    for loop in _chunks_of_loops(loops):
        normal = own.normal.T[:, loop]
        for turn in range(1, len(loop)):
            np.maximum.at(rough, loop, 1 - _along(normal, np.roll(normal, turn, axis=1)))
    return rough


def _chunks_of_loops(loops: list[Index]) -> Iterator[Index]:
    for loop in loops:
        for some in chunks_of(loop.shape[1], PAIR_TEMPORARIES * len(loop)):
            yield loop[:, some]


def _settle_once(planes: Planes, own: Planes, loops: list[Index], rows: Index) -> Planes:
    """Return the planes after one round; only those of some rows change."""
    parts = [_sums_in_loops(planes, own, loop) for loop in loops]
    crossing, sums = (np.concatenate(arrays, -1) for arrays in zip(*parts))
    total, off, passed_on, *normal = (
        np.bincount(crossing, each, len(own.trust))[rows] for each in sums
    )
    start, mine, trust = own.point[rows], planes.normal[rows], planes.trust[rows]
    mean = unit(np.stack(normal, 1) + trust[:, None] * mine)
    here = dot(start - planes.point[rows], mine)
    height = (off + trust * here) / (total + trust)
    point, new, trusted = planes.point.copy(), planes.normal.copy(), planes.trust.copy()
    point[rows], new[rows] = start - height[:, None] * mean, mean
    trusted[rows] = np.maximum(trust, WEAKENING * passed_on / (total + 1e-12))
    return Planes(point, new, trusted)


def _sums_in_loops(planes: Planes, own: Planes, loop: Index) -> tuple[Index, Vectors]:
    """Return crossings of patches (e,), and for each sums over the others of its patch, (6, e).

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
    return loop.T.ravel(), sums.transpose(0, 2, 1).reshape(6, -1)


def _along(a: Vectors, b: Vectors) -> Numbers:
    """Return the products of vectors (3, ...)."""
    product: Numbers = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product
