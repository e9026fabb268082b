"""Every sample is the radius of a sphere that touches the surface: move the surface to touch them.

The foot point of a sample x with distance d is the surface point nearest to it, x - d n with the
surface's normal n there. What the refined field says at foot points should be 0. It is not quite,
for a network sees a sample as one number among many. What it says there is spread over the
neighbourhood and subtracted: first between the corners of voxels, so that walls which no sample
lies in are found; what is left, on a lattice twice as fine.

Reference: Sellán, Batty and Stein, "Reach For the Spheres: Tangency-Aware Surface Reconstruction
of SDFs", 2023, for the constraint; the solution here is another.

Lengths are in half voxels, as in ``band``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from ..machine.threads import map_chunks
from ..neighbourhood import CENTRE, NEIGHBOURHOOD, STRIDES
from .band import REACH
from .interpolation import CELL, find_cell, prolong, sample_trilinear
from .nodes import SharedParts, nodes_of_part, number_parts

DIRECTIONS = 5  # tried for each sample: see find_foot_points
FARTHEST = 2.8  # samples near the band's edge, 3, may have been cut off there
USUAL = 0.2  # a value at a foot point that is larger is less likely a matter of position ...
LARGEST = 0.6  # ... and counts as no more than this
ALIGNMENT = 3  # squarings of the cosine between a sample's direction and the normal it meets
LEAST_WEIGHT = 1e-3  # a weight below is none
PRIOR = 0.2  # foot points that speak for no correction at all
DISAGREEMENT = 0.5  # how much the variance of what foot points say speaks against it
FLAT = 0.7  # the largest slope towards a neighbour; that of a distance is near 1
CORNER_PARTS = np.flatnonzero(np.abs(NEIGHBOURHOOD).all(1))
MOST_NOISY = 0.02  # share of samples that are no distances: beyond, none is taken for exact

TEMPORARIES = 64  # numbers for each sample, on the way to its foot point

# Planes of voxels to both sides that a block's fitted values depend on: what is said round it, by
# samples one voxel on, given what was said one voxel further, whose tries read blocks as far again.
REACH_IN_VOXELS = 5


@dataclass(frozen=True, eq=False)
class ExactSamples:
    """Samples that can be taken for exact distances, and where they find the blocks round them.

    Attributes
    ----------
    patches : (V, 27) float32
        The band's samples.
    exact : (n,) int32
        The rows of those that are exact.
    table : (V, 27) int32
        Neighbours in the band, -1 where there is none.
    row_of : (V + 1,) int32
        Which block is a voxel's, -1 if it was not decoded; the last stands for absent ones.
    """

    patches: FloatArray
    exact: IntArray
    table: IntArray
    row_of: IntArray


@dataclass(frozen=True, eq=False)
class FootPoints:
    """Foot points of samples, and what the field is there.

    Attributes
    ----------
    rows : (n,) int32
        The block each lies in.
    place : (3, n) float32
        Where in the block, from 0 to 1.
    values : (n,) float32
        The field there, which should be 0.
    weights : (n,) float32
        How far to trust that.
    """

    rows: IntArray
    place: FloatArray
    values: FloatArray
    weights: FloatArray


def fit_to_spheres(
    blocks: FloatArray, parts: SharedParts, factor: int, samples: ExactSamples, threads: int = 1
) -> None:
    """Move the surface so that it touches the samples' spheres.

    Nodes at exact samples keep the sample; without such samples nothing is moved.

    Parameters
    ----------
    blocks : (Q, D + 1) float32
        Node values in half voxels, changed in place; the last column is 0.
    parts : SharedParts
        Of the D voxels.
    factor : int
        K.
    samples : ExactSamples
        Whose spheres.
    threads : int
        How many work at a time.
    """
    if not len(samples.exact):  # a noisy field, say
        return
    feet = find_foot_points(blocks, factor, samples, threads)
    correction = correction_of(feet, parts)

    def subtract(rows: slice) -> None:
        blocks[:, rows] -= prolong(correction[:, rows], 2, factor)

    map_chunks(subtract, correction.shape[1], len(blocks), threads)
    keep_samples(blocks, factor, samples)


def correction_of(feet: FootPoints, parts: SharedParts) -> FloatArray:
    """Return what foot points say in the mean at the parts of each block, (27, D)."""
    numbers, count = number_parts(parts, np.ones(27, np.int64))
    coarse, at, shares = mean_at_nodes(feet, feet.values, numbers, count, 1)
    left = feet.values - (coarse.take(at) * shares).sum(0)
    fine, *_ = mean_at_nodes(feet, left, numbers, count, 2)
    return prolong(coarse.take(numbers[CORNER_PARTS]), 1, 2) + fine.take(numbers)


def exact_samples(patches: FloatArray, lipschitz: BoolArray, threads: int = 1) -> BoolArray:
    """Say which samples of a whole band, (V,), can be taken for exact distances.

    Where more than a few of all are none (``lipschitz``, from ``is_lipschitz``), no sample is.
    """
    if not len(patches) or (~lipschitz).mean() > MOST_NOISY:
        return np.zeros(len(patches), bool)
    sample = patches[:, CENTRE]
    limits = np.float32(sample.min()), np.float32(sample.max())
    near = np.abs(sample) < FARTHEST
    cut_off = map_chunks(lambda rows: is_cut_off(patches[rows], limits), len(patches), 27, threads)
    exact: BoolArray = lipschitz & near & ~np.concatenate(cut_off)
    return exact


def is_cut_off(patches: FloatArray, limits: tuple[np.float32, np.float32]) -> BoolArray:
    """Say which samples, (V,), were cut off: at the limit of their sign, and no neighbour steep."""
    sample = patches[:, CENTRE]
    at_limit = sample == np.where(sample > 0, limits[1], limits[0])
    slope = np.abs(patches - sample[:, None]) / np.maximum(REACH, 1)
    cut_off: BoolArray = at_limit & (slope.max(1) < FLAT)
    return cut_off


def find_foot_points(
    blocks: FloatArray, factor: int, samples: ExactSamples, threads: int = 1
) -> FootPoints:
    """Return the foot points of samples, without those beyond the blocks.

    The direction to the surface is the field's gradient where it is reached, hence found by
    turns: first the patch's gradient, then half-way towards the field's where that led. Of all
    points at the right distance the nearest to the surface, or deepest beyond, is the best: a
    sphere that touches is outside everywhere else.
    """
    chunks = map_chunks(
        lambda some: best_tries(blocks, factor, samples, some),
        len(samples.exact),
        TEMPORARIES,
        threads,
    )
    rows, place, value, cosine = (np.concatenate(arrays, -1) for arrays in zip(*chunks))
    return weighted_feet(rows, place, value, cosine)


def best_tries(
    blocks: FloatArray, factor: int, samples: ExactSamples, chunk: slice
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Return block, place, value and cosine of the best foot point of some samples."""
    exact = samples.exact[chunk]
    patch = samples.patches[exact].T
    distance = patch[CENTRE]
    direction = _unit(patch[CENTRE + STRIDES] - patch[CENTRE - STRIDES])
    tries = []
    for _ in range(DIRECTIONS):
        rows, place = locate(-distance * direction, exact, samples)
        value, gradient = sample_trilinear(blocks, rows, place, factor)
        normal = _unit(gradient)
        tries.append((rows, place, value, _dot(direction, normal)))
        direction = np.where(rows >= 0, _unit(direction + normal), direction)
    rows, place, value, cosine = (np.stack(arrays) for arrays in zip(*tries))
    clearance = np.where(rows >= 0, np.copysign(np.float32(1), distance) * value, np.inf)
    best = clearance.argmin(0), np.arange(len(exact))
    return rows[best], place[best[0], :, best[1]].T, value[best], cosine[best]


def locate(
    steps: FloatArray, exact: IntArray, samples: ExactSamples
) -> tuple[IntArray, FloatArray]:
    """Return the blocks, (n,), that points at ``steps`` (3, n) from samples lie in, and where.

    No step is longer than 3 along an axis, so a point lies in the sample's voxel or a neighbour's.
    The place is from 0 to 1 along each axis; the block -1 where there is none.
    """
    half = steps * np.float32(0.5)
    aside = np.clip(np.rint(half), -1, 1)
    neighbour = samples.table[exact, (STRIDES @ (aside.astype(np.int32) + 1))]
    return samples.row_of[neighbour], np.clip(half - aside + np.float32(0.5), 0, 1)


def weighted_feet(
    rows: IntArray, place: FloatArray, values: FloatArray, cosine: FloatArray
) -> FootPoints:
    """Return the foot points that count, by the angle at which they are met and what is there."""
    unusual = values / np.float32(USUAL)
    aligned = np.clip(cosine, 0, 1)
    for _ in range(ALIGNMENT):  # not a power: its last bit depends on the place in the array
        aligned *= aligned
    weights = aligned / (1 + unusual * unusual)
    kept = (rows >= 0) & (weights > LEAST_WEIGHT)
    values = np.clip(values[kept], -LARGEST, LARGEST)
    return FootPoints(rows[kept], np.ascontiguousarray(place[:, kept]), values, weights[kept])


def mean_at_nodes(
    feet: FootPoints, values: FloatArray, numbers: IntArray, count: int, cells: int
) -> tuple[FloatArray, NDArray[np.intp], FloatArray]:
    """Return the mean at each node of what is at the foot points in the cells round it.

    Parameters
    ----------
    feet : FootPoints
        Where, and how far to trust it.
    values : (n,) float32
        What is there.
    numbers : (27, D) int32
        The nodes: a number below ``count`` for each part of each block.
    count : int
        How many numbers there are.
    cells : {1, 2}
        Along a block: of 1 the corners are the nodes, of 2 all parts.

    Returns
    -------
    (count,) float32, (8, n) int64, (8, n) float32
        The mean; the nodes round each foot point, and its trilinear weights for them.
    """
    part, shares = parts_round(feet.place, cells)
    at = numbers.ravel().take(part * numbers.shape[1] + feet.rows).astype(np.intp)
    weight = (shares * feet.weights).astype(np.float64)
    sums: list[NDArray[np.float64]] = []
    for _ in range(3):  # of weights, values and squares
        total: NDArray[Any] = np.bincount(at.ravel(), weight.ravel(), count)
        sums.append(total)
        weight *= values
    means = map_chunks(lambda some: agreed_mean(*(s[some] for s in sums)), count, 8)
    return np.concatenate(means), at, shares


def parts_round(place: FloatArray, cells: int) -> tuple[NDArray[np.int64], FloatArray]:
    """Return the parts that are the nodes round places (3, n), (8, n), and trilinear weights."""
    low, within = find_cell(place, cells)
    step = STRIDES * (2 // cells)
    part = step @ low + (CELL @ step)[:, None]
    upper = np.stack([1 - within, within])  # (2, 3, n)
    shares: FloatArray = upper[CELL[:, 0], 0] * upper[CELL[:, 1], 1] * upper[CELL[:, 2], 2]
    return part, shares


def agreed_mean(
    weight: NDArray[np.float64], total: NDArray[np.float64], squares: NDArray[np.float64]
) -> FloatArray:
    """Return the means of weighted sums, drawn to 0 where there is little weight or agreement."""
    mean = total / np.maximum(weight, 1e-9)
    variance = np.maximum(squares / np.maximum(weight, 1e-9) - mean**2, 0)
    agreement = mean**2 / np.maximum(mean**2 + DISAGREEMENT * variance, 1e-12)
    return (agreement * total / (weight + PRIOR)).astype(np.float32)


def keep_samples(blocks: FloatArray, factor: int, samples: ExactSamples) -> None:
    """Put exact samples back where they are nodes: in the middle of blocks."""
    decoded = samples.exact[samples.row_of[samples.exact] >= 0]
    inside = nodes_of_part(factor)[CENTRE]
    middle = inside[len(inside) // 2]
    blocks[middle, samples.row_of[decoded]] = samples.patches[decoded, CENTRE]


def _unit(vectors: FloatArray) -> FloatArray:
    """Return vectors (3, n) of length 1; 0 stays 0."""
    length = np.maximum(np.sqrt(_dot(vectors, vectors)), np.float32(1e-6))
    return (vectors / length).astype(np.float32, copy=False)


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the products of vectors (3, n), summed in their order."""
    product: FloatArray = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product
