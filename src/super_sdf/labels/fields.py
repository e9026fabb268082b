"""The fine fields of all labels of an image, and which label holds each node of the fine lattice.

Each label is refined as the mask of its samples, in a box round them, and so is what is beside all
labels, where that meets two of them or more.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..arrays import NEIGHBOURHOOD, BoolArray, IntArray
from ..grid.derived import REACH, extremes_of_masks, mask_distances
from ..grid.samples import over_three
from ..grid.sdf_grid import SdfGrid
from ..network.contract import Adapter
from ..pipeline import refine_band
from ..refine.band import survey
from ..refine.nodes import SHARING, VoxelIndex, block_ijk, part_of_node
from ..surface.marching import strides
from ..threads import Progress, Steps, check_fits, memory_bound, useful_threads
from .walls import Labelled, Labels

MARGIN = REACH + 1  # samples beside a label on which its distances, and those beside them, depend
SAMPLE_BYTES = 16  # memory for each sample of the image ...
VOXEL_BYTES, NODE_BYTES = 1500, 22  # ... for each voxel at a wall, and for each node of its block


def label_fields(
    numbers: Labels,
    count: int,
    grid: SdfGrid,
    network: Adapter,
    factor: int,
    bound: int | None = None,
    progress: Progress | None = None,
) -> Labelled:
    """Return the fields of labels 1 to ``count``; OutOfMemoryError if they pass the ``bound``."""
    padded, threads = np.pad(numbers, 1), useful_threads(network.threads)
    voxel_ijk = voxels_at_walls(padded)
    own, index = padded[tuple(voxel_ijk.T + 1)], VoxelIndex(voxel_ijk + 1, padded.shape)
    need = SAMPLE_BYTES * numbers.size + len(own) * (VOXEL_BYTES + NODE_BYTES * (factor + 1) ** 3)
    what = f"meshing {count} labels in {numbers.size:,} samples, {len(own):,} of them at walls,"
    way_out = "choose fewer (--labels), a smaller factor, or allow more (--max-memory)"
    check_fits(need, what, way_out, memory_bound(bound))
    holder, times = np.repeat(own[None], (factor + 1) ** 3, axis=0), np.zeros(len(own), np.int16)
    found = Labelled(grid.shape, factor, index, voxel_ijk, holder, {})
    steps = Steps(progress, ("network", "nodes") * (count + 1))
    for turn, label in enumerate((*range(1, count + 1), 0)):
        ijk = voxel_ijk[own == label] if label else voxel_ijk[own > 0]
        start = np.maximum(ijk.min(0) - MARGIN, 0)
        mask = numbers[tuple(map(slice, start, ijk.max(0) + MARGIN + 1))] == label
        has_beside = over_three(mask, np.logical_or)
        ijk = np.argwhere(has_beside != over_three(mask, np.logical_and)).astype(np.int32)
        if not len(ijk):
            continue
        rows = index.find(ijk + start + 1)
        steps.done = turn / (count + 1)  # some are left out
        more: dict[str, Any] = {"extremes": extremes_of_masks(1.0), "field": grid.field}
        band = survey(SdfGrid.trusted(mask_distances(mask), 1.0, **more), threads=threads)
        at = VoxelIndex(ijk, mask.shape).find(band.voxel_ijk)
        decoded = band.decoded & (at >= 0) & ((label > 0) | (times[rows] > 1))[at]
        blocks = np.full((len(holder), len(ijk)), np.nan, np.float32)
        if decoded.any():
            band = replace(band, decoded=decoded)
            blocks[:, at[decoded]] = refine_band(band, network, factor, threads, steps).blocks
        found.fields[label] = rows, blocks, could_hold(has_beside, ijk)
        times[rows] += 1
    find_holders(found)
    return found


def voxels_at_walls(padded: Labels) -> IntArray:
    """Return where walls can be, (D, 3), also beyond the border, where there is no label."""
    edges = over_three(padded, np.minimum) != over_three(padded, np.maximum)
    near = over_three(edges, np.logical_or)
    near[1:-1, 1:-1, 1:-1] = edges[1:-1, 1:-1, 1:-1]
    return np.argwhere(near).astype(np.int32) - 1


def could_hold(has_beside: BoolArray, ijk: IntArray) -> BoolArray:
    """Return which parts of blocks, (27, n), a label could hold: it is beside all that have it."""
    around = np.pad(has_beside, 1, constant_values=True)  # beyond the grid it may be
    there = np.stack([around[tuple((ijk + 1 + step).T)] for step in NEIGHBOURHOOD])
    return np.array([there[sharing].all(0) for sharing in SHARING])


def find_holders(of: Labelled) -> None:
    """Find which label holds each node, see ``walls``, and drop what label 0 has of others."""
    factor, holder, part = of.factor, of.holder, part_of_node(of.factor)
    for node, held in enumerate(holder):
        lowest = np.full(len(held), np.inf, np.float32)
        able = np.zeros(len(held), np.int16)  # how many labels could hold the node
        for label, (rows, blocks, could) in of.fields.items():
            value, can_here = blocks[node], could[part[node]]
            if label == 0:
                value[able[rows] < 2] = np.nan
                value = np.where(np.isnan(value), -lowest[rows], value)
            lower = np.flatnonzero(can_here & (value < lowest[rows]))
            lowest[rows[lower]], held[rows[lower]] = value[lower], label
            able[rows] += can_here
    # voxels beyond the border have the holders of nodes on it from voxels within
    beside = np.clip(of.voxel_ijk, 0, np.array(of.shape) - 1)
    outer = np.flatnonzero((beside != of.voxel_ijk).any(1))
    row, low = of.index.find(beside[outer] + 1), factor * (of.voxel_ijk - beside)[outer]
    for held, step in zip(holder, block_ijk(factor)):
        inner = low + step
        some = np.flatnonzero(((inner >= 0) & (inner <= factor)).all(1) & (row >= 0))
        held[outer[some]] = holder[inner[some] @ strides(factor), row[some]]
