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
BOX_ROWS = 4096  # blocks that are worked on with the same planes of samples
TEMPORARIES, PAIRS = 1024, 4096  # numbers of each block in a chunk; spheres and blocks at a time


@dataclass(frozen=True, eq=False)
class SampleSpheres:
    """The spheres of exact samples: the surface touches each and pierces none."""

    shape: tuple[int, int, int]  # samples of the grid along each axis
    number: NDArray[np.int64]  # (n,), of the samples in C order of the whole grid, ascending
    distance: FloatArray  # (n,), signed, in half voxels

    def planes(self, first: int, last: int) -> FloatArray:
        """Return distances in planes ``first`` to before ``last``, NaN where there is no sphere.

        Across, they reach ``REACH_OF_SAMPLES`` beyond the grid on either side.
        """
        (ny, nz), beyond = self.shape[1:], REACH_OF_SAMPLES
        planes = np.full((last - first, ny + 2 * beyond, nz + 2 * beyond), np.nan, np.float32)
        rows = slice(*np.searchsorted(self.number, np.array([first, last]) * (ny * nz)))
        i, j, k = np.unravel_index(self.number[rows] - first * ny * nz, (last - first, ny, nz))
        planes[i, j + beyond, k + beyond] = self.distance[rows]
        return planes


NO_SPHERES = SampleSpheres((0, 0, 0), np.empty(0, np.int64), np.empty(0, np.float32))


def keep_within_bounds(
    blocks: FloatArray,
    parts: SharedParts,
    factor: int,
    voxel_ijk: IntArray,
    samples: SampleSpheres,
    threads: int = 1,
) -> None:
    """Move values that clearly exceed the samples' bounds to the nearest that these allow.

    Samples keep their values, and so do blocks whose own sample is not trusted, but for the nodes
    that they share with others, which are averaged again. ``blocks`` (Q, D + 1) of voxels (D, 3),
    in C order, are changed in place; the last column is 0.
    """
    if factor < LEAST_FACTOR or not len(samples.distance):
        return
    thin, steps = np.zeros(blocks.shape[1], bool), around_block(factor)[0]

    def work(rows: slice) -> list[tuple[NDArray[np.intp], FloatArray]]:
        moves = []
        first, last = voxel_ijk[[rows.start, rows.stop - 1], 0].tolist()
        planes = samples.planes(first - REACH_OF_SAMPLES, last + REACH_OF_SAMPLES + 1)
        strides = np.array([planes[0].size, planes.shape[2], 1])
        start = (voxel_ijk[rows] - np.array([first, 0, 0]) + REACH_OF_SAMPLES) @ strides
        around = steps @ strides
        for some in chunks_of(len(start), max(4 * len(blocks), TEMPORARIES)):
            first = rows.start + some.start
            values = np.ascontiguousarray(blocks[:, first : rows.start + some.stop].T)
            row, moved = _bounded(values, factor, planes.take(start[some, None] + around))
            inside = values[row] <= 0
            lost = np.count_nonzero(inside & (moved > 0), axis=1)
            thin[first + row] = lost > MOST_LOST * np.count_nonzero(inside, axis=1)
            moves.append((first + row, moved))
        return moves

    every = map_chunks(work, len(voxel_ijk), CHUNK // BOX_ROWS, threads)
    kept = thin.copy()  # and the blocks that share a face with a thin wall
    for place in (CENTRE - STRIDES, CENTRE + STRIDES):
        kept[:-1] |= thin[parts.table[place]].any(0)
    for rows, moved in (move for moves in every for move in moves):
        free = ~kept[rows]
        blocks[:, rows[free]] = moved[free].T
    average_shared(blocks, parts, factor, threads)


def _bounded(
    values: FloatArray, factor: int, around: FloatArray
) -> tuple[NDArray[np.intp], FloatArray]:
    """Return which of n blocks exceed their bounds, (m,), and their values within these, (m, Q).

    ``values`` are (n, Q), and ``around``, (n, m), the samples of ``around_block``. Blocks are
    numbered twice in between: from n on they are bounded by spheres whose centres are inside.
    """
    count, own = len(values), around[:, 0]
    _, apart, to_nodes, looked_at = around_block(factor)
    slack = apart - np.abs(around - own[:, None])
    close = np.flatnonzero(slack < SLACK)
    size, block = around.ravel().take(close), close // around.shape[1]
    place = close - block * around.shape[1]
    block += count * (size < 0)
    size = np.abs(size)
    to_looked, looked = to_nodes.take(looked_at, 1), values.take(looked_at, 1)
    looked, over = np.concatenate([-looked, looked]), np.empty_like(size)
    for some in chunks_of(len(block), CHUNK // PAIRS):
        beyond = looked.take(block[some], 0)
        beyond -= to_looked.take(place[some], 0)
        over[some] = beyond.T.copy().max(0)  # by how much, less the size of the sphere; fast
    bounded = np.zeros((2, count), bool)
    bounded.ravel()[block[over > EXCEEDED - size]] = True
    bounded[:, np.isnan(own) | (slack < -CONTRADICTION).any(1)] = False
    chosen = np.flatnonzero((over > -MARGIN - size) & bounded.ravel()[block])
    chosen = chosen[np.argsort(block[chosen], kind="stable")]
    block, place, size = block[chosen], place[chosen], size[chosen]
    spheres = np.bincount(block, minlength=2 * count)
    most = np.argsort(-spheres, kind="stable")[: np.count_nonzero(spheres)]  # those with most first
    first, times = (np.cumsum(spheres) - spheres)[most], spheres[most]
    tightest = np.full((len(most), values.shape[1]), -np.inf, np.float32)
    for nth in range(spheres.max()):  # the first sphere of each block, then the second
        number = first[: np.count_nonzero(times > nth)] + nth
        bound = size.take(number)[:, None] - to_nodes.take(place.take(number), 0)
        np.maximum(tightest[: len(number)], bound, out=tightest[: len(number)])
    moved, outside = values.copy(), most < count
    row = most[outside]
    moved[row] = np.maximum(moved[row], tightest[outside])
    row = most[~outside] - count
    moved[row] = np.minimum(moved[row], -tightest[~outside])
    middle = values.shape[1] // 2
    moved[:, middle] = values[:, middle]  # the block's own sample
    row = np.flatnonzero(bounded.any(0))
    return row, moved[row]


@lru_cache
def around_block(factor: int) -> tuple[IntArray, FloatArray, FloatArray, NDArray[np.intp]]:
    """Return where samples round a block are, its own first, and 27 nodes, as of 2 cells a side.

    Steps from its own sample, (m, 3), distances from this, (m,), and from the nodes, (m, Q).
    """
    steps = np.indices((2 * REACH_OF_SAMPLES + 1,) * 3).reshape(3, -1).T - REACH_OF_SAMPLES
    apart = 2 * np.linalg.norm(steps, axis=1)
    order = np.argsort(apart, kind="stable")[: np.count_nonzero(apart <= 2 * REACH_OF_SAMPLES)]
    to_nodes = np.linalg.norm(2 * steps[order, None] - block_offsets(factor).astype(float), axis=2)
    nodes = np.flatnonzero((block_ijk(factor) % (factor // 2) == 0).all(1))
    own = apart[order].astype(np.float32)
    return steps[order].astype(np.int32), own, to_nodes.astype(np.float32), nodes
