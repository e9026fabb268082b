"""Move the surface so that it touches the sphere of every sample.

The refined field should be 0 at the foot points of exact samples, where their spheres touch the
surface. It is not quite, since the network sees a sample as one number among many. In steps:

1. ``foot_points.find_foot_points`` follows the field's gradient from each exact sample to its foot
   point, and reads the field there: the error, with a weight for how far to trust it.
2. ``find_correction`` averages the errors at the corners of voxels, which also corrects walls that
   lie between samples; then, twice, what is left of them on a lattice twice as fine.
3. ``fit_to_spheres`` subtracts the averages from the field, by trilinear interpolation.

Reference: Sellán, Batty and Stein, "Reach For the Spheres: Tangency-Aware Surface Reconstruction
of SDFs", 2023, for the constraint; it is solved differently here.

Lengths are in half voxels, as in ``band``.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray, IntArray
from ..machine.resources import map_chunks
from ..neighbourhood import CENTRE, NEIGHBOURHOOD, STRIDES
from . import foot_points
from .band import MAX_DISTANCE
from .foot_points import CELL, FootPoints, Spheres, find_cell, find_foot_points
from .nodes import SharedParts, VoxelIndex, nodes_of_part, number_parts

PRIOR_WEIGHT = 0.2  # of the assumption that the error is 0, in foot points
VARIANCE_PENALTY = 0.5  # how strongly disagreement of the errors reduces their mean
CORNER_PARTS = np.flatnonzero(np.abs(NEIGHBOURHOOD).all(1))
MEANS = (1, 2, 2)  # cells along a block of the lattices at which errors are averaged, in turn

# The fitted values of a block depend on this many planes of voxels to either side: one each time
# that errors are averaged, for the foot points in the blocks beside; then the foot points' samples,
# and the blocks in which these were searched for; and one for the averaging of shared nodes.
REACH_IN_VOXELS = len(MEANS) + 2 * foot_points.REACH_IN_VOXELS + 1


def fit_to_spheres(
    blocks: FloatArray,
    parts: SharedParts,
    factor: int,
    spheres: Spheres,
    index: VoxelIndex,
    threads: int = 1,
) -> None:
    """Move the surface so that it touches the samples' spheres.

    Nodes at exact samples keep the sample's value. Without exact samples nothing is changed.
    ``blocks`` (Q, D + 1), in half voxels, are changed in place; the last column is 0. ``parts`` and
    ``index`` are of the D voxels.
    """
    if not len(spheres):  # in a noisy field, for example
        return
    feet = find_foot_points(blocks, factor, spheres, index, threads)
    correction = find_correction(feet, parts)

    def subtract(rows: slice) -> None:
        blocks[:, rows] -= prolong(correction[:, rows], 2, factor)

    map_chunks(subtract, correction.shape[1], len(blocks), threads)
    restore_samples(blocks, factor, spheres, index)


def find_correction(feet: FootPoints, parts: SharedParts) -> FloatArray:
    """Return the correction on the lattice of 2 cells per block, (27, D), in half voxels.

    It is the mean error at the corners of voxels, interpolated to the finer lattice, plus the means
    there of the errors that are left each time.
    """
    numbers, count = number_parts(parts, np.ones(27, np.int64))
    left, correction = feet.values, np.zeros(numbers.shape, np.float32)
    for turn, cells in enumerate(MEANS, 1):
        mean, at, shares = mean_at_nodes(feet, left, numbers, count, cells)
        if turn < len(MEANS):
            left = left - (mean.take(at) * shares).sum(0)
        del at, shares
        own = numbers[CORNER_PARTS] if cells == 1 else numbers
        correction += prolong(mean.take(own), cells, 2)
    return correction


def mean_at_nodes(
    feet: FootPoints, values: FloatArray, numbers: IntArray, count: int, cells: int
) -> tuple[FloatArray, NDArray[np.intp], FloatArray]:
    """Return the weighted mean at each node of values (n,) at foot points in the cells round it.

    The nodes, 0 to ``count - 1``, have ``numbers`` (27, D) by the part of each block; with 1 cell
    along a block they are the corners of blocks, with 2 all parts. Returned are the mean, (count,);
    the 8 nodes round each foot point, (8, n), and its trilinear weights for them, (8, n).
    """
    at, shares = surrounding_parts(feet.place, cells)
    at *= numbers.shape[1]  # in place: these arrays are the largest of the fit
    at += feet.rows
    at[:] = numbers.ravel().take(at)
    weight = (shares * feet.weights).astype(np.float64)
    sums: list[NDArray[np.float64]] = []
    for _ in range(3):  # of weights, values and squares
        total: NDArray[Any] = np.bincount(at.ravel(), weight.ravel(), count)
        sums.append(total)
        weight *= values
    means = map_chunks(lambda some: shrunk_mean(*(s[some] for s in sums)), count, 8)
    return np.concatenate(means), at, shares


def surrounding_parts(place: FloatArray, cells: int) -> tuple[NDArray[np.int64], FloatArray]:
    """Return the 8 nodes round each place (3, n), as parts (8, n), and their trilinear weights."""
    low, within = find_cell(place, cells)
    step = STRIDES * (2 // cells)
    part = step @ low + (CELL @ step)[:, None]
    upper = np.stack([1 - within, within])  # (2, 3, n)
    shares: FloatArray = upper[CELL[:, 0], 0] * upper[CELL[:, 1], 1] * upper[CELL[:, 2], 2]
    return part, shares


def shrunk_mean(
    weight: NDArray[np.float64], total: NDArray[np.float64], squares: NDArray[np.float64]
) -> FloatArray:
    """Return the means of values, shrunk towards 0 by little weight or large variance, (n,).

    Given are the weighted sums of 1, of the values and of their squares, (n,) each.
    """
    mean = total / np.maximum(weight, 1e-9)
    variance = np.maximum(squares / np.maximum(weight, 1e-9) - mean**2, 0)
    agreement = mean**2 / np.maximum(mean**2 + VARIANCE_PENALTY * variance, 1e-12)
    return (agreement * total / (weight + PRIOR_WEIGHT)).astype(np.float32)


def restore_samples(blocks: FloatArray, factor: int, spheres: Spheres, index: VoxelIndex) -> None:
    """Set the node in the middle of each block to its sample again, if that is exact."""
    own = spheres.some(np.abs(spheres.distance) < MAX_DISTANCE)
    rows = index.find(own.centre)
    inside = nodes_of_part(factor)[CENTRE]
    middle = inside[len(inside) // 2]
    blocks[middle, rows[rows >= 0]] = own.distance[rows >= 0]


def prolong(values: FloatArray, cells: int, finer: int) -> FloatArray:
    """Interpolate values trilinearly to the nodes of a finer lattice of the same n blocks.

    ``cells`` and ``finer`` are the cells along a block before and after, and values
    ((cells + 1)^3, n) become ((finer + 1)^3, n). If the copies of shared nodes were equal before,
    they are equal, bit for bit.
    """
    block = values.reshape(*(cells + 1,) * 3, -1)
    for axis in range(3):
        source = np.moveaxis(block, axis, 0)
        block = np.empty((*block.shape[:axis], finer + 1, *block.shape[axis + 1 :]), np.float32)
        for plane, (low, share) in zip(np.moveaxis(block, axis, 0), _finer_places(cells, finer)):
            plane[:] = source[low]
            if share:
                plane += (source[low + 1] - source[low]) * share
    return block.reshape(len(block) ** 3, -1)


@lru_cache
def _finer_places(cells: int, finer: int) -> list[tuple[int, np.float32]]:
    """Return along an axis the coarse node before each finer node, and the share beyond it.

    The share is 0 for a finer node that lies on a coarse one, the last one included.
    """
    places = [divmod(number * cells, finer) for number in range(finer + 1)]
    return [(low, np.float32(rest / finer)) for low, rest in places]
