"""Keep the field within the bounds that samples set.

Two distances differ by no more than their places are apart. So the field at x is at least
s - |x - y| if a sample outside, at y, has distance s, and at most s + |x - y| if the sample is
inside: no surface reaches into a sample's sphere. The network sees the samples nearest the surface
only, and its values exceed the bounds of farther ones at a tenth of the nodes. A sample that was
cut off sets a weaker bound, no wrong one.

Some blocks are left as they are. Where samples contradict each other the field is no distance.
Where bounds would take a good part of a block's inside away, there is a wall thinner than the fine
lattice, which the true distances at the nodes would lose, and the network's values keep.

Lengths are in half voxels, as in ``band``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..arrays import CENTRE, STRIDES, BoolArray, FloatArray, IntArray
from ..threads import CHUNK, chunks_of, map_chunks
from .band import HALF_BAND
from .nodes import SharedParts, average_shared, block_ijk, block_offsets

FARTHEST = 8.0  # of the samples that set bounds: four voxels
REACH_OF_SAMPLES = 4  # voxels from a block's sample to those that bound its values
# A sample counts where the block's own sample is this close to its bound. Nearly all bounds that
# values exceed are so, and one in ten of the others.
SLACK = 1.0
# A block stays as it is unless a value at 27 of its nodes is so far beyond a bound. Otherwise the
# spheres that are nearly as far as these values count: other nodes lie between.
EXCEEDED, MARGIN = 0.002, 0.05
CONTRADICTION = 0.02  # that far beyond a bound, one of two samples is no distance
# With larger cells the fit to the spheres makes up for what linear cells cut off, and bounds, which
# hold for true distances, would undo half of that.
LEAST_FACTOR = 4
MOST_LOST = 0.15  # of the nodes inside a block: more are a thin wall
BOX_ROWS = 4096  # blocks at most that are worked on with one box of samples ...
BOX_SAMPLES = 1 << 21  # ... of at most this size: far fewer blocks along a diagonal
TEMPORARIES = 512  # numbers of each block in a chunk: four spheres at its nodes

# A block depends on those beside it, which may have a thin wall, and shared nodes are averaged.
REACH_IN_VOXELS = 2

Rows = NDArray[np.intp]


def samples_beyond(
    rescaled: FloatArray, first: int, limits: tuple[float, float]
) -> tuple[NDArray[np.int64], FloatArray]:
    """Return numbers and values of samples beyond the band, up to ``FARTHEST``, between limits.

    The samples follow each other in C order from number ``first`` on. Where a field is cut off, as
    most are that were truncated, there are none.
    """
    if not reach_beyond(limits):
        return np.zeros(0, np.int64), np.zeros(0, np.float32)
    low, high = np.asarray(limits, np.float32).clip(-FARTHEST, FARTHEST)
    found = (rescaled > low) & (rescaled < high)
    found &= np.abs(rescaled) >= HALF_BAND
    return np.flatnonzero(found) + first, rescaled[found]


def reach_beyond(limits: tuple[float, float]) -> bool:
    """Return whether samples beyond the band can be exact: the same for all parts of a grid."""
    return limits[0] < -HALF_BAND or limits[1] > HALF_BAND


@dataclass(frozen=True, eq=False)
class TrustedSamples:
    """All samples whose spheres can be trusted: exact ones of the band, and some beyond it."""

    shape: tuple[int, int, int]  # samples of the grid along each axis
    number: NDArray[np.int64]  # (n,), of each sample, in C order of the grid, ascending
    value: FloatArray  # (n,)

    @classmethod
    def of(
        cls,
        shape: tuple[int, int, int],
        voxel_ijk: IntArray,
        sample: FloatArray,
        number: NDArray[np.int64],
        value: FloatArray,
        limits: tuple[float, float],
    ) -> TrustedSamples:
        """Return exact samples of the band, at (n, 3), with those beyond; none if none can be."""
        if not len(sample) or not reach_beyond(limits):
            return cls(shape, number[:0], value[:0])
        number = np.append(np.ravel_multi_index(tuple(voxel_ijk.T), shape), number)
        order = np.argsort(number, kind="stable")
        return cls(shape, number[order], np.append(sample, value)[order])

    def box(self, low: IntArray, high: IntArray) -> FloatArray:
        """Return the samples from index ``low`` (3,) to before ``high``, NaN where none is."""
        box = np.full(high - low, np.nan, np.float32)
        ends = np.array([low[0], high[0]], np.int64) * self.shape[1] * self.shape[2]
        rows = slice(*np.searchsorted(self.number, ends))
        at = np.stack(np.unravel_index(self.number[rows], self.shape), 1) - low
        within = np.asarray(((at >= 0) & (at < box.shape)).all(1))
        box[tuple(at[within].T)] = self.value[rows][within]
        return box


def keep_within_bounds(
    blocks: FloatArray,
    parts: SharedParts,
    factor: int,
    voxel_ijk: IntArray,
    samples: TrustedSamples,
    threads: int = 1,
) -> None:
    """Move values that clearly exceed the samples' bounds to the nearest that these allow.

    Samples keep their values, and so do blocks whose own sample is not trusted, but for the nodes
    that they share with others, which are averaged again. ``blocks`` (Q, D + 1) of voxels (D, 3),
    in C order, are changed in place; the last column is 0.
    """
    if factor < LEAST_FACTOR or not len(samples.number):
        return
    thin = np.zeros(blocks.shape[1], bool)
    steps, _ = sample_places()

    def work(rows: slice) -> list[tuple[Rows, FloatArray]]:
        moves = []
        for group in cut_to_boxes(voxel_ijk, rows):
            low = voxel_ijk[group].min(0) - REACH_OF_SAMPLES
            box = samples.box(low, voxel_ijk[group].max(0) + REACH_OF_SAMPLES + 1)
            strides = np.array([box.shape[1] * box.shape[2], box.shape[2], 1])
            start, around = (voxel_ijk[group] - low) @ strides, steps @ strides
            for some in chunks_of(len(start), max(4 * len(blocks), TEMPORARIES)):
                here = slice(group.start + some.start, group.start + some.stop)
                values = np.ascontiguousarray(blocks[:, here].T)
                moved = bounded_values(values, factor, box.take(start[some, None] + around))
                changed = np.flatnonzero((moved != values).any(1))
                inside, moved = values[changed] <= 0, moved[changed]
                lost = (inside & (moved > 0)).sum(1) > MOST_LOST * inside.sum(1)
                thin[here.start + changed] = lost
                moves.append((here.start + changed, moved))
        return moves

    every = map_chunks(work, len(voxel_ijk), CHUNK // BOX_ROWS, threads)
    kept = thin.copy()  # and the blocks that share a face with a thin wall
    for place in (CENTRE - STRIDES, CENTRE + STRIDES):
        kept[:-1] |= thin[parts.table[place]].any(0)
    touched = np.zeros(blocks.shape[1], bool)
    for rows, moved in (move for moves in every for move in moves):
        free = ~kept[rows]
        blocks[:, rows[free]] = moved[free].T
        touched[parts.table[:, rows[free]]] = True
    average_shared(blocks, parts, factor, threads, np.flatnonzero(touched[:-1]))


def cut_to_boxes(voxel_ijk: IntArray, rows: slice) -> Iterator[slice]:
    """Yield the rows of voxels (D, 3), cut in halves until a box round each part is small."""
    size = np.ptp(voxel_ijk[rows], axis=0).astype(np.int64) + 2 * REACH_OF_SAMPLES + 1
    if size.prod() <= BOX_SAMPLES or rows.stop - rows.start == 1:
        yield rows
        return
    middle = (rows.start + rows.stop) // 2
    yield from cut_to_boxes(voxel_ijk, slice(rows.start, middle))
    yield from cut_to_boxes(voxel_ijk, slice(middle, rows.stop))


def bounded_values(values: FloatArray, factor: int, around: FloatArray) -> FloatArray:
    """Return the values of blocks, (n, Q) float32, moved into their bounds.

    ``around``, (n, m) float32, are the samples round each block in the order of ``sample_places``,
    its own first.
    """
    own, moved = around[:, :1], values.copy()
    slack = np.subtract(around, own)
    np.abs(slack, out=slack)
    np.subtract(sample_places()[1], slack, out=slack)
    row, place = np.divmod(np.flatnonzero(slack < SLACK), slack.shape[1])
    sample = around[row, place]
    for side in (1, -1):
        some = np.flatnonzero(side * sample > 0)
        move_out(moved, factor, side, row.take(some), place.take(some), sample.take(some))
    kept = np.isnan(own[:, 0]) | (slack < -CONTRADICTION).any(1)
    moved[kept] = values[kept]
    middle = values.shape[1] // 2
    moved[:, middle] = values[:, middle]  # the block's own sample
    return moved


def move_out(
    values: FloatArray, factor: int, side: int, row: Rows, place: Rows, sample: FloatArray
) -> None:
    """Move the values (n, Q) in spheres on one side of the surface out of these, in place.

    The spheres' centres are outside if ``side`` is 1, inside if it is -1, and their signed
    distances there are ``sample`` (k,). ``row`` is the block that each may reach, ascending, and
    ``place`` where its centre is, as a row of ``sample_places``.
    """
    looked_at, to_nodes = nodes_to_look_at(factor), node_distances(factor)
    reached = (np.float32(-side) * values[:, looked_at]).take(row, 0)
    reached += np.abs(sample)[:, None]  # nearer to the centre, a node exceeds its bound
    apart = to_nodes[:, looked_at]
    exceeded = np.zeros(len(values), bool)
    exceeded[row[_any_node(reached > (apart + np.float32(EXCEEDED)).take(place, 0))]] = True
    near = np.flatnonzero(exceeded[row])
    far_enough = (apart - np.float32(MARGIN)).take(place.take(near), 0)
    reaching = near[_any_node(reached.take(near, 0) > far_enough)]
    row, place, sample = row.take(reaching), place.take(reaching), sample.take(reaching)
    count = np.bincount(row, minlength=len(values))
    first = np.cumsum(count) - count
    most = np.argsort(-count, kind="stable")  # blocks with many spheres first
    most = most[: np.count_nonzero(count)]
    beyond, tightest = (np.subtract, np.maximum) if side > 0 else (np.add, np.minimum)
    moved = values.take(most, 0)
    for nth, blocks in enumerate(np.cumsum(np.bincount(count)[::-1])[-2::-1]):
        some = first[most[:blocks]] + nth
        bound = to_nodes.take(place.take(some), 0)
        beyond(sample.take(some)[:, None], bound, out=bound)
        tightest(moved[:blocks], bound, out=moved[:blocks])
    values[most] = moved


def _any_node(nodes: BoolArray) -> BoolArray:
    """Return which rows of (k, 32) have a node that is True, (k,)."""
    eight = nodes.view(np.uint64)  # eight nodes in each number
    return (eight[:, 0] | eight[:, 1] | eight[:, 2] | eight[:, 3]).astype(bool)


@lru_cache
def nodes_to_look_at(factor: int) -> Rows:
    """Return the 27 nodes at the ends and in the middle of a block, filled up to 32 by the last."""
    nodes = np.flatnonzero((block_ijk(factor) % (factor // 2) == 0).all(1))
    return np.pad(nodes, (0, 5), mode="edge")


@lru_cache
def sample_places() -> tuple[IntArray, FloatArray]:
    """Return the steps from a sample to those around, (m, 3), itself first, and distances, (m,)."""
    reach = REACH_OF_SAMPLES
    steps = np.indices((2 * reach + 1,) * 3).reshape(3, -1).T - reach
    distance = 2 * np.linalg.norm(steps, axis=1)
    order = np.argsort(distance, kind="stable")
    order = order[distance[order] <= 2 * reach]
    return steps[order].astype(np.int32), distance[order].astype(np.float32)


@lru_cache
def node_distances(factor: int) -> FloatArray:
    """Return the distances from the samples round a block to its nodes, (m, Q)."""
    steps, _ = sample_places()
    apart = 2 * steps[:, None] - block_offsets(factor).astype(np.float64)
    distance: FloatArray = np.linalg.norm(apart, axis=2).astype(np.float32)
    return distance
