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
from functools import lru_cache
from itertools import pairwise
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ...arrays import BoolArray, IntArray
from ...machine.resources import chunks_of, map_chunks, rows_in_chunk
from ...neighbourhood import CENTRE, STRIDES
from ..field import FineField
from ..marching import Crossings, edge_ends, lattice_positions
from ..nodes import block_ijk
from .patches import (
    Index,
    Numbers,
    Patches,
    Vectors,
    dilate,
    dot,
    length,
    pairs_in_patches,
    unit,
)

ROUNDS = 4  # in each, every crossing looks at those it shares a patch with
ROUGH = 0.02  # 1 - cosine of normals in a patch from which a crossing is not trusted
ALIGNED = 0.125  # 1 - cosine up to which planes count as the same
OFF_PLANE = 0.12  # fine spacings up to which a crossing is taken to lie on a plane
SLOPE_ERROR = 0.15  # of the field's slope, 1 for a distance, up to which a normal is trusted
WEAKENING = 0.7  # of the trust in a plane, from crossing to crossing
LEAST_TRUST = 1e-4
SETTLED = 0.3  # trust from which a crossing keeps its own plane, unless ...
SMOOTHED_RINGS = 1  # ... it lies within these of one that does not
PAIR_TEMPORARIES = 24  # numbers per pair of crossings in a round
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


def planes_at_crossings(
    field: FineField, crossings: Crossings, chosen: Index, threads: int = 1
) -> Planes:
    """Return the planes on chosen ones of the crossed edges that voxels own, by the field alone."""
    parts = map_chunks(
        lambda some: _planes_of_chunk(
            field, crossings.own_row[chosen[some]], crossings.own_edge[chosen[some]]
        ),
        len(chosen),
        TEMPORARIES,
        threads,
    )
    empty = np.empty((0, 3)), np.empty((0, 3)), np.empty(0)
    return Planes(*(np.concatenate(arrays) for arrays in zip(empty, *parts)))


def _planes_of_chunk(
    field: FineField, row: IntArray, edge: NDArray[np.int16]
) -> tuple[Vectors, Vectors, Numbers]:
    """Return the arrays of ``Planes`` for some edges of voxels' blocks.

    Normals are between the gradients at both ends, in which they trust if the slope is about 1.
    """
    axis, node = np.divmod(edge.astype(np.int64), len(field.blocks))
    low_ijk = block_ijk(field.factor)[node]
    position = lattice_positions(field, row, edge).T
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


def square_falloff(off: Numbers) -> Numbers:
    """Return 1 at 0 and a quarter at 1: rational, so that every system computes the same."""
    falloff: Numbers = 1 / (1 + off * off) ** 2
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
    weighted by trust, by how alike the normals are, and by how near it lies to the plane.
    """
    one, other = pairs_in_patches(patches)
    rough: Numbers = np.zeros(len(own.trust))  # the largest 1 - cosine in patches
    for some in chunks_of(len(one), PAIR_TEMPORARIES):
        turned = 1 - dot(own.normal[one[some]], own.normal[other[some]])
        np.maximum.at(rough, one[some], turned)
    trust = own.trust * square_falloff(rough / ROUGH) + LEAST_TRUST
    planes = Planes(own.point, own.normal, trust)
    unsettled = np.any((trust < SETTLED)[patches.crossing] & patches.there, axis=1)
    beside = dilate(patches, cast(BoolArray, unsettled), SMOOTHED_RINGS, len(trust))
    one, other = one[beside[one]], other[beside[one]]
    order = np.argsort(one, kind="stable")  # so that all pairs of a crossing are in one chunk
    one, other = one[order], other[order]
    step = rows_in_chunk(PAIR_TEMPORARIES)
    bounds = np.unique([0, *one[step::step].tolist(), len(trust)])
    starts = np.searchsorted(one, bounds)
    for _ in range(ROUNDS):
        parts = [
            _settle_once(planes, own, slice(a, b), one[i:j] - a, other[i:j])
            for (a, b), (i, j) in zip(pairwise(bounds.tolist()), pairwise(starts.tolist()))
        ]
        planes = Planes(*(np.concatenate(arrays) for arrays in zip(*parts)))
    return planes


def _settle_once(
    planes: Planes, own: Planes, rows: slice, one: Index, other: Index
) -> tuple[Vectors, Vectors, Numbers]:
    """Return the planes of some crossings after one round; ``one`` counts from the first."""
    point, mine, trust = planes.point[rows], planes.normal[rows], planes.trust[rows]
    start, count, normal = own.point[rows], len(trust), planes.normal[other]
    off = dot(start[one] - planes.point[other], normal)
    turned = (1 - dot(mine[one], normal)) / ALIGNED
    weight = planes.trust[other] * square_falloff(turned) * square_falloff(off / OFF_PLANE)
    total = np.bincount(one, weight, count)
    mean = unit(sums(one, weight[:, None] * normal, count) + trust[:, None] * mine)
    here = dot(start - point, mine)
    height = (np.bincount(one, weight * off, count) + trust * here) / (total + trust)
    passed_on = np.bincount(one, weight * planes.trust[other], count) / (total + 1e-12)
    return start - height[:, None] * mean, mean, np.maximum(trust, WEAKENING * passed_on)
