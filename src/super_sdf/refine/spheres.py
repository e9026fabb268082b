"""Move the surface so that it touches the sphere of every sample.

An exact sample x with distance d is the centre of a sphere of radius |d| that touches the surface
at its foot point x - d n, where n is the surface normal there. Samples of the band have one, and
so have those a voxel beyond it: many of these touch the same edges and tips, of which the samples
nearby say little. The refined field should be 0 at the foot points. It is not quite, since the
network sees a sample as one number among many. ``find_foot_points`` reads the field there: the
error. ``find_correction`` averages the errors at the corners of voxels, which also corrects walls
that lie between samples; then, twice, what is left of them on a lattice twice as fine. The averages
are subtracted from the field, interpolated trilinearly.

Reference: Sellán, Batty and Stein, "Reach For the Spheres: Tangency-Aware Surface Reconstruction
of SDFs", 2023, for the constraint; it is solved differently here.

Lengths are in half voxels, as in ``band``. Sums are written out, so that the bits of a result do
not depend on how many are worked on together.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import CENTRE, CORNERS, NEIGHBOURHOOD, STRIDES, FloatArray, IntArray, inner
from ..threads import chunks_of, map_chunks
from .band import MAX_DISTANCE, MIN_SLOPE, Band
from .nodes import SharedParts, VoxelIndex, number_parts, within

BEYOND = 2.0  # samples this much farther than MAX_DISTANCE have spheres, too
APART = np.maximum(2 * np.linalg.norm(NEIGHBOURHOOD, axis=1), 1).astype(np.float32)  # of samples
LOOKS = 9  # at a sphere, for the place where it touches
FIRST_TURN = 0.5  # share of the way to the normal, for the second look ...
NEARER, FARTHER = 1.6, 0.4  # ... and what it is multiplied by after a look that gained, or not
SETTLED = 0.9999  # cosine between a direction and the normal at which nothing is gained any more
TYPICAL_ERROR = 0.2  # scale of the Cauchy weight of an error at a foot point ...
CLEAR_ERROR = 0.05  # ... and where a sphere from beyond the band is clear of the surface
MAX_ERROR = 0.6  # larger errors are clipped
SQUARINGS = 3  # of the cosine between the search direction and the normal: its 8th power
FAR_PENALTY = 0.5  # how the weight falls with a sample's distance beyond MAX_DISTANCE
MIN_WEIGHT = 1e-3  # foot points of a smaller weight are dropped
TEMPORARIES = 64  # numbers per sample in the search for its foot point

PRIOR_WEIGHT = 0.2  # of the assumption that the error is 0, in foot points
VARIANCE_PENALTY = 0.5  # how strongly disagreement of the errors reduces their mean
CORNER_PARTS = np.flatnonzero(np.abs(NEIGHBOURHOOD).all(1))
CELLS = 1, 2, 2  # along a block, of the lattice on which errors are averaged, each time

# The fitted values of a block depend on this many voxels to either side: one each time that errors
# are averaged, for the foot points in the blocks beside; two from these to their samples, and two
# to the blocks in which they were searched for; and one for the averaging of shared nodes.
REACH_IN_VOXELS = len(CELLS) + 2 + 2 + 1

Spheres: TypeAlias = tuple[IntArray, FloatArray, FloatArray]
"""Samples (3, n), their signed distances (n,), and directions, about the gradients there (3, n)."""
Feet: TypeAlias = tuple[IntArray, FloatArray, FloatArray, FloatArray]  # block, place, error, weight


class Look(NamedTuple):
    """The field at a place on each of n spheres."""

    direction: FloatArray  # (3, n), from the place to the sample, or back for a sample inside
    rows: IntArray  # (n,), the block that the place lies in, -1 if it was not decoded
    place: FloatArray  # (3, n), the position in it, 0 to 1 along each axis
    value: FloatArray  # (n,), the field
    normal: FloatArray  # (3, n), its gradient, of length 1


def fit_to_spheres(
    blocks: FloatArray,
    parts: SharedParts,
    factor: int,
    band: Band,
    index: VoxelIndex,
    threads: int = 1,
) -> None:
    """Move the surface so that it touches the samples' spheres.

    Nodes at exact samples keep the sample's value. Without exact samples nothing is changed.
    ``blocks`` (Q, D + 1), in half voxels, are changed in place; the last column is 0. ``parts`` and
    ``index`` are of the D voxels.
    """
    if not band.exact.any():  # in a noisy field, for example
        return
    centre, distance, direction = spheres_of_band(band, threads)

    def touch(some: slice) -> tuple[NDArray[Any], ...]:
        spheres = centre[:, some], distance[some], direction[:, some]
        return find_foot_points(blocks, factor, spheres, index)

    feet = map_chunks(touch, len(distance), TEMPORARIES, threads)
    rows, place, errors, weights = (np.concatenate(each, -1) for each in zip(*feet))
    correction = find_correction(parts, (rows, place, errors, weights), threads)

    def subtract(rows: slice) -> None:
        blocks[:, rows] -= prolong(correction[:, rows], 2, factor)

    map_chunks(subtract, correction.shape[1], len(blocks), threads)
    rows = index.find(band.voxel_ijk[band.exact])
    sample = band.patches[band.exact, CENTRE]
    blocks[len(blocks) // 2, rows[rows >= 0]] = sample[rows >= 0]


def spheres_of_band(band: Band, threads: int = 1) -> Spheres:
    """Return the spheres of the exact samples of a band, then of those a voxel beyond.

    Samples beyond have no sphere unless they lie between the band's limits. Of each, the direction
    is that of the exact sample beside it from which it rises most steeply, about by 1 along the
    gradient; one that was cut off does not rise as distances do.
    """
    exact, (low, high) = np.flatnonzero(band.exact), band.limits
    centre, own = band.voxel_ijk[exact], band.patches[exact, CENTRE]

    def find_beyond(rows: slice) -> tuple[NDArray[Any], ...]:
        patch, sample = band.patches[exact[rows]], own[rows, None]
        size = np.abs(patch)
        slope = (np.copysign(np.float32(1), sample) * patch - np.abs(sample)) / APART
        found = (size >= MAX_DISTANCE) & (size < MAX_DISTANCE + BEYOND) & (slope >= MIN_SLOPE)
        found &= (patch > low) & (patch < high)
        row, place = np.nonzero(found)
        kept = within(centre[rows][row] + NEIGHBOURHOOD[place], band.grid.shape)
        return rows.start + row[kept], place[kept], slope[row, place][kept]

    parts = map_chunks(find_beyond, len(exact), 4 * TEMPORARIES, threads)
    row, place, slope = map(np.concatenate, zip(*parts))
    keys = np.ravel_multi_index(tuple((centre[row] + NEIGHBOURHOOD[place]).T), band.grid.shape)
    order = np.argsort(keys, kind="stable")  # they are nearly so
    first = np.flatnonzero(np.diff(keys[order], prepend=-1))  # of those of the same sample
    most = np.maximum.reduceat(slope[order], first).repeat(np.diff(first, append=len(order)))
    order = order[slope[order] == most]
    steepest = order[np.diff(keys[order], prepend=-1) > 0]
    row, place = row[steepest], place[steepest]
    beside = band.patches[exact[:, None], CENTRE + STRIDES * np.array([[[1]], [[-1]]])]
    direction = _unit((beside[0] - beside[1]).T)
    return (
        np.concatenate([centre, centre[row] + NEIGHBOURHOOD[place]]).T,
        np.concatenate([own, band.patches[exact[row], place]]),
        np.concatenate([direction, direction[:, row]], 1),
    )


def find_foot_points(blocks: FloatArray, factor: int, spheres: Spheres, index: VoxelIndex) -> Feet:
    """Return foot points of samples; those outside all blocks (Q, D + 1) are left out.

    The weight, 0 to 1, falls with the angle between direction and normal, with the error (a Cauchy
    weight: a large error is probably a place on the wrong part of the surface), and with the
    sample's distance, since an error of the direction matters more. Spheres from beyond the band
    mostly touch edges, which linear cells cut off: that they are clear of them is no error.
    """
    centre, distance, direction = spheres

    def look(which: NDArray[Any] | slice, direction: FloatArray) -> Look:
        """Return what the field is where directions (3, n) meet some spheres."""
        half = distance[which] * direction * np.float32(-0.5)
        aside = np.rint(half)  # whole voxels from the sample
        rows = index.find((centre[:, which] + aside.astype(np.int32)).T).astype(np.int32)
        place = np.clip(half - aside + np.float32(0.5), 0, 1)
        value, gradient = sample_trilinear(blocks, rows, place, factor)
        return Look(direction, rows, place, value, _unit(gradient))

    found = _turned(look, distance, direction)
    size = np.abs(distance)
    is_clear = (size >= MAX_DISTANCE) & (distance * found.value > 0)
    unusual = found.value / np.where(is_clear, np.float32(CLEAR_ERROR), np.float32(TYPICAL_ERROR))
    aligned = np.clip(inner(found.direction, found.normal), 0, 1)
    for _ in range(SQUARINGS):  # np.power's last bit depends on the position in the array
        aligned *= aligned
    farther: FloatArray = np.maximum(size - np.float32(MAX_DISTANCE), 0)
    penalty: FloatArray = (1 + unusual * unusual) * (1 + np.float32(FAR_PENALTY) * farther)
    weights = aligned / penalty
    values = np.clip(found.value, -MAX_ERROR, MAX_ERROR)
    kept = (found.rows >= 0) & (weights > MIN_WEIGHT)
    return found.rows[kept], found.place[:, kept], values[kept], weights[kept]


def _turned(look: Callable[..., Look], distance: FloatArray, direction: FloatArray) -> Look:
    """Return the places where spheres touch the surface.

    A sphere that touches the surface lies on the sample's side of it everywhere else. So the place
    is where the field is lowest on the sphere of a sample outside, highest for one inside, and its
    direction is the normal there. Each look turns the direction some way to the normal; a turn
    that gains nothing is taken back, and the next one is smaller.
    """
    found, turn = look(slice(None), direction.copy()), np.full(len(distance), FIRST_TURN, "f4")
    for _ in range(LOOKS - 1):
        cosine = inner(found.direction, found.normal)
        rest = np.flatnonzero((found.rows >= 0) & (cosine < SETTLED))
        if not len(rest):
            break
        start, share = found.direction[:, rest], turn[rest]
        new = look(rest, _unit(start + share * (found.normal[:, rest] - start)))
        gain = np.copysign(1, distance[rest]) * (found.value[rest] - new.value)
        better = (new.rows >= 0) & (gain > 0)
        nearer, farther = np.minimum(share * np.float32(NEARER), 1), share * np.float32(FARTHER)
        turn[rest] = np.where(better, nearer, farther)
        at, gained = rest[better], np.flatnonzero(better)
        for mine, its in zip(found, new):
            for line, new_line in zip(np.atleast_2d(mine), np.atleast_2d(its)):  # fast
                line[at] = new_line[gained]
    return found


def _unit(vectors: FloatArray) -> FloatArray:
    """Return the vectors (3, n) scaled to length 1; 0 stays 0."""
    length: FloatArray = np.maximum(np.sqrt(inner(vectors, vectors)), np.float32(1e-6))
    return vectors / length


def sample_trilinear(
    blocks: FloatArray, rows: IntArray, place: FloatArray, factor: int
) -> tuple[FloatArray, FloatArray]:
    """Return the trilinear value (n,) and its gradient per cell (3, n) at places in blocks.

    A place is given by its block, a column of ``blocks`` (Q, D + 1), where -1 reads the last, and
    the position in it, (3, n), 0 to 1 along each axis.
    """
    low, (x, y, z) = _find_cell(place, factor)
    side, width = factor + 1, blocks.shape[1]
    steps = (CORNERS @ np.array([side * side, side, 1])) * width
    first = ((low[0] * side + low[1]) * side + low[2]) * np.int64(width) + rows % width
    corner = blocks.ravel().take(first + steps[:, None])  # (8, n)
    along_z = corner[1::2] - corner[::2]
    at_z = corner[::2] + along_z * z
    along_y = at_z[1::2] - at_z[::2]
    at_yz = at_z[::2] + along_y * y
    along_x = at_yz[1] - at_yz[0]
    slope_z = along_z[::2] + (along_z[1::2] - along_z[::2]) * y
    gradient_y = along_y[0] + (along_y[1] - along_y[0]) * x
    gradient_z = slope_z[0] + (slope_z[1] - slope_z[0]) * x
    return at_yz[0] + along_x * x, np.stack([along_x, gradient_y, gradient_z])


def _find_cell(place: FloatArray, cells: int) -> tuple[IntArray, FloatArray]:
    """Return the cell of each place (3, n) in a block, (3, n), and the position in it, 0 to 1."""
    scaled = place * np.float32(cells)
    low = np.minimum(scaled.astype(np.int32), cells - 1)
    return low, scaled - low.astype(np.float32)


def find_correction(parts: SharedParts, feet: Feet, threads: int = 1) -> FloatArray:
    """Return the correction on the lattice of 2 cells per block, (27, D), in half voxels.

    It is the mean error of foot points at the corners of voxels, plus the means at the nodes of the
    lattice of the errors that are left each time. Where errors disagree, means are smaller. Errors
    are summed in the order of the samples, some at a time, to save memory.
    """
    (rows, place, errors, weights), (numbers, count) = feet, number_parts(parts, 2)  # one per part
    correction, left = np.zeros(numbers.shape, np.float32), errors.copy()

    def nodes_round(some: slice) -> tuple[NDArray[np.intp], FloatArray]:
        """Return the 8 nodes round foot points, (8, n), and their trilinear weights there."""
        low, inside = _find_cell(place[:, some], cells)
        step = STRIDES * (2 // cells)
        upper = np.stack([1 - inside, inside])  # (2, 3, n)
        x, y, z = CORNERS.T
        at = (step @ low + (CORNERS @ step)[:, None]) * numbers.shape[1] + rows[some]
        return numbers.ravel().take(at).astype(np.intp), upper[x, 0] * upper[y, 1] * upper[z, 2]

    def reduce(some: slice) -> None:
        at, shares = nodes_round(some)
        left[some] -= (means.take(at) * shares).sum(0)

    def mean(some: slice) -> FloatArray:
        weight, total, squares = sums[:, some]
        plain = total / np.maximum(weight, 1e-9)
        variance = np.maximum(squares / np.maximum(weight, 1e-9) - plain**2, 0)
        agreement = plain**2 / np.maximum(plain**2 + VARIANCE_PENALTY * variance, 1e-12)
        return np.asarray(agreement * total / (weight + PRIOR_WEIGHT), np.float32)

    for cells in CELLS:
        sums = np.zeros((3, count))  # of weights, errors and squares
        for some in chunks_of(len(rows), TEMPORARIES):
            at, shares = nodes_round(some)
            at, weight = at.T.ravel(), (shares * weights[some]).T.astype(np.float64, "C")
            for total in sums:
                np.add.at(total, at, weight.ravel())
                weight *= left[some, None]
        means = np.concatenate(map_chunks(mean, count, 8, threads))
        map_chunks(reduce, len(rows), TEMPORARIES, threads)
        own = CORNER_PARTS if cells == 1 else slice(None)
        for some in chunks_of(len(correction[0]), 4 * len(correction)):
            correction[:, some] += prolong(means.take(numbers[own, some]), cells, 2)
    return correction


def prolong(values: FloatArray, cells: int, finer: int) -> FloatArray:
    """Interpolate values trilinearly to the nodes of a finer lattice of the same n blocks.

    ``cells`` and ``finer`` are the cells along a block before and after, and values
    ((cells + 1)^3, n) become ((finer + 1)^3, n). If the copies of shared nodes were equal before,
    they are equal, bit for bit.
    """
    low, rest = np.divmod(np.arange(finer + 1) * cells, finer)
    block = values.reshape(*(cells + 1,) * 3, -1)
    for axis in range(3):
        lines = np.moveaxis(block, axis, 0)
        steps, shares = np.diff(lines, axis=0), (rest / finer).astype(np.float32)
        nodes = (lines[i] + steps[i] * x if x else lines[i] for i, x in zip(low, shares))
        block = np.stack(list(nodes), axis)
    return block.reshape(len(block) ** 3, -1)
