"""All labels of an image in one run: closed meshes whose shared walls coincide.

Each label is refined as the mask of its samples, in a box round them, and so is what is beside all
labels, where that meets two of them or more; ``walls`` makes the surfaces of these fields.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import options
from ..arrays import NEIGHBOURHOOD, BoolArray, FloatArray, IntArray
from ..errors import GridError, OptionError, seen
from ..files.grids import read_array
from ..grid.derived import REACH, extremes_of_masks, mask_distances
from ..grid.interpret import as_sample, labelled, mask_field
from ..grid.look import named
from ..grid.samples import as_samples, check_kind, check_spacing, placed
from ..grid.sdf_grid import SdfGrid, mean_spacing, with_fields
from ..network.contract import Adapter, Decoder, adapt
from ..network.network import load_network, network_for
from ..pipeline import refine_band
from ..refine.band import survey
from ..refine.field import FineField
from ..refine.nodes import SHARING, VoxelIndex, block_ijk, part_of_node
from ..surface.marching import strides
from ..surface.mesh import Mesh, vertex_type
from ..threads import Progress, StepCounter, check_bound, check_count, part_of, useful_threads
from .volumes import keep_volumes
from .walls import Labelled, extract_walls

MOST_LABELS = 1000  # more values than these are densities
MARGIN = REACH + 1  # samples beside a label on which its distances, and those beside them, depend
SAMPLE_BYTES = 16  # memory for each sample of the image ...
VOXEL_BYTES, NODE_BYTES = 1500, 22  # ... for each voxel at a wall, and for each node of its block


def reconstruct_labels(
    values: ArrayLike | str | PathLike[str],
    labels: str | Sequence[int] = options.ALL,
    network: Decoder | None = None,
    factor: int = 4,
    *,
    spacing: Any = None,
    origin: Any = None,
    direction: Any = None,
    axes: options.AxisOrder | None = None,
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
        Give each mesh the volume of its samples, see ``keep_volumes``.

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
        If the image does not fit in memory.
    """
    place = {"spacing": spacing, "origin": origin, "direction": direction}
    wanted = in_order(labels)
    image = find_image(values, wanted, place, axes, max_memory)
    for label in image.missing:
        labelled(image.grid.samples, label)  # raises
    chosen = load_network() if network is None else network
    meshes = label_meshes(image, chosen, factor, max_memory, progress)
    if options.OPTIONS["keep_volume"].check(keep_volume):
        meshes = keep_volumes(meshes, image.volumes, mean_spacing(image.grid))
    return dict(zip(image.labels, meshes))


@dataclass(frozen=True, eq=False)
class LabelImage:
    """Samples with labels, and those of the labels that are to be meshed."""

    grid: SdfGrid  # the labels as its samples, and where they lie
    labels: list[int]  # (L,), those to mesh, ascending
    numbers: NDArray[np.int16]  # of each sample: n for the label ``labels[n - 1]``, 0 for others
    missing: list[int]  # labels that were asked for, and that no sample has
    volumes: list[float]  # of the samples of each label, taken as boxes


def find_image(
    values: Any,
    wanted: list[int] | None,
    place: dict[str, Any],
    axes: options.AxisOrder | None,
    max_memory: int | None,
    space: options.Space | None = None,
) -> LabelImage:
    """Return the label image of an array or a file; ``place`` has spacing, origin and direction.

    Of labels ``in_order``, those that no sample has are left out; GridError if none is left.
    """
    notes: list[str] = []
    if isinstance(values, (str, PathLike)):
        place = read_array(values, place, axes, space, max_memory)
        values, notes = place["values"], list(place["notes"])
    elif axes is not None:
        raise OptionError(f"--axes is {seen(axes)}: that is for files; transpose the array")
    given = placed(values, place["spacing"], place["origin"])
    samples, origin = as_samples(given.values), given.origin
    check_kind(samples.dtype, samples.shape)
    labels, numbers, counts = find_labels(samples, wanted)
    if given.spacing is None:
        notes.append("spacing not given: taken as 1, since labels show none (give --spacing)")
    if origin is None:
        notes.append("origin not given: sample (0, 0, 0) is at 0, 0, 0")
    ends = [numbers.take(end, axis).ravel() for axis in range(3) for end in (0, -1)]
    if cut := [labels[n - 1] for n in np.unique(np.concatenate(ends)).tolist() if n]:
        said = "solids of labels run out of the grid: closed along the border"
        notes.append(f"{said} ({named(cut)})")
    steps = check_spacing(1.0 if given.spacing is None else given.spacing)
    where = (samples, steps, 0.0 if origin is None else origin, tuple(notes))
    more = {"direction": place["direction"], "extremes": extremes_of_masks(min(steps))}
    grid = with_fields(
        SdfGrid.trusted(*where, **more, field=mask_field(steps)), space=place.get("space")
    )
    missing = [label for label in wanted or () if label not in labels]
    volumes = [float(np.prod(steps)) * count for count in counts.tolist()]
    return LabelImage(grid, labels, numbers, missing, volumes)


def in_order(labels: Any) -> list[int] | None:
    """Return labels in ascending order, each once; None for all."""
    given = options.check_labels(labels)
    if isinstance(given, str):
        return None
    chosen = sorted({options.check_label(label, "--labels") for label in given})
    if not 0 < len(chosen) <= MOST_LABELS:
        raise OptionError(f"--labels are {len(chosen):,}: give 1 to {MOST_LABELS:,} at a time")
    return chosen


def find_labels(
    samples: Any, wanted: Sequence[int] | None
) -> tuple[list[int], NDArray[np.int16], NDArray[np.int64]]:
    """Return the labels and numbers of a ``LabelImage``, and how many samples each label has."""
    listed = {as_sample(label, samples.dtype) for label in wanted or ()}
    found, others = set[Any](), False
    for nth in range(len(samples)):  # plane by plane, to save memory
        plane = np.asarray(samples[nth]).ravel()
        values = np.unique(plane[np.append(True, plane[1:] != plane[:-1])])  # one of each run
        whole = np.isfinite(values) & (np.rint(values) == values)
        if values.dtype.kind == "f" and not whole.all():
            raise GridError(
                f"a value is {values[~whole][0]:g}: labels are whole numbers; choose what is above "
                "a value with --level if they are densities"
            )
        some = {value for value in values if (value != 0 if wanted is None else value in listed)}
        found, others = found | some, others or len(some) < len(values)
        if len(found) > MOST_LABELS:
            raise GridError(
                f"the values are more than {MOST_LABELS:,} different whole numbers: choose some of "
                "them (--labels 1,2,3) if they are labels, or a --level if they are densities"
            )
    if wanted and not found:
        labelled(samples, wanted[0])  # raises
    if not found or (len(found) == 1 and not others):
        only = int(next(iter(found), 0))
        raise GridError(f"every sample has the label {only}: there is no surface")
    kinds, numbers = np.array(sorted(found), samples.dtype), np.zeros(samples.shape, np.int16)
    counts = np.zeros(len(kinds) + 1, np.int64)
    for nth, out in enumerate(numbers):
        plane = np.asarray(samples[nth])
        at = np.searchsorted(kinds, plane).clip(max=len(kinds) - 1)
        out[...] = np.where(kinds[at] == plane, at + 1, 0)
        counts += np.bincount(out.ravel(), minlength=len(counts))
    return [int(label) for label in kinds], numbers, counts[1:]


def label_meshes(
    image: LabelImage, network: Decoder, factor: int, bound: int | None, progress: Progress | None
) -> list[Mesh]:
    """Return the meshes of an image's labels; OutOfMemoryError if they do not fit in memory."""
    options.check_called(network, progress)
    factor, grid = options.OPTIONS["factor"].check(factor), image.grid
    bound = options.OPTIONS["max_memory"].check(bound)
    kind = vertex_type(grid, factor)  # raises if not even float64 resolves the vertices
    chosen = adapt(network_for(network, options.MASK))
    places, faces, sides = extract_walls(label_fields(image, chosen, factor, bound, progress))
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


def _check_room(image: LabelImage, voxels: int, nodes: int, bound: int | None) -> None:
    """Raise OutOfMemoryError unless the fields in some voxels at walls fit in memory."""
    labels, samples = len(image.labels), image.numbers.size
    need = SAMPLE_BYTES * samples + voxels * (VOXEL_BYTES + NODE_BYTES * nodes)
    what = f"meshing {labels} labels in {samples:,} samples, {voxels:,} of them at walls,"
    check_bound(need, what, bound, "choose fewer (--labels), a smaller factor, cut the image, or ")


def label_fields(
    image: LabelImage, network: Adapter, factor: int, bound: int | None, progress: Progress | None
) -> Labelled:
    """Return the fields of all labels: label by label, what is beside all of them last.

    The lowest field holds a node, the lower label in a tie.
    """
    grid, numbers = image.grid, image.numbers
    count, nodes = len(image.labels) + 1, (factor + 1) ** 3
    _check_room(image, 0, nodes, bound)
    padded, shape = np.pad(numbers, 1), np.array(grid.shape)  # beyond the border there is no label
    edges = at_walls(padded)
    near = _over_three(edges, np.logical_or)
    near[1:-1, 1:-1, 1:-1] = edges[1:-1, 1:-1, 1:-1]
    places = np.argwhere(near).astype(np.int32)
    _check_room(image, len(places), nodes, bound)
    own, index, voxel_ijk = padded[tuple(places.T)], VoxelIndex(places, padded.shape), places - 1
    low, high = np.full((count, 3), shape), np.zeros((count, 3), np.intp)  # the boxes of labels
    np.minimum.at(low, own, voxel_ijk)
    np.maximum.at(high, own, voxel_ijk)
    low[0], high[0] = low[1:].min(0), high[1:].max(0)
    holder = np.repeat(own[None], nodes, axis=0)
    lowest, able = np.full(holder.shape, np.inf, np.float32), np.zeros(holder.shape, np.int8)
    times = np.zeros(len(own), np.int16)  # how many labels meet others in a voxel
    fields: dict[int, tuple[NDArray[np.int64], FloatArray]] = {}
    for turn, label in enumerate((*range(1, count), 0)):
        start = np.maximum(low[label] - MARGIN, 0)
        mask = numbers[tuple(map(slice, start, high[label] + MARGIN + 1))] == label
        own_ijk = np.argwhere(at_walls(mask)).astype(np.int32)
        if not len(own_ijk):
            continue
        rows, around = index.find(own_ijk + start + 1), _over_three(mask, np.logical_or)
        around = np.pad(around, 1, constant_values=True)  # beyond the grid it may be
        none = ~np.stack([around[tuple((own_ijk + 1 + step).T)] for step in NEIGHBOURHOOD])
        absent = np.array([none[sharing].any(0) for sharing in SHARING])  # (27, n), by part
        some_ijk = own_ijk if label else own_ijk[times[rows] > 1]
        shown = part_of(progress, turn / count, (turn + 1) / count)
        steps = StepCounter(shown, ["network", "nodes"])
        blocks = np.full((nodes, len(own_ijk)), np.nan, np.float32)
        distances, extremes = mask_distances(mask), extremes_of_masks(1.0)
        lattice = SdfGrid.trusted(distances, 1.0, extremes=extremes, field=grid.field)
        if field := _field_at(lattice, some_ijk, network, factor, steps):
            blocks[:, VoxelIndex(own_ijk, lattice.shape).find(field.voxel_ijk)] = field.blocks
        times[rows] += 1
        for node, part in enumerate(part_of_node(factor)[0]):  # one by one, to save memory
            value, able_here = blocks[node], able[node, rows]
            if label == 0:
                value[able_here < 2] = np.nan
                value = np.where(np.isnan(value), -lowest[node, rows], value)
            can = ~absent[part]
            lower = np.flatnonzero(can & (value < lowest[node, rows]))
            lowest[node, rows[lower]], holder[node, rows[lower]] = value[lower], label
            able[node, rows] = np.minimum(able_here + can, 2)  # labels that could hold it; 2: more
        fields[label] = rows, blocks
    return _hold_border(Labelled(grid.shape, factor, index, voxel_ijk, holder, fields))


def _field_at(
    lattice: SdfGrid, voxel_ijk: IntArray, network: Adapter, factor: int, steps: StepCounter
) -> FineField | None:
    """Return the fine field of a mask in some voxels only; None if none can hold the surface."""
    threads = useful_threads(network.threads)
    band = survey(lattice, 0.0, threads=threads)
    decoded = band.decoded & (VoxelIndex(voxel_ijk, lattice.shape).find(band.voxel_ijk) >= 0)
    if not decoded.any():
        return None
    return refine_band(replace(band, decoded=decoded), network, factor, threads, steps)


def _hold_border(found: Labelled) -> Labelled:
    """Give the nodes on the border, of voxels beyond it, the label of the same node inside."""
    factor, shape, holder = found.factor, np.array(found.shape), found.holder
    outer = np.flatnonzero(((found.voxel_ijk < 0) | (found.voxel_ijk >= shape)).any(1))
    beside = np.clip(found.voxel_ijk[outer], 0, shape - 1)
    row = found.index.find(beside + 1)
    for nth, step in enumerate(block_ijk(factor)):
        node = factor * (found.voxel_ijk[outer] - beside) + step
        some = np.flatnonzero(((node >= 0) & (node <= factor)).all(1) & (row >= 0))
        holder[nth, outer[some]] = holder[node[some] @ strides(factor), row[some]]
    return found


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
