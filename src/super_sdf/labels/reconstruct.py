"""All labels of an image in one run: closed meshes whose shared walls coincide.

Each label is refined as the mask of its samples, in a box round them, and so is what is beside all
labels, where that meets two of them or more; ``walls`` makes the surfaces of these fields. An image
whose fields do not fit in memory is worked on in ranges of planes, with as many planes to either
side as the fields depend on; the walls of all ranges are joined by the names of their vertices.

>>> from super_sdf import reconstruct_labels
>>> meshes = reconstruct_labels(image, spacing=(1, 1, 3))         # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import NEIGHBOURHOOD, BoolArray, FloatArray, IntArray
from ..errors import OutOfMemoryError
from ..grid.derived import REACH, extremes_of_masks, mask_distances
from ..grid.interpret import labelled
from ..grid.sdf_grid import SdfGrid
from ..network.decoder import Adapter, Decoder, adapt
from ..network.network import network_for
from ..options import (
    ALL,
    MASK,
    OPTIONS,
    AxisOrder,
    check_factor,
    check_max_memory,
    check_network,
    check_progress,
)
from ..pipeline import refine_band
from ..progress import Progress, StepCounter, part_of
from ..refine import bounds, spheres
from ..refine.field import FineField
from ..refine.nodes import SHARING, VoxelIndex, part_of_node
from ..refine.survey import survey
from ..surface.mesh import Mesh, vertex_type
from ..threads import check_count, held_memory, in_words, memory_bound, useful_threads
from .image import LabelImage, find_image, in_order
from .volumes import keep_volumes, mean_spacing
from .walls import Labelled, Walls, extract_walls, join_walls

MARGIN = REACH + 1  # samples beside a label on which its distances, and those beside them, depend
BLOCK_PLANES = 32  # read at a time, to count voxels
# Memory in bytes for each voxel at a wall: once, and for each node of its block.
VOXEL_BYTES, NODE_BYTES = 1500, 22


def reconstruct_labels(
    values: ArrayLike | str | PathLike[str],
    labels: str | Sequence[int] = ALL,
    network: Decoder | None = None,
    factor: int = 4,
    *,
    spacing: Any = None,
    origin: Any = None,
    direction: Any = None,
    axes: AxisOrder | None = None,
    keep_volume: bool = False,
    max_memory: int | None = None,
    progress: Progress | None = None,
) -> dict[int, Mesh]:
    """Turn a label image into a closed mesh of each label, which share the walls between them.

    Where two labels touch, both have the same vertices and triangles, in opposite directions: there
    is neither gap nor overlap. Labels that run out of the grid are closed along its border.

    Parameters
    ----------
    values : (nx, ny, nz) array_like or path
        Whole numbers, of any integer or floating-point type; or a file, see ``read_grid``.
    labels : "all" or sequence of ints
        The labels to mesh; all are those of the image but 0. Others count as 0.
    network : Network, optional
        By default a shipped one. In place of any shipped network, that for masks is used.
    factor : int
        How many times finer per axis the meshes are than the samples: 2, 4, 8 or 16.
    spacing, origin, direction
        Where the samples lie in the world, as in ``make_grid``; by default as the file says.
    axes : {"xyz", "zyx"}, optional
        The axis order of a file that does not state it.
    keep_volume : bool
        Move each surface along its normals until the volume is that of the samples, see
        ``keep_volumes``.
    max_memory : int, optional
        Bytes that the process may hold in all, besides the meshes; by default a share of the free
        memory.
    progress : callable, optional
        Called with (done, total), see ``progress.Progress``; an exception in it ends the work.

    Returns
    -------
    dict of int to Mesh
        The meshes by label, in ascending order, in world units.

    Raises
    ------
    GridError
        If a value is no whole number, a label is missing, or there is no surface.
    OptionError
        If an argument is invalid, or there are too many labels.
    OutOfMemoryError
        If not even a plane of the image can be worked on in memory.
    """
    place = {"spacing": spacing, "origin": origin, "direction": direction}
    wanted = in_order(labels)
    image = find_image(values, wanted, place, axes, max_memory)
    for label in image.missing(wanted):
        labelled(image.grid.samples, label)  # raises
    if network is None:
        from ..network.network import load_network

        network = load_network()
    meshes = label_meshes(image, network, factor, max_memory=max_memory, progress=progress)
    if OPTIONS["keep_volume"].check(keep_volume):
        meshes = keep_volumes(meshes, image.volumes(), mean_spacing(image.grid))
    return dict(zip(image.names(), meshes))


def label_meshes(
    image: LabelImage,
    network: Decoder,
    factor: int = 4,
    *,
    max_memory: int | None = None,
    progress: Progress | None = None,
) -> list[Mesh]:
    """Return the meshes of an image's labels, the same for any memory bound."""
    check_network(network)
    check_progress(progress)
    factor, grid = check_factor(factor), image.grid
    chosen = adapt(network_for(network, MASK))
    kind = vertex_type(grid, factor)  # raises if not even float64 resolves the vertices
    bound = memory_bound(check_max_memory(max_memory))
    ranges = plan_ranges(image, factor, chosen.receptive_field, bound)
    walls: list[Walls] = []
    for nth, planes in enumerate(ranges):
        share = part_of(progress, nth / len(ranges), (nth + 1) / len(ranges))
        walls.append(extract_walls(label_fields(image, planes, chosen, factor, share)))
    places, faces, sides = join_walls(walls)
    del walls
    world: NDArray[Any] = grid.to_world(places / factor - 0.5).astype(kind)
    if grid.is_mirrored:
        faces = faces[:, ::-1]
    both, label = np.concatenate([faces, faces[:, ::-1]]), sides.T.ravel()
    order = np.argsort(label, kind="stable")
    ends = np.searchsorted(label[order], np.arange(1, len(image.labels) + 2))
    meshes = []
    for first, last in pairwise(ends.tolist()):
        used, own = np.unique(both[order[first:last]], return_inverse=True)
        check_count(len(used), "vertices")
        meshes.append(Mesh(world[used], own.reshape(-1, 3).astype(np.int32)))
    return meshes


def plan_ranges(
    image: LabelImage, factor: int, receptive_field: int | None, bound: int | None
) -> list[tuple[int, int]]:
    """Return the ranges of planes to work on at a time, as few as fit in memory."""
    count = image.grid.shape[0]
    if bound is None:
        return [(0, count)]
    voxels: list[NDArray[np.int64]] = []
    for first in range(0, count, BLOCK_PLANES):
        low, last = max(first - 1, 0), min(first + BLOCK_PLANES, count)
        numbers = image.numbers(low, min(last + 1, count))
        voxels.append(at_walls(numbers)[first - low : last - low].sum((1, 2)))
    before = np.concatenate([[0], np.cumsum(np.concatenate(voxels))])
    beside, need = reach_of(receptive_field or 0), 0
    most = (count - 1).bit_length() if receptive_field is not None else 0
    for pieces in (2**n for n in range(most + 1)):
        inner = np.searchsorted(before, np.arange(1, pieces) / pieces * before[-1])
        ranges = list(pairwise(sorted({0, *inner.tolist(), count})))
        seen = [before[min(b + beside, count)] - before[max(a - beside, 0)] for a, b in ranges]
        need = int(max(seen)) * (VOXEL_BYTES + NODE_BYTES * (factor + 1) ** 3)
        need += held_memory() or 0
        if need <= bound:
            return ranges
    raise OutOfMemoryError(
        f"factor {factor} on {int(before[-1]):,} voxels at the walls of {len(image.labels)} labels "
        f"needs {in_words(need)} of memory, {in_words(bound)} may be used; use a smaller factor, or "
        "allow more (--max-memory)"
    )


def reach_of(receptive_field: int) -> int:
    """Return how many planes to either side of a range its walls depend on."""
    return receptive_field + spheres.REACH_IN_VOXELS + bounds.REACH_IN_VOXELS + MARGIN + 1


def label_fields(
    image: LabelImage,
    planes: tuple[int, int],
    network: Adapter,
    factor: int,
    progress: Progress | None = None,
) -> Labelled:
    """Return the fields of labels in some planes: label by label, the one beside all others last.

    The lowest field holds a node, the lower label in a tie.
    """
    grid, beside = image.grid, reach_of(network.receptive_field or 0)
    low, high = max(planes[0] - beside, 0), min(planes[1] + beside, grid.shape[0])
    numbers = image.numbers(low, high)
    voxel_ijk = np.argwhere(at_walls(numbers)).astype(np.int32) + np.array([low, 0, 0], np.int32)
    index = VoxelIndex(voxel_ijk, grid.shape)
    size = (factor + 1) ** 3, len(voxel_ijk)
    lowest, holder = np.full(size, np.inf, np.float32), np.zeros(size, np.int16)
    able = np.zeros(size, np.int8)  # how many labels could hold a node, 2 for more
    times = np.zeros(len(voxel_ijk), np.int16)  # how many labels have a voxel in their band
    fields: dict[int, tuple[NDArray[np.int64], FloatArray]] = {}
    of_block = part_of_node(factor)[0]
    for turn, label in enumerate((*range(1, len(image.labels) + 1), 0)):
        box = _box_of(image, label, low, high)
        mask = numbers[box] == label
        corner = np.array([low + box[0].start, box[1].start, box[2].start], np.int32)
        own_ijk = np.argwhere(at_walls(mask)).astype(np.int32)
        rows = index.find(own_ijk + corner)
        if not len(rows):
            continue
        absent = _absent_parts(mask, own_ijk)
        blocks = np.full((size[0], len(rows)), np.nan, np.float32)
        several = None if label else own_ijk[times[rows] > 1]
        steps = StepCounter(
            part_of(progress, turn / (len(image.labels) + 1), (turn + 1) / (len(image.labels) + 1)),
            ["network", "nodes"],
        )
        field = _refined(mask, grid, several, network, factor, steps)
        if field is not None:
            at = VoxelIndex(own_ijk, field.shape).find(field.voxel_ijk)
            blocks[:, at[at >= 0]] = field.blocks[:, at >= 0]
        times[rows] += 1
        for node, part in enumerate(of_block):  # one by one, to save memory
            value, able_here = blocks[node], able[node, rows]
            if label == 0:
                value[able_here < 2] = np.nan
                value = np.where(np.isnan(value), -lowest[node, rows], value)
            can = ~absent[part]
            lower = np.flatnonzero(can & (value < lowest[node, rows]))
            lowest[node, rows[lower]], holder[node, rows[lower]] = value[lower], label
            able[node, rows] = np.minimum(able_here + can, 2)
        fields[label] = rows, blocks
    if progress:
        progress(1000, 1000)
    at_border = numbers > 0
    at_border[1 - min(low, 1) : grid.shape[0] - 1 - low, 1:-1, 1:-1] = False
    border = np.argwhere(at_border).astype(np.int32) + np.array([low, 0, 0], np.int32)
    border = np.column_stack([border, numbers[at_border]])
    return Labelled(grid.shape, factor, planes, index, voxel_ijk, holder, border, fields)


def _box_of(image: LabelImage, label: int, low: int, high: int) -> tuple[slice, slice, slice]:
    """Return the box of a label's samples with a margin, in planes ``low`` to before ``high``.

    That of 0 is round all labels.
    """
    boxes = image.boxes[label - 1 : label] if label else image.boxes
    first = np.maximum(boxes[:, 0].min(0) - MARGIN, [low, 0, 0])
    last = np.minimum(boxes[:, 1].max(0) + MARGIN + 1, [high, *image.grid.shape[1:]])
    (a, b, c), (d, e, f) = first.tolist(), np.maximum(first, last).tolist()
    return slice(a - low, d - low), slice(b, e), slice(c, f)


def _refined(
    mask: BoolArray,
    grid: SdfGrid,
    only: IntArray | None,
    network: Adapter,
    factor: int,
    steps: StepCounter,
) -> FineField | None:
    """Return the field of a mask, with blocks of voxels ``only`` if some are given."""
    distances = SdfGrid.trusted(
        mask_distances(mask), 1.0, extremes=extremes_of_masks(1.0), field=grid.field
    )
    threads = useful_threads(network.threads)
    band = survey(distances, 0.0, threads=threads)
    if only is not None:
        chosen = VoxelIndex(only, distances.shape).find(band.voxel_ijk) >= 0
        band = replace(band, decoded=band.decoded & chosen)
    if not band.decoded.any():
        return None
    return refine_band(band, network, factor, threads, steps)


def at_walls(values: NDArray[Any]) -> BoolArray:
    """Return which samples do not have the same value as all that touch them."""
    least = most = values
    for axis in range(3):
        least, most = _over_three(least, np.minimum, axis), _over_three(most, np.maximum, axis)
    differ: BoolArray = least != most
    return differ


def _over_three(values: NDArray[Any], choose: np.ufunc, axis: int) -> NDArray[Any]:
    """Return the least or the largest of each sample and its two neighbours along an axis."""
    source, chosen = np.moveaxis(values, axis, 0), np.moveaxis(values.copy(), axis, 0)
    choose(chosen[1:], source[:-1], out=chosen[1:])
    choose(chosen[:-1], source[1:], out=chosen[:-1])
    return np.moveaxis(chosen, 0, axis)


def _absent_parts(mask: BoolArray, voxel_ijk: IntArray) -> BoolArray:
    """Return which parts of voxels' blocks touch a voxel round which no sample has the label.

    The result is (27, n); beyond the grid no sample is known to be without it.
    """
    near = mask
    for axis in range(3):
        near = _over_three(near, np.logical_or, axis)
    near = np.pad(near, 1, constant_values=True)
    none = ~np.stack([near[tuple((voxel_ijk + 1 + step).T)] for step in NEIGHBOURHOOD])
    return np.array([none[sharing].any(0) for sharing in SHARING])
