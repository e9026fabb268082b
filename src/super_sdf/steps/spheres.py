"""Move the surface so that it touches the sphere of every sample.

An exact sample x with distance d is the centre of a sphere of radius |d| that touches the surface
at its foot point x - d n, where n is the surface normal there. The refined field should be 0 at the
foot point. It is not quite, since the network sees a sample as one number among many. In steps:

1. ``find_foot_points`` follows the field's gradient from each exact sample to its foot point, and
   reads the field there: the error, with a weight for how far to trust it.
2. ``mean_at_nodes`` averages the errors at the corners of voxels, which also corrects walls that
   lie between samples; then what is left of them on a lattice twice as fine.
3. ``fit_to_spheres`` subtracts the averages from the field, by trilinear interpolation.

Reference: Sellán, Batty and Stein, "Reach For the Spheres: Tangency-Aware Surface Reconstruction
of SDFs", 2023, for the constraint; it is solved differently here.

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
from .band import MAX_DIFFERENCE
from .interpolation import CELL, find_cell, prolong, sample_trilinear
from .nodes import SharedParts, nodes_of_part, number_parts

ITERATIONS = 5  # of the search for a foot point
MAX_DISTANCE = 2.8  # samples near the band's edge, 3, may have been truncated there
TYPICAL_ERROR = 0.2  # scale of the Cauchy weight of an error at a foot point
MAX_ERROR = 0.6  # larger errors are clipped
SQUARINGS = 3  # of the cosine between the search direction and the normal: its 8th power
MIN_WEIGHT = 1e-3  # foot points of a smaller weight are dropped
PRIOR_WEIGHT = 0.2  # of the assumption that the error is 0, in foot points
VARIANCE_PENALTY = 0.5  # how strongly disagreement of the errors reduces their mean
MIN_SLOPE = 0.7  # towards the steepest neighbour; near 1 for a distance
CORNER_PARTS = np.flatnonzero(np.abs(NEIGHBOURHOOD).all(1))
MAX_NOISY_SHARE = 0.02  # of all samples; in a noisier field no sample is taken as exact

TEMPORARIES = 64  # numbers per sample in the search for its foot point

# The fitted values of a block depend on this many planes of voxels to either side, one each for:
# the foot points in the blocks beside it; those in the blocks beside these, for the coarse mean;
# their samples; the blocks that the search for a foot point reads; the averaging of shared nodes.
REACH_IN_VOXELS = 5


@dataclass(frozen=True, eq=False)
class ExactSamples:
    """Samples that can be taken as exact distances, and the blocks round them.

    Attributes
    ----------
    patches : (V, 27) float32
        The samples round each voxel of the band, in half voxels.
    exact : (n,) int32
        Rows of ``patches`` whose own sample is exact.
    table : (V, 27) int32
        Neighbour table of the band, -1 where there is no neighbour.
    row_of : (V + 1,) int32
        The block of each voxel, -1 if it was not decoded. The last entry is -1, for the index -1
        of absent neighbours.
    """

    patches: FloatArray
    exact: IntArray
    table: IntArray
    row_of: IntArray


@dataclass(frozen=True, eq=False)
class FootPoints:
    """Foot points of samples, and the field's value there.

    Attributes
    ----------
    rows : (n,) int32
        The block that each lies in.
    place : (3, n) float32
        Position in the block, 0 to 1 along each axis.
    values : (n,) float32
        The field there, in half voxels: the error, since it should be 0.
    weights : (n,) float32
        How far to trust it, 0 to 1.
    """

    rows: IntArray
    place: FloatArray
    values: FloatArray
    weights: FloatArray


def fit_to_spheres(
    blocks: FloatArray, parts: SharedParts, factor: int, samples: ExactSamples, threads: int = 1
) -> None:
    """Move the surface so that it touches the samples' spheres.

    Nodes at exact samples keep the sample's value. Without exact samples nothing is changed.

    Parameters
    ----------
    blocks : (Q, D + 1) float32
        Node values in half voxels, changed in place; the last column is 0.
    parts : SharedParts
        Of the D voxels.
    factor : int
        K.
    samples : ExactSamples
        The samples whose spheres the surface should touch.
    threads : int
        Threads to use.
    """
    if not len(samples.exact):  # in a noisy field, for example
        return
    feet = find_foot_points(blocks, factor, samples, threads)
    correction = find_correction(feet, parts)

    def subtract(rows: slice) -> None:
        blocks[:, rows] -= prolong(correction[:, rows], 2, factor)

    map_chunks(subtract, correction.shape[1], len(blocks), threads)
    restore_samples(blocks, factor, samples)


def find_correction(feet: FootPoints, parts: SharedParts) -> FloatArray:
    """Return the correction on the lattice of 2 cells per block, (27, D), in half voxels.

    It is the mean error at the corners of voxels, interpolated to the finer lattice, plus the mean
    there of the errors that this leaves.
    """
    numbers, count = number_parts(parts, np.ones(27, np.int64))
    coarse, at, shares = mean_at_nodes(feet, feet.values, numbers, count, 1)
    remaining = feet.values - (coarse.take(at) * shares).sum(0)
    fine, *_ = mean_at_nodes(feet, remaining, numbers, count, 2)
    return prolong(coarse.take(numbers[CORNER_PARTS]), 1, 2) + fine.take(numbers)


@dataclass(frozen=True)
class BandSummary:
    """What the band of a whole grid says of its samples, whichever part of it is worked on.

    Attributes
    ----------
    voxels, noisy : int
        Voxels whose samples tell whether the field is noisy, and those round which samples differ
        by more than distances can.
    low, high : float
        The lowest and the highest sample, in half voxels.
    leaves : bool
        Whether a sample on the border of the grid is inside.
    """

    voxels: int
    noisy: int
    low: float
    high: float
    leaves: bool = False

    @property
    def is_noisy(self) -> bool:
        """Whether no sample can be taken as exact."""
        return not self.voxels or self.noisy / self.voxels > MAX_NOISY_SHARE


def summarise(sample: FloatArray, lipschitz: BoolArray, leaves: bool = False) -> BandSummary:
    """Return the summary of samples (V,), some of which tell by ``lipschitz`` how noisy they are.

    No sample is at infinity.
    """
    noisy = len(lipschitz) - int(np.count_nonzero(lipschitz))
    low, high = float(sample.min(initial=np.inf)), float(sample.max(initial=-np.inf))
    return BandSummary(len(lipschitz), noisy, low, high, leaves)


def exact_samples(
    patches: FloatArray,
    lipschitz: BoolArray,
    threads: int = 1,
    sampled: BoolArray | None = None,
    whole: BandSummary | None = None,
) -> BoolArray:
    """Return which samples of a band can be taken as exact distances.

    Parameters
    ----------
    patches : (V, 27) float32
        The samples round each voxel, in half voxels.
    lipschitz : (V,) bool
        From ``is_lipschitz``. If more than a few are False the field is noisy, and no sample is
        taken as exact.
    threads : int
        Threads to use.
    sampled : (V,) bool, optional
        Which are samples, not interpolated: these tell whether the field is noisy. All by default.
    whole : BandSummary, optional
        Of the band of the whole grid, if these are the voxels of a part of it.

    Returns
    -------
    (V,) bool
    """
    sample = patches[:, CENTRE]
    whole = whole or summarise(sample, lipschitz if sampled is None else lipschitz[sampled])
    if not len(patches) or whole.is_noisy:
        return np.zeros(len(patches), bool)
    limits = np.float32(whole.low), np.float32(whole.high)
    near = np.abs(sample) < MAX_DISTANCE
    cut_off = map_chunks(lambda rows: is_cut_off(patches[rows], limits), len(patches), 27, threads)
    exact: BoolArray = lipschitz & near & ~np.concatenate(cut_off)
    return exact


def is_cut_off(patches: FloatArray, limits: tuple[np.float32, np.float32]) -> BoolArray:
    """Return which samples were truncated, (V,) bool.

    A truncated sample has the largest value of its sign, and no neighbour towards which the field
    is as steep as a distance. ``limits`` are the lowest and the highest sample.
    """
    sample = patches[:, CENTRE]
    at_limit = sample == np.where(sample > 0, limits[1], limits[0])
    slope = np.abs(patches - sample[:, None]) / np.maximum(MAX_DIFFERENCE, 1)
    cut_off: BoolArray = at_limit & (slope.max(1) < MIN_SLOPE)
    return cut_off


def find_foot_points(
    blocks: FloatArray, factor: int, samples: ExactSamples, threads: int = 1
) -> FootPoints:
    """Return the foot points of the exact samples, leaving out those outside all blocks.

    Parameters
    ----------
    blocks : (Q, D + 1) float32
        Node values in half voxels; the last column is 0.
    factor : int
        K.
    samples : ExactSamples
        The samples.
    threads : int
        Threads to use.

    Notes
    -----
    The direction from a sample to its foot point is the field's gradient at the foot point, so the
    search iterates: it starts along the gradient of the patch, and then turns half-way towards the
    gradient of the field at the point reached. All the candidates lie at the sample's distance. The
    one where the field is lowest, for a sample outside (highest, for one inside), is the best: a
    sphere that touches the surface lies on the sample's side of it everywhere else.
    """
    chunks = map_chunks(
        lambda some: best_candidates(blocks, factor, samples, some),
        len(samples.exact),
        TEMPORARIES,
        threads,
    )
    rows, place, value, cosine = (np.concatenate(arrays, -1) for arrays in zip(*chunks))
    return weigh_foot_points(rows, place, value, cosine)


def best_candidates(
    blocks: FloatArray, factor: int, samples: ExactSamples, chunk: slice
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Return block (n,), place (3, n), value (n,) and cosine (n,) of samples' best candidates.

    The cosine is that between the search direction and the normal of the field.
    """
    exact = samples.exact[chunk]
    patch = samples.patches[exact].T
    distance = patch[CENTRE]
    direction = _unit(patch[CENTRE + STRIDES] - patch[CENTRE - STRIDES])
    candidates = []
    for _ in range(ITERATIONS):
        rows, place = locate(-distance * direction, exact, samples)
        value, gradient = sample_trilinear(blocks, rows, place, factor)
        normal = _unit(gradient)
        candidates.append((rows, place, value, _dot(direction, normal)))
        direction = np.where(rows >= 0, _unit(direction + normal), direction)
    rows, place, value, cosine = (np.stack(arrays) for arrays in zip(*candidates))
    clearance = np.where(rows >= 0, np.copysign(np.float32(1), distance) * value, np.inf)
    best = clearance.argmin(0), np.arange(len(exact))
    return rows[best], place[best[0], :, best[1]].T, value[best], cosine[best]


def locate(
    steps: FloatArray, exact: IntArray, samples: ExactSamples
) -> tuple[IntArray, FloatArray]:
    """Return the block and the place in it of points at ``steps`` from samples.

    Parameters
    ----------
    steps : (3, n) float32
        In half voxels; at most 3 along an axis, so a point lies in the sample's voxel or a
        neighbour of it.
    exact : (n,) int32
        The samples' rows in the band.
    samples : ExactSamples
        The neighbours and blocks of the samples.

    Returns
    -------
    (n,) int32 and (3, n) float32
        The block, -1 if it was not decoded; the position in it, 0 to 1 along each axis.
    """
    half = steps * np.float32(0.5)
    aside = np.clip(np.rint(half), -1, 1)
    neighbour = samples.table[exact, (STRIDES @ (aside.astype(np.int32) + 1))]
    return samples.row_of[neighbour], np.clip(half - aside + np.float32(0.5), 0, 1)


def weigh_foot_points(
    rows: IntArray, place: FloatArray, values: FloatArray, cosine: FloatArray
) -> FootPoints:
    """Return the foot points with their weights, leaving out those of almost no weight.

    The weight falls with the angle between the search direction and the normal, and with the error
    (a Cauchy weight): a large error is probably a foot point on the wrong part of the surface.

    Parameters
    ----------
    rows : (n,) int32
        Blocks, -1 for none.
    place : (3, n) float32
        Positions in the blocks, 0 to 1.
    values : (n,) float32
        The field there, in half voxels.
    cosine : (n,) float32
        Between search direction and normal.
    """
    unusual = values / np.float32(TYPICAL_ERROR)
    aligned = np.clip(cosine, 0, 1)
    for _ in range(SQUARINGS):  # np.power's last bit depends on the position in the array
        aligned *= aligned
    weights = aligned / (1 + unusual * unusual)
    kept = (rows >= 0) & (weights > MIN_WEIGHT)
    values = np.clip(values[kept], -MAX_ERROR, MAX_ERROR)
    return FootPoints(rows[kept], np.ascontiguousarray(place[:, kept]), values, weights[kept])


def mean_at_nodes(
    feet: FootPoints, values: FloatArray, numbers: IntArray, count: int, cells: int
) -> tuple[FloatArray, NDArray[np.intp], FloatArray]:
    """Return the weighted mean at each node of the values at foot points in the cells round it.

    Parameters
    ----------
    feet : FootPoints
        Positions and weights.
    values : (n,) float32
        The values at the foot points, in half voxels.
    numbers : (27, D) int32
        The node of each part of each block, 0 to ``count - 1``.
    count : int
        Number of nodes.
    cells : {1, 2}
        Cells along a block. With 1 the nodes are the corners of blocks, with 2 all parts.

    Returns
    -------
    (count,) float32, (8, n) int64, (8, n) float32
        The mean, in half voxels; the 8 nodes round each foot point, and its trilinear weights for
        them.
    """
    part, shares = surrounding_parts(feet.place, cells)
    at = numbers.ravel().take(part * numbers.shape[1] + feet.rows).astype(np.intp)
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
    """Return the means of weighted sums, shrunk towards 0 by little weight or large variance.

    Parameters
    ----------
    weight, total, squares : (n,) float64
        Weighted sums of 1, of the values and of their squares.

    Returns
    -------
    (n,) float32
    """
    mean = total / np.maximum(weight, 1e-9)
    variance = np.maximum(squares / np.maximum(weight, 1e-9) - mean**2, 0)
    agreement = mean**2 / np.maximum(mean**2 + VARIANCE_PENALTY * variance, 1e-12)
    return (agreement * total / (weight + PRIOR_WEIGHT)).astype(np.float32)


def restore_samples(blocks: FloatArray, factor: int, samples: ExactSamples) -> None:
    """Set the node in the middle of each block to its sample again, if that is exact."""
    decoded = samples.exact[samples.row_of[samples.exact] >= 0]
    inside = nodes_of_part(factor)[CENTRE]
    middle = inside[len(inside) // 2]
    blocks[middle, samples.row_of[decoded]] = samples.patches[decoded, CENTRE]


def _unit(vectors: FloatArray) -> FloatArray:
    """Return the vectors (3, n) scaled to length 1; 0 stays 0."""
    length = np.maximum(np.sqrt(_dot(vectors, vectors)), np.float32(1e-6))
    return (vectors / length).astype(np.float32, copy=False)


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the dot products of vectors (3, n), (n,), summed in a fixed order."""
    product: FloatArray = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product
