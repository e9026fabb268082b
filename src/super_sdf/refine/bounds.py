"""Keep the field within the bounds that samples set.

Two distances differ by no more than their places are apart. So the field at x is at least
s - |x - y| if a sample outside, at y, has distance s, and at most s + |x - y| if the sample is
inside: no surface reaches into a sample's sphere. The network sees the samples nearest the surface
only, and its values exceed the bounds of farther ones at a tenth of the nodes. Those beyond the
band are kept as a list, since the grid is read once and most of it is far from the surface.

Bounds need less than the fit to the spheres (``spheres``), for they hold wherever a sphere is: they
do not say where it touches. A sample that was cut off sets a weaker bound, no wrong one.

Some blocks are left as they are. Where samples contradict each other the field is no distance.
Where bounds would take a good part of a block's inside away, there is a wall thinner than the fine
lattice, which the true distances at the nodes would lose, and the network's values keep.

Lengths are in half voxels, as in ``band``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from ..threads import CHUNK, chunks_of, map_chunks
from ..network.neighbourhood import CENTRE, STRIDES
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
SPHERES = 4  # blocks in a chunk have room for so many spheres each ...
TEMPORARIES = 512  # ... and at least for these numbers

# A block depends on those beside it, which may have a thin wall, and shared nodes are averaged.
REACH_IN_VOXELS = 2

Rows = NDArray[np.intp]


class SamplesBeyond(NamedTuple):
    """Samples between the band and ``FARTHEST`` that can be exact."""

    number: NDArray[np.int64]  # (n,), in C order of the grid, ascending
    value: FloatArray  # (n,)


NONE_BEYOND = SamplesBeyond(np.zeros(0, np.int64), np.zeros(0, np.float32))


def samples_beyond(rescaled: FloatArray, first: int, limits: tuple[float, float]) -> SamplesBeyond:
    """Return those beyond the band among samples that follow each other, from number ``first`` on.

    They are those that can be exact: between ``limits``. Where a field is cut off, as most are that
    were truncated, all of the rest of the grid is not.
    """
    if not reach_beyond(limits):
        return NONE_BEYOND
    low, high = np.asarray(limits, np.float32).clip(-FARTHEST, FARTHEST)
    found = (rescaled > low) & (rescaled < high)
    found &= np.abs(rescaled) >= HALF_BAND
    return SamplesBeyond(np.flatnonzero(found) + first, rescaled[found])


def reach_beyond(limits: tuple[float, float]) -> bool:
    """Return whether samples beyond the band can be exact: the same for all parts of a grid."""
    return limits[0] < -HALF_BAND or limits[1] > HALF_BAND


@dataclass(frozen=True, eq=False)
class TrustedSamples:
    """All samples whose spheres can be trusted: exact ones of the band, and some beyond it."""

    shape: tuple[int, int, int]  # samples of the grid along each axis
    voxel_ijk: IntArray  # (V, 3), the samples of the band, in C order
    value: FloatArray  # (V,)
    exact: BoolArray  # (V,)
    beyond: SamplesBeyond
    limits: tuple[float, float]  # between these, samples beyond the band can be exact

    def box(self, low: IntArray, high: IntArray) -> FloatArray:
        """Return the samples from index ``low`` (3,) to before ``high``, NaN where none is."""
        box = np.full(high - low, np.nan, np.float32)
        planes = slice(*np.searchsorted(self.voxel_ijk[:, 0], [low[0], high[0]]))
        exact = np.flatnonzero(self.exact[planes]) + planes.start
        ends = np.array([low[0], high[0]], np.int64) * self.shape[1] * self.shape[2]
        rows = slice(*np.searchsorted(self.beyond.number, ends))
        ijk = np.stack(np.unravel_index(self.beyond.number[rows], self.shape), 1)
        for at, value in (
            (self.voxel_ijk[exact] - low, self.value[exact]),
            (ijk - low, self.beyond.value[rows]),
        ):
            within = np.asarray(((at >= 0) & (at < box.shape)).all(1))
            box[tuple(at[within].T)] = value[within]
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
    that they share with others, which are averaged again. Where no sample beyond the band can be
    trusted, and with a factor of 2, nothing is changed. ``blocks`` (Q, D + 1) of voxels (D, 3), in
    C order, are changed in place; the last column is 0.
    """
    if factor < LEAST_FACTOR or not reach_beyond(samples.limits) or not samples.exact.any():
        return
    thin = np.zeros(blocks.shape[1], bool)

    def work(rows: slice) -> list[tuple[Rows, FloatArray]]:
        moves = []
        for group in cut_to_boxes(voxel_ijk, rows):
            flat, start, steps = samples_around(voxel_ijk[group], samples)
            for some in chunks_of(len(start), max(SPHERES * len(blocks), TEMPORARIES)):
                here = slice(group.start + some.start, group.start + some.stop)
                values = np.ascontiguousarray(blocks[:, here].T)
                moved = bounded_values(values, factor, flat.take(start[some, None] + steps))
                changed = np.flatnonzero((moved != values).any(1))
                moved = moved[changed]
                thin[here.start + changed] = loses_wall(values[changed], moved)
                moves.append((here.start + changed, moved))
        return moves

    moves = map_chunks(work, len(voxel_ijk), CHUNK // BOX_ROWS, threads)
    kept = thin.copy()  # and the blocks that share a face with a thin wall
    for stride in STRIDES:
        for place in (CENTRE - int(stride), CENTRE + int(stride)):
            kept[:-1] |= thin[parts.table[place]]
    touched = np.zeros(blocks.shape[1], bool)
    for rows, moved in chain.from_iterable(moves):
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


def samples_around(
    voxel_ijk: IntArray, samples: TrustedSamples
) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64]]:
    """Return a box of samples (l,), the places of voxels' (n,), and steps to those around, (m,)."""
    low = voxel_ijk.min(0) - REACH_OF_SAMPLES
    box = samples.box(low, voxel_ijk.max(0) + REACH_OF_SAMPLES + 1)
    strides = np.array([box.shape[1] * box.shape[2], box.shape[2], 1])
    return box.reshape(-1), (voxel_ijk - low) @ strides, sample_places()[0] @ strides


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


def loses_wall(values: FloatArray, moved: FloatArray) -> BoolArray:
    """Return in which blocks a good part of the nodes inside is outside after a move, (n,)."""
    inside = values <= 0
    lost: BoolArray = (inside & (moved > 0)).sum(1) > MOST_LOST * inside.sum(1)
    return lost
