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

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from ..machine.compiling import compiled_twin
from ..machine.threads import in_chunks
from ..neighbourhood import CENTRE, STRIDES
from .band import REACH
from .interpolation import Said, carry, read, sums_at_nodes
from .nodes import SharedNodes, nodes_of_part, number_shared_nodes

DIRECTIONS = 5  # tried for each sample: see find_foot_points
FARTHEST = 2.8  # samples near the band's edge, 3, may have been cut off there
USUAL = 0.2  # a value at a foot point that is larger is less likely a matter of position ...
LARGEST = 0.6  # ... and counts as no more than this
ALIGNMENT = 3  # squarings of the cosine between a sample's direction and the normal it meets
LEAST = 1e-3  # a weight below is none
PRIOR = 0.2  # foot points that speak for no correction at all
DISAGREEMENT = 0.5  # how much the variance of what foot points say speaks against it
FLAT = 0.7  # the largest slope towards a neighbour; that of a distance is near 1
MOST_NOISY = 0.02  # share of samples that are no distances: beyond, none is taken for exact

MADE = 128  # numbers for each sample, on the way to its foot point

# Planes of voxels to both sides that a block's fitted values depend on: what is said round it, by
# samples one voxel on, given what was said one voxel further, whose tries read blocks as far again.
REACH_IN_VOXELS = 5


@dataclass(frozen=True, eq=False)
class Samples:
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


def fit_to_spheres(values: FloatArray, nodes: SharedNodes, samples: Samples) -> FloatArray:
    """Return the node values, (count,), moved so that the surface touches the samples' spheres.

    They are changed in place. Nodes at exact samples keep the sample; without such samples nothing
    is moved.
    """
    if not len(samples.exact):  # a noisy field, say
        return values
    feet = find_foot_points(values, nodes, samples)
    coarse, fine = (number_shared_nodes(nodes.table, cells) for cells in (1, 2))
    first = mean_at_nodes(feet, coarse)
    left = replace(feet, values=feet.values - read(first, coarse, feet.rows, feet.place)[0])
    correction = carry(first, coarse, fine) + mean_at_nodes(left, fine)
    carry(-correction, fine, nodes, onto=values)
    keep_samples(values, nodes, samples)
    return values


def exact_samples(patches: FloatArray, lipschitz: BoolArray) -> BoolArray:
    """Say which samples of a whole band, (V,), can be taken for exact distances.

    Where more than a few of all are none (``lipschitz``, from ``is_lipschitz``), no sample is.
    """
    if not len(patches) or (~lipschitz).mean() > MOST_NOISY:
        return np.zeros(len(patches), bool)
    sample = patches[:, CENTRE]
    limits = np.float32(sample.min()), np.float32(sample.max())
    near = np.abs(sample) < FARTHEST
    cut_off = in_chunks(len(patches), 27, lambda rows: is_cut_off(patches[rows], limits))
    exact: BoolArray = lipschitz & near & ~np.concatenate(cut_off)
    return exact


def is_cut_off(patches: FloatArray, limits: tuple[np.float32, np.float32]) -> BoolArray:
    """Say which samples, (V,), were cut off: at the limit of their sign, and no neighbour steep."""
    sample = patches[:, CENTRE]
    at_limit = sample == np.where(sample > 0, limits[1], limits[0])
    slope = np.abs(patches - sample[:, None]) / np.maximum(REACH, 1)
    cut_off: BoolArray = at_limit & (slope.max(1) < FLAT)
    return cut_off


def find_foot_points(values: FloatArray, nodes: SharedNodes, samples: Samples) -> Said:
    """Return what the field says at foot points of samples; those beyond the blocks are left out.

    The direction to the surface is the field's gradient where it is reached, hence found by
    turns: first the patch's gradient, then half-way towards the field's where that led. Of all
    points at the right distance the nearest to the surface, or deepest beyond, is the best: a
    sphere that touches is outside everywhere else.
    """
    find = compiled_twin(_find_chunk)
    parts = in_chunks(len(samples.exact), MADE, lambda chunk: find(values, nodes, samples, chunk))
    rows, place, value, cosine = (np.concatenate(arrays, -1) for arrays in zip(*parts))
    return weighted_feet(rows, place, value, cosine)


def _find_chunk(
    values: FloatArray, nodes: SharedNodes, samples: Samples, chunk: slice
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Return block, place, value and cosine of the best foot point of some samples."""
    exact = samples.exact[chunk]
    patch = samples.patches[exact].T
    distance = patch[CENTRE]
    direction = _unit(patch[CENTRE + STRIDES] - patch[CENTRE - STRIDES])
    tries = []
    for _ in range(DIRECTIONS):
        rows, place = locate(-distance * direction, exact, samples)
        value, gradient = read(values, nodes, rows, place)
        normal = _unit(gradient)
        tries.append((rows, place, value, _dot(direction, normal)))
        direction = np.where(rows >= 0, _unit(direction + normal), direction)
    rows, place, value, cosine = (np.stack(parts) for parts in zip(*tries))
    clearance = np.where(rows >= 0, np.copysign(np.float32(1), distance) * value, np.inf)
    best = clearance.argmin(0), np.arange(len(exact))
    return rows[best], place[best[0], :, best[1]].T, value[best], cosine[best]


def locate(steps: FloatArray, exact: IntArray, samples: Samples) -> tuple[IntArray, FloatArray]:
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
) -> Said:
    """Return the foot points that count, by the angle at which they are met and what is there."""
    unusual = values / np.float32(USUAL)
    aligned = np.clip(cosine, 0, 1)
    for _ in range(ALIGNMENT):  # not a power: its last bit depends on the place in the array
        aligned *= aligned
    weights = aligned / (1 + unusual * unusual)
    kept = (rows >= 0) & (weights > LEAST)
    values = np.clip(values[kept], -LARGEST, LARGEST)
    return Said(rows[kept], np.ascontiguousarray(place[:, kept]), values, weights[kept])


def mean_at_nodes(feet: Said, nodes: SharedNodes) -> FloatArray:
    """Return for each node, (count,), what the foot points in the cells round it say."""
    sums = sums_at_nodes(feet, nodes)
    return np.concatenate(in_chunks(nodes.count, 3, lambda some: agreed_mean(*sums[:, some])))


def agreed_mean(
    weight: NDArray[np.float64], total: NDArray[np.float64], squares: NDArray[np.float64]
) -> FloatArray:
    """Return the means of weighted sums, drawn to 0 where there is little weight or agreement."""
    mean = total / np.maximum(weight, 1e-9)
    variance = np.maximum(squares / np.maximum(weight, 1e-9) - mean**2, 0)
    agreement = mean**2 / np.maximum(mean**2 + DISAGREEMENT * variance, 1e-12)
    return (agreement * total / (weight + PRIOR)).astype(np.float32)


def keep_samples(values: FloatArray, nodes: SharedNodes, samples: Samples) -> None:
    """Put exact samples back where they are nodes: in the middle of blocks."""
    decoded = samples.exact[samples.row_of[samples.exact] >= 0]
    middle = len(nodes_of_part(nodes.factor)[CENTRE]) // 2
    number = nodes.starts[samples.row_of[decoded], CENTRE] + middle
    values[number] = samples.patches[decoded, CENTRE]


def _unit(vectors: FloatArray) -> FloatArray:
    """Return vectors (3, n) of length 1; 0 stays 0."""
    length = np.maximum(np.sqrt(_dot(vectors, vectors)), np.float32(1e-6))
    return (vectors / length).astype(np.float32, copy=False)


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the products of vectors (3, n), summed in their order."""
    product: FloatArray = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product
