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

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from ..machine.threads import CHUNK, map_chunks
from ..neighbourhood import CENTRE, STRIDES
from .beyond import TrustedSamples
from .nodes import SharedParts, average_shared, block_ijk, block_offsets

REACH_OF_SAMPLES = 4  # voxels from a block's sample to those that bound its values
# A sample counts where the block's own sample is this close to its bound. Nearly all bounds that
# values exceed are so, and one in ten of the others.
SLACK = 1.0
MARGIN = 0.05  # a sphere as near to the values at 27 nodes is looked at: others lie between
CONTRADICTION = 0.02  # that far beyond a bound, one of two samples is no distance
MOST_LOST = 0.15  # of the nodes inside a block: more are a thin wall
LEAST_ROWS = 512  # worked on at a time, since a step costs nearly as much for one

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
    that they share with others, which are averaged again. Without samples beyond the band nothing
    is changed.

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
    if not len(samples.beyond) or not len(samples.value):
        return
    bounded, thin = blocks.copy(), np.zeros(blocks.shape[1], bool)

    def work(rows: slice) -> None:
        values = np.ascontiguousarray(blocks[:, rows].T)
        moved = bounded_values(values, factor, voxel_ijk[rows], samples)
        thin[rows] = loses_wall(values, moved)
        bounded[:, rows] = moved.T

    width = min(len(blocks), CHUNK // LEAST_ROWS)
    map_chunks(work, len(voxel_ijk), width, threads)
    np.copyto(blocks, bounded, where=~(thin | _any_beside(thin, parts)))
    average_shared(blocks, parts, factor, threads)


def bounded_values(
    values: FloatArray, factor: int, voxel_ijk: IntArray, samples: TrustedSamples
) -> FloatArray:
    """Return the values (n, Q) of the blocks of voxels (n, 3), moved into their bounds."""
    low = voxel_ijk.min(0) - REACH_OF_SAMPLES
    box = samples.box(low, voxel_ijk.max(0) + REACH_OF_SAMPLES + 1)
    strides = np.array([box.shape[1] * box.shape[2], box.shape[2], 1])
    at, flat, some = (voxel_ijk - low) @ strides, box.reshape(-1), nodes_to_look_at(factor)
    own, seen, moved = flat[at], values[:, some], values.copy()
    contradicted = np.isnan(own)
    for step, distance, to_nodes in zip(*sample_places(factor)):
        sample = flat.take(at + step @ strides)
        apart = np.abs(sample - own)
        rows = np.flatnonzero(apart > distance - SLACK)
        contradicted[rows] |= apart[rows] > distance + CONTRADICTION
        for side in (np.float32(1), np.float32(-1)):
            radius = side * sample[rows]
            matter = radius > 0
            matter[matter] = reaches(radius[matter], side * seen[rows[matter]], to_nodes[some])
            chosen = rows[matter]
            least = radius[matter, None] - to_nodes
            moved[chosen] = side * np.maximum(side * moved[chosen], least)
    moved[contradicted] = values[contradicted]
    middle = values.shape[1] // 2
    moved[:, middle] = values[:, middle]  # the block's own sample
    return moved


def reaches(radius: FloatArray, values: FloatArray, to_nodes: FloatArray) -> BoolArray:
    """Return which spheres reach beyond, or nearly to, the values at some nodes, (n,).

    Parameters
    ----------
    radius : (n,) float32
        Of the spheres.
    values : (n, m) float32
        Values at the nodes, positive on the side of the sphere's centre.
    to_nodes : (m,) float32
        Distances of the nodes to the centres.
    """
    return np.asarray((radius[:, None] - values > to_nodes - MARGIN).any(1))


@lru_cache
def nodes_to_look_at(factor: int) -> NDArray[np.intp]:
    """Return the nodes of a block at its corners and in the middle of edges, faces and itself."""
    return np.flatnonzero((block_ijk(factor) % (factor // 2) == 0).all(1))


@lru_cache
def sample_places(factor: int) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return where the samples round a block are, nearest first, and how far from it.

    Returns
    -------
    (m, 3) int32, (m,) float32, (m, Q) float32
        Steps from the block's own sample, the distances to that, and those to the block's nodes.
    """
    reach = REACH_OF_SAMPLES
    steps = np.indices((2 * reach + 1,) * 3, np.int32).reshape(3, -1).T - reach
    distance = 2 * np.linalg.norm(steps, axis=1)
    order = np.argsort(distance, kind="stable")
    order = order[distance[order] <= 2 * reach]
    apart = 2 * steps[order, None] - block_offsets(factor).astype(np.float64)
    to_nodes = np.linalg.norm(apart, axis=2).astype(np.float32)
    return steps[order].astype(np.int32), distance[order].astype(np.float32), to_nodes


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
