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
from ..grid.sdf_grid import SdfGrid, mean_spacing
from ..network.decoder import Adapter, Decoder, adapt
from ..network.network import network_for
from ..options import ALL, MASK, OPTIONS, AxisOrder, check_network, check_progress
from ..pipeline import refine_band
from ..progress import Progress, StepCounter, part_of
from ..refine import bounds, spheres
from ..refine.nodes import SHARING, VoxelIndex, part_of_node
from ..refine.survey import survey
from ..surface.mesh import Mesh, vertex_type
from ..threads import check_count, held_memory, in_words, memory_bound, useful_threads
from .image import LabelImage, find_image, in_order
from .volumes import keep_volumes
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
    network, factor, max_memory, progress
        As in ``reconstruct``; in place of a shipped network, that for masks is used.
    spacing, origin, direction, axes
        Where the samples lie in the world, as in ``read_grid``; by default as the file says.
    keep_volume : bool
        Move each surface along its normals until the volume is that of the samples, see
        ``keep_volumes``.

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
    meshes = label_meshes(image, network, factor, max_memory, progress)
    if OPTIONS["keep_volume"].check(keep_volume):
        meshes = keep_volumes(meshes, image.volumes(), mean_spacing(image.grid))
    return dict(zip(image.names(), meshes))


def label_meshes(
    image: LabelImage,
    network: Decoder,
    factor: int = 4,
    max_memory: int | None = None,
    progress: Progress | None = None,
) -> list[Mesh]:
    """Return the meshes of an image's labels, the same for any memory bound."""
    check_network(network)
    check_progress(progress)
    factor, grid = OPTIONS["factor"].check(factor), image.grid
    bound = OPTIONS["max_memory"].check(max_memory)
    chosen = adapt(network_for(network, MASK))
    kind = vertex_type(grid, factor)  # raises if not even float64 resolves the vertices
    ranges = plan_ranges(image, factor, chosen.receptive_field, memory_bound(bound))
    walls: list[Walls] = []
    for nth, planes in enumerate(ranges):
        share = part_of(progress, nth / len(ranges), (nth + 1) / len(ranges))
        walls.append(extract_walls(label_fields(image, planes, chosen, factor, share)))
    places, faces, sides = join_walls(walls)
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
    count, voxels = image.grid.shape[0], [0]
    if bound is None:
        return [(0, count)]
    for first in range(0, count, BLOCK_PLANES):
        low, last = max(first - 1, 0), min(first + BLOCK_PLANES, count)
        marks = at_walls(image.numbers(low, min(last + 1, count)))
        voxels += marks[first - low : last - low].sum((1, 2)).tolist()
    before, beside, need = np.cumsum(voxels), reach_of(receptive_field), 0
    for pieces in (1,) if receptive_field is None else (2**n for n in range(count.bit_length())):
        inner = np.searchsorted(before, np.arange(1, pieces) / pieces * before[-1])
        ranges = list(pairwise(sorted({0, *inner.tolist(), count})))
        seen = [before[min(b + beside, count)] - before[max(a - beside, 0)] for a, b in ranges]
        need = int(max(seen)) * (VOXEL_BYTES + NODE_BYTES * (factor + 1) ** 3)
        need += held_memory() or 0
        if need <= bound:
            return ranges
    raise OutOfMemoryError(
        f"factor {factor} on {before[-1]:,} voxels at the walls of {len(image.labels)} labels "
        f"needs {in_words(need)} of memory, {in_words(bound)} may be used; use a smaller factor, "
        "or allow more (--max-memory)"
    )


def reach_of(receptive_field: int | None) -> int:
    """Return how many planes to either side of a range its walls depend on."""
    reach = spheres.REACH_IN_VOXELS + bounds.REACH_IN_VOXELS + MARGIN + 1
    return reach + (receptive_field or 0)


def label_fields(
    image: LabelImage,
    planes: tuple[int, int],
    network: Adapter,
    factor: int,
    progress: Progress | None = None,
) -> Labelled:
    """Return the fields of labels in some planes: label by label, what is beside all of them last.

    The lowest field holds a node, the lower label in a tie.
    """
    grid, beside = image.grid, reach_of(network.receptive_field)
    low, high = max(planes[0] - beside, 0), min(planes[1] + beside, grid.shape[0])
    numbers, first = image.numbers(low, high), np.array([low, 0, 0], np.int32)
    voxel_ijk = np.argwhere(at_walls(numbers)).astype(np.int32) + first
    index = VoxelIndex(voxel_ijk, grid.shape)
    size = (factor + 1) ** 3, len(voxel_ijk)
    lowest, holder = np.full(size, np.inf, np.float32), np.zeros(size, np.int16)
    able = np.zeros(size, np.int8)  # how many labels could hold a node, 2 for more
    times = np.zeros(len(voxel_ijk), np.int16)  # how many labels meet others in a voxel
    fields: dict[int, tuple[NDArray[np.int64], FloatArray]] = {}
    for turn, label in enumerate((*range(1, len(image.labels) + 1), 0)):
        boxes = image.boxes[label - 1 : label] if label else image.boxes
        start = np.maximum(boxes[:, 0].min(0) - MARGIN, first)
        stop = np.minimum(boxes[:, 1].max(0) + MARGIN + 1, [high, *grid.shape[1:]])
        inner = tuple(slice(a, max(a, b)) for a, b in zip(start - first, stop - first))
        mask = numbers[inner] == label
        own_ijk = np.argwhere(at_walls(mask)).astype(np.int32)
        if not len(own_ijk):
            continue
        rows, absent = index.find(own_ijk + start), _absent_parts(mask, own_ijk)
        count = len(image.labels) + 1
        share = part_of(progress, turn / count, (turn + 1) / count)
        only = None if label else times[rows] > 1
        blocks = _refined(mask, grid, own_ijk, only, network, factor, share)
        times[rows] += 1
        for node, part in enumerate(part_of_node(factor)[0]):  # one by one, to save memory
            value, able_here = blocks[node], able[node, rows]
            if label == 0:
                value[able_here < 2] = np.nan
                value = np.where(np.isnan(value), -lowest[node, rows], value)
            can = ~absent[part]
            lower = np.flatnonzero(can & (value < lowest[node, rows]))
            lowest[node, rows[lower]], holder[node, rows[lower]] = value[lower], label
            able[node, rows] = np.minimum(able_here + can, 2)
        fields[label] = rows, blocks
    at_border = numbers > 0
    at_border[1 - min(low, 1) : grid.shape[0] - 1 - low, 1:-1, 1:-1] = False
    border = np.argwhere(at_border).astype(np.int32) + first
    border = np.column_stack([border, numbers[at_border]])
    return Labelled(grid.shape, factor, planes, index, voxel_ijk, holder, border, fields)


def _refined(
    mask: BoolArray,
    grid: SdfGrid,
    own_ijk: IntArray,
    only: BoolArray | None,
    network: Adapter,
    factor: int,
    progress: Progress | None,
) -> FloatArray:
    """Return the blocks of voxels of a mask, (Q, n); NaN but for ``only`` some, if given."""
    extremes, threads = extremes_of_masks(1.0), useful_threads(network.threads)
    lattice = SdfGrid.trusted(mask_distances(mask), 1.0, extremes=extremes, field=grid.field)
    band = survey(lattice, 0.0, threads=threads)
    if only is not None:
        chosen = VoxelIndex(own_ijk[only], lattice.shape).find(band.voxel_ijk) >= 0
        band = replace(band, decoded=band.decoded & chosen)
    blocks = np.full(((factor + 1) ** 3, len(own_ijk)), np.nan, np.float32)
    if band.decoded.any():
        steps = StepCounter(progress, ["network", "nodes"])
        field = refine_band(band, network, factor, threads, steps)
        at = VoxelIndex(own_ijk, lattice.shape).find(field.voxel_ijk)
        blocks[:, at[at >= 0]] = field.blocks[:, at >= 0]
    return blocks


def at_walls(values: NDArray[Any]) -> BoolArray:
    """Return which samples do not have the same value as all that touch them."""
    differ: BoolArray = _over_three(values, np.minimum) != _over_three(values, np.maximum)
    return differ


def _over_three(values: NDArray[Any], choose: np.ufunc) -> NDArray[Any]:
    """Return the least, or the largest, of each sample and the 26 round it."""
    for axis in range(3):
        source, chosen = np.moveaxis(values, axis, 0), np.moveaxis(values.copy(), axis, 0)
        choose(chosen[1:], source[:-1], out=chosen[1:])
        choose(chosen[:-1], source[1:], out=chosen[:-1])
        values = np.moveaxis(chosen, 0, axis)
    return values


def _absent_parts(mask: BoolArray, voxel_ijk: IntArray) -> BoolArray:
    """Return which parts of voxels' blocks touch a voxel round which no sample has the label.

    The result is (27, n); beyond the grid no sample is known to be without it.
    """
    near = np.pad(_over_three(mask, np.logical_or), 1, constant_values=True)
    none = ~np.stack([near[tuple((voxel_ijk + 1 + step).T)] for step in NEIGHBOURHOOD])
    return np.array([none[sharing].any(0) for sharing in SHARING])
