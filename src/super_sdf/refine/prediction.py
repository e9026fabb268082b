"""The first values at the nodes of blocks: the network's, or the spline through the samples.

Of a smooth field the cubic B-spline is nearer than any network that was trained on distances.

Reference: Unser, Aldroubi and Eden, "B-spline signal processing", 1993. The prefilter is the
symmetric exponential of the pole sqrt(3) - 2, cut off at ``TAIL`` samples. All sums are written
out, so that the bits of a result do not depend on how the grid was cut.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray, IntArray
from ..grid.samples import in_spacings, over_three, read_box
from ..network.contract import Adapter, decode
from ..threads import chunks_of
from .band import Band
from .nodes import block_offsets

AT_ONCE = 500_000  # voxels that the network sees at a time, about: they take 1.7 kB each
POLE = 3**0.5 - 2
TAIL = 12  # samples after which the prefilter has fallen to 1e-7
BEYOND = TAIL + 2  # samples to either side on which the spline in a voxel depends
CUBE = 64  # voxels along the edge of a cube that is worked on at a time
SIDE = 5  # coefficients along an axis on which the spline within half a voxel of a sample depends
# Sums of fourth differences, in voxels, from which values jump, and from which they are linear.
JUMPING, JUMPED = 5.0, 9.0


def predict(
    band: Band,
    table: IntArray,
    voxels: IntArray,
    network: Adapter,
    factor: int,
    threads: int = 1,
    progress: Callable[[float], None] | None = None,
) -> FloatArray:
    """Return the network's values in some voxels (D,), rows of a band, as blocks (Q, D + 1).

    A large band is worked on in runs of planes, with the planes beside them that values depend on.
    """
    plane, offsets, reach = band.voxel_ijk[:, 0], block_offsets(factor), network.receptive_field
    patches = np.hstack([band.patches, widely(band)]) if network.wide else band.patches
    parts = -(-len(plane) // AT_ONCE)
    blocks = np.zeros((len(offsets), len(voxels) + 1), np.float32)
    if parts == 1 or reach is None:
        decode(network, (patches, table, voxels), offsets, blocks[:, :-1], threads)
        return blocks
    ends = {-1, *plane[np.arange(1, parts) * len(plane) // parts].tolist(), band.grid.shape[0]}
    for first, last in pairwise(sorted(ends)):  # the planes after the first, to the last
        start, stop = np.searchsorted(plane, [first + 1 - reach, last + 1 + reach])
        own = slice(*np.searchsorted(plane[voxels], [first, last], "right").tolist())
        near = table[start:stop] - np.int32(start)
        near[(near < 0) | (near >= stop - start)] = -1
        inputs = patches[start:stop], near, voxels[own] - np.int32(start)
        decode(network, inputs, offsets, blocks[:, own], threads)
        if progress:
            progress(last / band.grid.shape[0])
    return blocks


def widely(band: Band) -> FloatArray:
    """Return what the sides of the samples round voxels tell of their distances, (V, 2)."""
    from ..grid.derived import BLURRED, wide_distances  # imported here, as few need it

    found = np.empty((len(band.voxel_ijk), 2), np.float32)
    for rows, ijk, values in _in_cubes(band, band.voxel_ijk, BLURRED):
        found[rows] = 2 * wide_distances(values <= 0, ijk)
    return found


def _in_cubes(
    band: Band, voxel_ijk: IntArray, beyond: int
) -> Iterator[tuple[NDArray[np.intp], IntArray, FloatArray]]:
    """Yield the rows of the voxels (n, 3) in each cube, with the samples of a box round them.

    Of each the place in the box is given, (m, 3), and of the box the values in half voxels.
    """
    shape, unit = np.array(band.grid.shape), band.grid.voxel_size / 2
    cube = np.ravel_multi_index(tuple((voxel_ijk // CUBE).T), tuple(shape // CUBE + 1))
    order = np.argsort(cube, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(cube[order])) + 1) if len(order) else []:
        ijk = voxel_ijk[rows]
        low, high = np.maximum(ijk.min(0) - beyond, 0), np.minimum(ijk.max(0) + beyond + 1, shape)
        values = in_spacings(read_box(band.grid.samples, low, high), unit)
        yield rows, ijk - low, values - np.float32(band.offset / unit)


def interpolate(band: Band, voxels: IntArray, factor: int) -> FloatArray:
    """Return the cubic spline of the samples at the nodes of voxels' blocks (Q, D + 1).

    Voxels (D,) are rows of a band. Where values jump, as in fused depth images, a spline would
    swing, and nodes are interpolated linearly.
    """
    grid, voxel_ijk = band.grid, band.voxel_ijk[voxels]
    # the weights of samples -2 to 2 for the nodes along an axis, (K + 1, 5)
    far = np.abs(np.arange(factor + 1)[:, None] / factor - 0.5 - np.arange(-2, 3))
    linear = np.clip(1 - far, 0, None).astype(np.float32)
    tails = np.clip(2 - far, 0, None) ** 3 / 6
    cubic = np.where(far < 1, 2 / 3 - far**2 + far**3 / 2, tails).astype(np.float32)
    blocks = np.zeros(((factor + 1) ** 3, len(voxel_ijk) + 1), np.float32)
    for rows, ijk, values in _in_cubes(band, voxel_ijk, BEYOND):
        found = _evaluate(prefilter(values), ijk + 2, cubic)
        if grid.field.has_jumps:
            rough = roughness(values * np.float32(0.5))[tuple(ijk.T)]
            jumps = np.clip((rough - JUMPING) / (JUMPED - JUMPING), 0, 1)
            straight = np.pad(values, 2, mode="reflect", reflect_type="odd")
            found += jumps * (_evaluate(straight, ijk + 2, linear) - found)
        middle, nodes = factor // 2, found.reshape(factor + 1, factor + 1, factor + 1, -1)
        for axis in range(3):  # beyond the outermost samples the surface goes straight on
            lines, at = np.moveaxis(nodes, axis, 0), voxel_ijk[rows, axis]
            for outer, end in ((slice(0, middle), 0), (slice(middle, None), grid.shape[axis] - 1)):
                lines[outer][..., at == end] = lines[middle][..., at == end]
        blocks[:, rows] = found
    return blocks


def prefilter(values: FloatArray) -> FloatArray:
    """Return the coefficients of the cubic B-spline, with two more on every side."""
    weights = (3**0.5 * POLE ** np.arange(TAIL + 1)).astype(np.float32)
    coefficients = values
    for axis in range(3):
        lines = _continued(np.moveaxis(coefficients, axis, 0), TAIL + 2)
        count = len(lines) - 2 * TAIL
        total = lines[TAIL : TAIL + count] * weights[0]
        for step in range(1, TAIL + 1):
            pair = lines[TAIL - step : TAIL - step + count] + lines[TAIL + step :][:count]
            total += pair * weights[step]
        coefficients = np.moveaxis(total, 0, axis)
    return np.ascontiguousarray(coefficients)


def _continued(lines: FloatArray, beyond: int) -> FloatArray:
    """Return lines continued beyond both ends by point reflection, as straight ones would go on."""
    return np.pad(lines, [(beyond, beyond), (0, 0), (0, 0)], mode="reflect", reflect_type="odd")


def roughness(values: FloatArray) -> FloatArray:
    """Return the sum of the absolute fourth differences, the largest in each neighbourhood."""
    total = np.zeros_like(values)
    for axis in range(3):
        lines = _continued(np.moveaxis(values, axis, 0), 2)
        total += np.moveaxis(np.abs(np.diff(lines, 4, axis=0)), 0, axis)
    return over_three(total, np.maximum)


def _evaluate(coefficients: FloatArray, ijk: IntArray, weights: NDArray[np.float32]) -> FloatArray:
    """Return what weights make at the nodes of the blocks of voxels (n, 3), (Q, n)."""
    out = np.empty((len(weights) ** 3, len(ijk)), np.float32)
    step = np.array([coefficients[0].size, coefficients.shape[2], 1])
    around = (np.indices((SIDE,) * 3).reshape(3, -1).T - 2) @ step
    centre = ijk.astype(np.int64) @ step
    for rows in chunks_of(len(ijk), SIDE**3):
        values = coefficients.ravel().take(around[:, None] + centre[rows])
        block = values.reshape(SIDE, SIDE, SIDE, -1)
        for axis in range(3):
            lines = np.moveaxis(block, axis, 0)
            nodes = np.zeros((len(weights), *lines.shape[1:]), np.float32)
            for node, weight in zip(nodes, weights):
                for line, share in zip(lines, weight):
                    if share:
                        node += line * share
            block = np.moveaxis(nodes, 0, axis)
        out[:, rows] = block.reshape(len(out), -1)
    return out
