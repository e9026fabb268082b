"""Keep the field within the bounds that samples set.

Two distances differ by no more than their places are apart. So the field at x is at least
s - |x - y| if a sample outside, at y, has distance s, and at most s + |x - y| if the sample is
inside: no surface reaches into a sample's sphere. The network sees the samples nearest the surface
only, and its values exceed the bounds of farther ones at a tenth of the nodes.

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

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from ..machine.threads import CHUNK, chunks_of, map_chunks
from ..neighbourhood import CENTRE, STRIDES
from .beyond import TrustedSamples
from .nodes import SharedParts, average_shared, block_ijk, block_offsets

REACH_OF_SAMPLES = 4  # voxels from a block's sample to those that bound its values
# A sample counts where the block's own sample is this close to its bound. Nearly all bounds that
# values exceed are so, and one in ten of the others.
SLACK = 1.0
MARGIN = 0.05  # a sphere as near to the values at 27 nodes is looked at: others lie between
CONTRADICTION = 0.02  # that far beyond a bound, one of two samples is no distance
# With larger cells the fit to the spheres makes up for what linear cells cut off, and bounds, which
# hold for true distances, would undo half of that.
LEAST_FACTOR = 4
MOST_LOST = 0.15  # of the nodes inside a block: more are a thin wall
BOX_ROWS = 4096  # blocks at most that are worked on with one box of samples ...
BOX_SAMPLES = 1 << 21  # ... of at most this size: far fewer blocks along a diagonal
SPHERES = 8  # about as many reach the values of a block
TEMPORARIES = 1024  # numbers per block in the search for these

# A block depends on those beside it, which may have a thin wall, and shared nodes are averaged.
REACH_IN_VOXELS = 2


def keep_within_bounds(
    blocks: FloatArray,
    parts: SharedParts,
    factor: int,
    voxel_ijk: IntArray,
    samples: TrustedSamples,
    threads: int = 1,
) -> None:
    """Move values to the nearest ones that the samples around allow.

    Samples keep their values, and so do blocks whose own sample is not trusted, but for the nodes
    that they share with others, which are averaged again. Where no sample beyond the band can be
    trusted, and with a factor of 2, nothing is changed.

    Parameters
    ----------
    blocks : (Q, D + 1) float32
        Node values in half voxels, changed in place; the last column is 0.
    parts : SharedParts
        Of the D voxels.
    factor : int
        K.
    voxel_ijk : (D, 3) int32
        The voxels, in C order.
    samples : TrustedSamples
        Those that set bounds.
    threads : int
        Threads to use.
    """
    if factor < LEAST_FACTOR or not samples.reach_beyond or not samples.exact.any():
        return
    bounded, thin = blocks.copy(), np.zeros(blocks.shape[1], bool)

    def work(rows: slice) -> None:
        for group in cut_to_boxes(voxel_ijk, rows):
            around = samples_around(voxel_ijk[group], samples)
            for some in chunks_of(len(around.start), max(SPHERES * len(blocks), TEMPORARIES)):
                here = slice(group.start + some.start, group.start + some.stop)
                values = np.ascontiguousarray(blocks[:, here].T)
                moved = bounded_values(values, factor, around.take(some))
                thin[here] = loses_wall(values, moved)
                bounded[:, here] = moved.T

    map_chunks(work, len(voxel_ijk), CHUNK // BOX_ROWS, threads)
    np.copyto(blocks, bounded, where=~(thin | _any_beside(thin, parts)))
    average_shared(blocks, parts, factor, threads)


@dataclass(frozen=True, eq=False)
class Around:
    """The samples round n blocks.

    Attributes
    ----------
    flat : (l,) float32
        A box of samples, NaN where none is trusted.
    start : (n,) int64
        Where in it each block's own sample is.
    steps : (m,) int64
        From there to the samples around, in the order of ``sample_places``.
    """

    flat: FloatArray
    start: NDArray[np.int64]
    steps: NDArray[np.int64]

    def take(self, rows: slice) -> FloatArray:
        """Return the samples round some blocks, (n, m)."""
        return self.flat.take(self.start[rows, None] + self.steps)


def cut_to_boxes(voxel_ijk: IntArray, rows: slice) -> Iterator[slice]:
    """Yield the rows of voxels (D, 3), cut in halves until a box round each part is small."""
    size = np.ptp(voxel_ijk[rows], axis=0).astype(np.int64) + 2 * REACH_OF_SAMPLES + 1
    if size.prod() <= BOX_SAMPLES or rows.stop - rows.start == 1:
        yield rows
        return
    middle = (rows.start + rows.stop) // 2
    yield from cut_to_boxes(voxel_ijk, slice(rows.start, middle))
    yield from cut_to_boxes(voxel_ijk, slice(middle, rows.stop))


def samples_around(voxel_ijk: IntArray, samples: TrustedSamples) -> Around:
    """Return the samples round the blocks of voxels (n, 3)."""
    low = voxel_ijk.min(0) - REACH_OF_SAMPLES
    box = samples.box(low, voxel_ijk.max(0) + REACH_OF_SAMPLES + 1)
    strides = np.array([box.shape[1] * box.shape[2], box.shape[2], 1])
    steps, _ = sample_places()
    return Around(box.reshape(-1), (voxel_ijk - low) @ strides, steps @ strides)


def bounded_values(values: FloatArray, factor: int, around: FloatArray) -> FloatArray:
    """Return the values of blocks moved into their bounds.

    Parameters
    ----------
    values : (n, Q) float32
    factor : int
        K.
    around : (n, m) float32
        The samples round each block in the order of ``sample_places``, its own first.

    Returns
    -------
    (n, Q) float32
    """
    own, moved = around[:, :1], values.copy()
    slack = sample_places()[1] - np.abs(around - own)
    row, place = np.nonzero(slack < SLACK)
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
    values: FloatArray,
    factor: int,
    side: int,
    row: NDArray[np.intp],
    place: NDArray[np.intp],
    sample: FloatArray,
) -> None:
    """Move the values in spheres on one side of the surface out of these, in place.

    Parameters
    ----------
    values : (n, Q) float32
    factor : int
        K.
    side : {1, -1}
        Whether the spheres' centres are outside or inside.
    row, place : (k,) int
        The block that each sphere may reach, ascending, and where its centre is, as a row of
        ``sample_places``.
    sample : (k,) float32
        The signed distance at its centre.
    """
    looked_at, to_nodes = nodes_to_look_at(factor), node_distances(factor)
    depth = values[:, looked_at].take(row, 0)
    depth -= sample[:, None]
    depth *= -side
    depth -= to_nodes[:, looked_at].take(place, 0)
    reaching = np.flatnonzero((depth > -MARGIN).any(1))
    row, place, sample = row.take(reaching), place.take(reaching), sample.take(reaching)
    beyond, tightest = (np.subtract, np.maximum) if side > 0 else (np.add, np.minimum)
    for some in by_rank(row):  # of the blocks in these rows, no two are the same
        chosen, bound = row.take(some), to_nodes.take(place.take(some), 0)
        beyond(sample.take(some)[:, None], bound, out=bound)
        values[chosen] = tightest(values.take(chosen, 0), bound, out=bound)


def by_rank(row: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
    """Yield where ascending numbers (k,) come first, where they come a second time, and so on."""
    first = np.flatnonzero(np.diff(row, prepend=-1))
    rank = np.arange(len(row)) - np.repeat(first, np.diff(first, append=len(row)))
    order = np.argsort(rank, kind="stable")
    yield from np.split(order, np.cumsum(np.bincount(rank))[:-1]) if len(row) else ()


@lru_cache
def nodes_to_look_at(factor: int) -> NDArray[np.intp]:
    """Return the nodes of a block at its corners and in the middle of edges, faces and itself."""
    return np.flatnonzero((block_ijk(factor) % (factor // 2) == 0).all(1))


@lru_cache
def sample_places() -> tuple[IntArray, FloatArray]:
    """Return the steps from a block's own sample to those around, (m, 3), and distances, (m,).

    The nearest is first: the sample itself.
    """
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


def _any_beside(flags: BoolArray, parts: SharedParts) -> BoolArray:
    """Return which blocks share a face with a block of a flag, (D + 1,); the last flag is False."""
    found = np.zeros_like(flags)
    for stride in STRIDES:
        for place in (CENTRE - int(stride), CENTRE + int(stride)):
            found[:-1] |= flags[parts.table[place]]
    return found
