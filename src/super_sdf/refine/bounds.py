"""Keep the field within the bounds that samples set.

Two distances differ by no more than their places are apart. So the field at x is at least
s - |x - y| if a sample outside, at y, has distance s, and at most s + |x - y| if the sample is
inside: no surface reaches into a sample's sphere. The network sees the samples nearest the surface
only, and its values exceed the bounds of farther ones at a tenth of the nodes. A sample that was
cut off sets a weaker bound, no wrong one.

Some blocks are left as they are: where samples contradict each other, the field is no distance;
where bounds would take a good part of a block's inside away, there is a wall thinner than the fine
lattice, which the true distances at the nodes would lose. Lengths are in half voxels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..arrays import CENTRE, STRIDES, FloatArray, IntArray
from ..threads import CHUNK, chunks_of, map_chunks
from .nodes import SharedParts, average_shared, block_ijk, block_offsets

FARTHEST = 8.0  # of the samples that set bounds: four voxels
REACH_OF_SAMPLES = 4  # voxels from a block's sample to those that bound its values
REACH_IN_VOXELS = 2  # a block depends on those beside it, which may have a thin wall, and on theirs
# A sample counts where the block's own sample is this close to its bound: nearly all bounds that
# values exceed, and one in ten of the others.
SLACK = 1.0
# A block stays as it is unless a value at 27 of its nodes is so far beyond a bound; then all
# spheres count that come this near to these values, since other nodes lie between.
EXCEEDED, MARGIN = np.float32(0.002), np.float32(0.05)
CONTRADICTION = 0.02  # that far beyond a bound, one of two samples is no distance
LEAST_FACTOR = 4  # in larger cells, bounds would undo what the fit to the spheres makes up for
MOST_LOST = 0.15  # of the nodes inside a block: more are a thin wall
# Blocks that are worked on with one box of samples, and the largest box: of far fewer blocks, if
# they lie along a diagonal.
BOX_ROWS, BOX_SAMPLES = 4096, 1 << 21
TEMPORARIES = 512  # numbers of each block in a chunk: four spheres at its nodes


@dataclass(frozen=True, eq=False)
class TrustedSamples:
    """All samples whose spheres can be trusted: exact ones of the band, and some beyond it."""

    shape: tuple[int, int, int]  # samples of the grid along each axis
    number: NDArray[np.int64]  # (n,), of each sample, in C order of the grid, ascending
    value: FloatArray  # (n,)

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

    def work(rows: slice) -> list[tuple[NDArray[np.intp], FloatArray]]:
        moves = []
        for group in _cut_to_boxes(voxel_ijk, rows):
            low = voxel_ijk[group].min(0) - REACH_OF_SAMPLES
            box = samples.box(low, voxel_ijk[group].max(0) + REACH_OF_SAMPLES + 1)
            strides = np.array([box.shape[1] * box.shape[2], box.shape[2], 1])
            start, around = (voxel_ijk[group] - low) @ strides, steps @ strides
            for some in chunks_of(len(start), max(4 * len(blocks), TEMPORARIES)):
                here = slice(group.start + some.start, group.start + some.stop)
                values = np.ascontiguousarray(blocks[:, here].T)
                moved = _bounded(values, factor, box.take(start[some, None] + around))
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


def _cut_to_boxes(voxel_ijk: IntArray, rows: slice) -> Iterator[slice]:
    """Yield the rows of voxels (D, 3), cut in halves until a box round each part is small."""
    size = np.ptp(voxel_ijk[rows], axis=0).astype(np.int64) + 2 * REACH_OF_SAMPLES + 1
    if size.prod() <= BOX_SAMPLES or rows.stop - rows.start == 1:
        yield rows
    else:
        middle = (rows.start + rows.stop) // 2
        yield from _cut_to_boxes(voxel_ijk, slice(rows.start, middle))
        yield from _cut_to_boxes(voxel_ijk, slice(middle, rows.stop))


def _bounded(values: FloatArray, factor: int, around: FloatArray) -> FloatArray:
    """Return the values of blocks, (n, Q) float32, moved into their bounds.

    ``around``, (n, m) float32, are the samples round each block in the order of ``sample_places``,
    its own first.
    """
    own, moved = around[:, 0], values.copy()
    slack = sample_places()[1] - np.abs(around - own[:, None])
    close = np.flatnonzero(slack < SLACK)
    to_nodes, looked_at = node_distances(factor)
    to_looked = to_nodes[:, looked_at]
    for side in (1, -1):  # spheres whose centres are outside, then inside
        row, place = np.divmod(close[side * around.ravel()[close] > 0], around.shape[1])
        size = np.abs(around[row, place])
        # nodes that are nearer to a centre than this exceed its bound
        reached = (np.float32(-side) * moved[:, looked_at]).take(row, 0)
        reached += size[:, None]
        exceeded = np.zeros(len(values), bool)
        exceeded[row[_any_of_32(reached > (to_looked + EXCEEDED).take(place, 0))]] = True
        near = np.flatnonzero(exceeded[row])
        reaches = reached.take(near, 0) > (to_looked - MARGIN).take(place.take(near), 0)
        near = near[_any_of_32(reaches)]
        count = np.bincount(row[near], minlength=len(values))
        first = np.cumsum(count) - count
        tightest = (np.float32(side) * moved).astype(np.float32, copy=False)
        for nth in range(count.max()):  # the first sphere of each block, then the second
            blocks = np.flatnonzero(count > nth)
            some = near[first[blocks] + nth]
            bound = size.take(some)[:, None] - to_nodes.take(place.take(some), 0)
            tightest[blocks] = np.maximum(tightest[blocks], bound)
        moved = np.float32(side) * tightest
    kept = np.isnan(own) | (slack < -CONTRADICTION).any(1)
    moved[kept] = values[kept]
    middle = values.shape[1] // 2
    moved[:, middle] = values[:, middle]  # the block's own sample
    return moved


def _any_of_32(found: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return in which rows of (k, 32) any is True, (k,); eight in each number: faster than any."""
    a, b, c, d = found.view(np.uint64).T
    return np.asarray(a | b | c | d, bool)


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
def node_distances(factor: int) -> tuple[FloatArray, NDArray[np.intp]]:
    """Return the distances from the samples round a block to its nodes, (m, Q), and some nodes.

    Those are the 27 at the ends and in the middle of the block, filled up to 32 by the last.
    """
    apart = 2 * sample_places()[0][:, None] - block_offsets(factor).astype(np.float64)
    distance: FloatArray = np.linalg.norm(apart, axis=2).astype(np.float32)
    nodes = np.flatnonzero((block_ijk(factor) % (factor // 2) == 0).all(1))
    return distance, np.pad(nodes, (0, 5), mode="edge")
