"""The fine fields of all labels of an image, and which label holds each node of the fine lattice.

Each label is refined as the mask of its samples, in a box round them, and so is what is beside all
labels, where that meets two of them or more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import NEIGHBOURHOOD, BoolArray, FloatArray, IntArray
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


@dataclass(eq=False)
class Contest:
    """Which label holds each node so far: the one with the lowest field, the lower one in a tie."""

    holder: Labels  # (Q, D)
    lowest: FloatArray  # (Q, D)
    able: NDArray[np.int8]  # (Q, D), how many labels could hold it; 2: or more
    times: Labels  # (D,), how many labels meet others in a voxel

    def enter(
        self, label: int, rows: NDArray[np.int64], blocks: FloatArray, can: BoolArray
    ) -> None:
        """Let a label with values at the nodes of some voxels, (Q, n), hold those that it can."""
        self.times[rows] += 1
        for value, can_here, lowest, holder, able in zip(
            blocks, can, self.lowest, self.holder, self.able
        ):  # node by node, to save memory
            before = able[rows]
            if label == 0:
                value[before < 2] = np.nan
                value = np.where(np.isnan(value), -lowest[rows], value)
            lower = np.flatnonzero(can_here & (value < lowest[rows]))
            lowest[rows[lower]], holder[rows[lower]] = value[lower], label
            able[rows] = np.minimum(before + can_here, 2)


def label_fields(
    numbers: Labels,
    count: int,
    grid: SdfGrid,
    network: Adapter,
    factor: int,
    bound: int | None = None,
    progress: Progress | None = None,
) -> Labelled:
    """Return the fields of the labels 1 to ``count``, one after the other, of what is beside last.

    OutOfMemoryError if more bytes than ``bound`` would be held.
    """
    nodes, shape = (factor + 1) ** 3, np.array(numbers.shape)
    padded = np.pad(numbers, 1)  # beyond the border there is no label
    edges = at_walls(padded)
    near = over_three(edges, np.logical_or)
    near[1:-1, 1:-1, 1:-1] = edges[1:-1, 1:-1, 1:-1]
    places = np.argwhere(near).astype(np.int32)
    need = SAMPLE_BYTES * numbers.size + len(places) * (VOXEL_BYTES + NODE_BYTES * nodes)
    what = f"meshing {count} labels in {numbers.size:,} samples, {len(places):,} of them at walls,"
    way_out = "choose fewer (--labels), a smaller factor, or allow more (--max-memory)"
    check_fits(need, what, way_out, memory_bound(bound))
    own, index, voxel_ijk = padded[tuple(places.T)], VoxelIndex(places, padded.shape), places - 1
    low, high = np.full((count + 1, 3), shape), np.zeros((count + 1, 3), np.intp)  # of the labels
    np.minimum.at(low, own, voxel_ijk)
    np.maximum.at(high, own, voxel_ijk)
    low[0], high[0] = low[1:].min(0), high[1:].max(0)
    holder, times = np.repeat(own[None], nodes, axis=0), np.zeros(len(own), np.int16)
    lowest, able = np.full(holder.shape, np.inf, np.float32), np.zeros(holder.shape, np.int8)
    contest, part = Contest(holder, lowest, able, times), part_of_node(factor)
    fields: dict[int, tuple[NDArray[np.int64], FloatArray]] = {}
    for turn, label in enumerate((*range(1, count + 1), 0)):
        start = np.maximum(low[label] - MARGIN, 0)
        mask = numbers[tuple(map(slice, start, high[label] + MARGIN + 1))] == label
        ijk = np.argwhere(at_walls(mask)).astype(np.int32)
        if not len(ijk):
            continue
        rows = index.find(ijk + start + 1)
        meets = slice(None) if label else times[rows] > 1
        begin, end = turn / (count + 1), (turn + 1) / (count + 1)
        steps = Steps(progress, ["network", "nodes"], begin, end)
        blocks = refined(mask, ijk, ijk[meets], grid, network, factor, steps)
        contest.enter(label, rows, blocks, could_hold(mask, ijk)[part])
        fields[label] = rows, blocks
    share_border(holder, voxel_ijk, shape, index, factor)
    return Labelled(grid.shape, factor, index, voxel_ijk, holder, fields)


def refined(
    mask: BoolArray,
    ijk: IntArray,
    wanted: IntArray,
    grid: SdfGrid,
    network: Adapter,
    factor: int,
    steps: Steps,
) -> FloatArray:
    """Return the blocks of voxels, (Q, n), of a mask; NaN for those that are not ``wanted``."""
    extremes = extremes_of_masks(1.0)
    lattice = SdfGrid.trusted(mask_distances(mask), 1.0, extremes=extremes, field=grid.field)
    threads = useful_threads(network.threads)
    band = survey(lattice, 0.0, threads=threads)
    decoded = band.decoded & (VoxelIndex(wanted, lattice.shape).find(band.voxel_ijk) >= 0)
    blocks = np.full(((factor + 1) ** 3, len(ijk)), np.nan, np.float32)
    if decoded.any():
        field = refine_band(replace(band, decoded=decoded), network, factor, threads, steps)
        blocks[:, VoxelIndex(ijk, lattice.shape).find(field.voxel_ijk)] = field.blocks
    return blocks


def could_hold(mask: BoolArray, ijk: IntArray) -> BoolArray:
    """Return whether a label could hold the nodes of each part of voxels' blocks, (27, n).

    It has a sample beside each of the voxels that share the part; beyond the grid it may have.
    """
    around = np.pad(over_three(mask, np.logical_or), 1, constant_values=True)
    there = np.stack([around[tuple((ijk + 1 + step).T)] for step in NEIGHBOURHOOD])
    return np.array([there[sharing].all(0) for sharing in SHARING])


def share_border(
    holder: Labels, voxel_ijk: IntArray, shape: NDArray[np.intp], index: VoxelIndex, factor: int
) -> None:
    """Give nodes of voxels beyond the border, on it, the holders that voxels inside gave them."""
    outer = np.flatnonzero(((voxel_ijk < 0) | (voxel_ijk >= shape)).any(1))
    beside = np.clip(voxel_ijk[outer], 0, shape - 1)
    row = index.find(beside + 1)
    for nth, step in enumerate(block_ijk(factor)):
        node = factor * (voxel_ijk[outer] - beside) + step
        some = np.flatnonzero(((node >= 0) & (node <= factor)).all(1) & (row >= 0))
        holder[nth, outer[some]] = holder[node[some] @ strides(factor), row[some]]


def at_walls(values: NDArray[Any]) -> BoolArray:
    """Return which samples do not have the same value as all that touch them."""
    differ: BoolArray = over_three(values, np.minimum) != over_three(values, np.maximum)
    return differ
