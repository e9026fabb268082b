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

from .band import CENTRE, REACH, is_lipschitz
from .grid import BoolArray, FloatArray, IntArray
from .nodes import block_ijk, number_shared_nodes

DIRECTIONS = 5  # tried for each sample: see find_foot_points
FARTHEST = 2.8  # samples near the band's edge, 3, may have been cut off there
USUAL = 0.2  # a value at a foot point that is larger is less likely a matter of position ...
LARGEST = 0.6  # ... and counts as no more than this
ALIGNMENT_POWER = 8  # of the cosine between a sample's direction and the normal where it touches
PRIOR = 0.2  # foot points that speak for no correction at all
DISAGREEMENT = 0.5  # how much the variance of what foot points say speaks against it
FLAT = 0.7  # the largest slope towards a neighbour; that of a distance is near 1
MOST_NOISY = 0.02  # share of samples that are no distances: beyond, none is taken for exact

STRIDES = np.array([9, 3, 1])  # of the places in a neighbourhood
CELL = np.indices((2, 2, 2)).reshape(3, 8).T


@dataclass(frozen=True, eq=False)
class Lattice:
    """Nodes of all blocks, so many cells along a voxel.

    Attributes
    ----------
    numbers : (D, (cells+1)^3) int32
        The nodes of each block: a node that blocks share has one number.
    count : int
        How many different nodes there are.
    cells : int
        Along a voxel; K for the nodes of the fine field.
    """

    numbers: IntArray
    count: int
    cells: int


@dataclass(frozen=True, eq=False)
class Blocks:
    """The decoded voxels, and where a sample of the band finds those round it.

    Attributes
    ----------
    table : (V, 27) int32
        Neighbours in the band, -1 where there is none.
    row_of : (V + 1,) int32
        Which block is a voxel's, -1 if it was not decoded; the last stands for absent ones.
    own_table : (D, 27) int32
        Neighbours among the decoded voxels.
    nodes : Lattice
        The fine field's nodes.
    """

    table: IntArray
    row_of: IntArray
    own_table: IntArray
    nodes: Lattice

    def lattice(self, cells: int) -> Lattice:
        """Return a coarser lattice of the same blocks."""
        return Lattice(*number_shared_nodes(self.own_table, cells), cells)


@dataclass(frozen=True, eq=False)
class FootPoints:
    """Where spheres should touch the surface.

    Attributes
    ----------
    rows : (n,) int32
        The block each lies in.
    place : (n, 3) float32
        Where in the block, from 0 to 1.
    values : (n,) float32
        What the field says there.
    weights : (n,) float32
        How far to trust that.
    """

    rows: IntArray
    place: FloatArray
    values: FloatArray
    weights: FloatArray


def fit_to_spheres(values: FloatArray, patches: FloatArray, blocks: Blocks) -> FloatArray:
    """Return the node values, (n,), moved so that the surface touches the samples' spheres.

    ``patches`` are those of the band, (V, 27). Samples that cannot be distances are left out; where
    they are many, nothing is moved. Nodes at exact samples keep the sample.
    """
    samples = exact_samples(patches)
    if not len(samples):  # a noisy field, say: nothing to carry to the nodes
        return values
    feet = find_foot_points(values, patches, samples, blocks)
    coarse, fine = blocks.lattice(1), blocks.lattice(2)
    first = mean_at_nodes(feet, coarse)
    left = replace(feet, values=feet.values - interpolate(first, coarse, feet.rows, feet.place))
    correction = carry(first, coarse, fine) + mean_at_nodes(left, fine)
    fitted = values - carry(correction, fine, blocks.nodes)
    return keep_samples(fitted, patches, samples, blocks)


def exact_samples(patches: FloatArray) -> IntArray:
    """Return the samples, rows of the band, that can be taken for exact distances."""
    lipschitz = is_lipschitz(patches)
    if (~lipschitz).mean() > MOST_NOISY:
        return np.empty(0, np.int32)
    near = np.abs(patches[:, CENTRE]) < FARTHEST
    return np.flatnonzero(lipschitz & near & ~is_cut_off(patches)).astype(np.int32)


def is_cut_off(patches: FloatArray) -> BoolArray:
    """Say which samples, (V,), were cut off: at the limit of their sign, and no neighbour steep."""
    sample = patches[:, CENTRE]
    at_limit = sample == np.where(sample > 0, sample.max(), sample.min())
    slope = np.abs(patches - sample[:, None]) / np.maximum(REACH, 1)
    cut_off: BoolArray = at_limit & (slope.max(1) < FLAT)
    return cut_off


def find_foot_points(
    values: FloatArray, patches: FloatArray, samples: IntArray, blocks: Blocks
) -> FootPoints:
    """Return the foot points of samples; those beyond the blocks are left out.

    The direction to the surface is the field's gradient where it is reached, hence found by
    turns: first the patch's gradient, then half-way towards the field's where that led. Of all
    points at the right distance the nearest to the surface, or deepest beyond, is the best: a
    sphere that touches is outside everywhere else.
    """
    near = patches[samples]
    distance = near[:, CENTRE]
    direction = _unit(near[:, CENTRE + STRIDES] - near[:, CENTRE - STRIDES])
    tries = []
    for _ in range(DIRECTIONS):
        rows, place = locate(-distance[:, None] * direction, samples, blocks)
        value = interpolate(values, blocks.nodes, rows, place)
        normal = _unit(gradient_at(values, blocks.nodes, rows, place))
        tries.append((rows, place, value, np.einsum("na,na->n", direction, normal)))
        direction = np.where((rows >= 0)[:, None], _unit(direction + normal), direction)
    rows, place, value, cosine = (np.stack(parts) for parts in zip(*tries))
    clearance = np.where(rows >= 0, np.copysign(1, distance) * value, np.inf)
    best = clearance.argmin(0), np.arange(len(samples))
    return weighted_feet(rows[best], place[best], value[best], cosine[best])


def weighted_feet(
    rows: IntArray, place: FloatArray, values: FloatArray, cosine: FloatArray
) -> FootPoints:
    """Return the foot points that count, by the angle at which they are met and what is there."""
    weights = np.clip(cosine, 0, 1) ** ALIGNMENT_POWER / (1 + (values / USUAL) ** 2)
    kept = (rows >= 0) & (weights > 1e-3)
    values = np.clip(values[kept], -LARGEST, LARGEST)
    return FootPoints(rows[kept], place[kept], values, weights[kept])


def locate(steps: FloatArray, samples: IntArray, blocks: Blocks) -> tuple[IntArray, FloatArray]:
    """Return the blocks, (n,), that points at ``steps`` (n, 3) from samples lie in, and where.

    No step is longer than 3 along an axis, so a point lies in the sample's voxel or a neighbour's.
    The place is from 0 to 1 along each axis; the block -1 where there is none.
    """
    aside = np.clip(np.rint(steps / 2), -1, 1)
    neighbour = blocks.table[samples, ((aside + 1) @ STRIDES).astype(np.intp)]
    return blocks.row_of[neighbour], np.clip(steps / 2 - aside + 0.5, 0, 1).astype(np.float32)


def cells_at(lattice: Lattice, rows: IntArray, place: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the nodes, (n, 8), of the cells that places in blocks lie in, and where in them."""
    corners, within = _corners(place, lattice.cells)
    return lattice.numbers[rows[:, None], corners], within


def interpolate(
    values: FloatArray, lattice: Lattice, rows: IntArray, place: FloatArray
) -> FloatArray:
    """Return the values, (n,), that a lattice's nodes give places (n, 3) in blocks (n,)."""
    nodes, within = cells_at(lattice, rows, place)
    read: FloatArray = np.einsum("nc,nc->n", values[nodes], _trilinear(within))
    return read


def gradient_at(
    values: FloatArray, lattice: Lattice, rows: IntArray, place: FloatArray
) -> FloatArray:
    """Return the gradient, (n, 3) in units of cells, at places in blocks."""
    nodes, within = cells_at(lattice, rows, place)
    cell = values[nodes].reshape(-1, 2, 2, 2)
    x, y, z = (np.stack([1 - t, t], 1) for t in within.T)
    along_z = np.einsum("nxyz,nz->nxy", cell, z)
    across_z = cell[..., 1] - cell[..., 0]
    parts = [
        np.einsum("ny,ny->n", along_z[:, 1] - along_z[:, 0], y),
        np.einsum("nx,nx->n", along_z[:, :, 1] - along_z[:, :, 0], x),
        np.einsum("nxy,nx,ny->n", across_z, x, y),
    ]
    return np.stack(parts, 1)


def mean_at_nodes(feet: FootPoints, lattice: Lattice) -> FloatArray:
    """Return for each node of a lattice what the foot points in the cells round it say."""
    nodes, within = cells_at(lattice, feet.rows, feet.place)
    weights = (_trilinear(within) * feet.weights[:, None]).astype(np.float64)

    def total(power: int) -> NDArray[np.float64]:
        spoken = weights * feet.values[:, None].astype(np.float64) ** power
        return np.bincount(nodes.ravel(), spoken.ravel(), lattice.count).astype(np.float64)

    return agreed_mean(total(0), total(1), total(2)).astype(np.float32)


def carry(values: FloatArray, lattice: Lattice, finer: Lattice) -> FloatArray:
    """Return the values at a finer lattice's nodes; blocks that share a node agree on it."""
    carried = np.zeros(finer.count, np.float32)
    carried[finer.numbers] = values[lattice.numbers] @ _weights_from(lattice.cells, finer.cells).T
    return carried


def agreed_mean(
    weight: NDArray[np.float64], total: NDArray[np.float64], squares: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the means of weighted sums, drawn to 0 where there is little weight or agreement."""
    mean = total / np.maximum(weight, 1e-9)
    variance = np.maximum(squares / np.maximum(weight, 1e-9) - mean**2, 0)
    agreement = mean**2 / np.maximum(mean**2 + DISAGREEMENT * variance, 1e-12)
    drawn: NDArray[np.float64] = agreement * total / (weight + PRIOR)
    return drawn


def keep_samples(
    values: FloatArray, patches: FloatArray, samples: IntArray, blocks: Blocks
) -> FloatArray:
    """Put exact samples back where they are nodes: in the middle of blocks."""
    kept = values.copy()
    decoded = samples[blocks.row_of[samples] >= 0]
    numbers = blocks.nodes.numbers
    kept[numbers[blocks.row_of[decoded], numbers.shape[1] // 2]] = patches[decoded, CENTRE]
    return kept


def _corners(place: FloatArray, cells: int) -> tuple[IntArray, FloatArray]:
    """Return which of a block's nodes, (n, 8), are round places (n, 3), and where between them."""
    low = np.minimum((place * cells).astype(np.int32), cells - 1)
    corners = (low[:, None] + CELL) @ np.array([(cells + 1) ** 2, cells + 1, 1], np.int32)
    return corners.astype(np.int32), place * cells - low


def _weights_from(cells: int, finer: int) -> FloatArray:
    """Return the weights that interpolate from a lattice's nodes to those of a finer one."""
    place = (block_ijk(finer) / finer).astype(np.float32)
    corners, within = _corners(place, cells)
    weights = np.zeros((len(place), (cells + 1) ** 3), np.float32)
    np.put_along_axis(weights, corners, _trilinear(within), 1)
    return weights


def _trilinear(within: FloatArray) -> FloatArray:
    """Return the weights (n, 8) of a cell's corners at places (n, 3) from 0 to 1."""
    sides = np.where(CELL == 1, within[:, None], 1 - within[:, None])
    weights: FloatArray = sides.prod(2)
    return weights


def _unit(vectors: FloatArray) -> FloatArray:
    """Return vectors (n, 3) of length 1; 0 stays 0."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    unit: FloatArray = (vectors / np.maximum(length, 1e-6)).astype(np.float32)
    return unit
