"""All labels of an image in one run: closed meshes whose shared walls coincide.

``fields`` refines the labels, ``walls`` makes the surfaces of these fields, and ``volumes`` makes
up for what smooth surfaces lack. Then triangles are spared, see ``simplify.collapsing``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import options
from ..arrays import NEIGHBOURHOOD
from ..errors import GridError, OptionError, check_modules, seen
from ..files.grids import read_array
from ..grid.derived import extremes_of_masks
from ..grid.interpret import as_sample, labelled, mask_field
from ..grid.look import named
from ..grid.samples import as_samples, check_kind, check_spacing, placed
from ..grid.sdf_grid import SdfGrid, mean_spacing, with_fields
from ..network.contract import Decoder, adapt
from ..network.network import load_network, network_for
from ..simplify.collapsing import Unsimplified, collapse_edges, within
from ..simplify.walls import Walls, faults, labels_apart
from ..surface.mesh import Mesh, vertex_type
from ..threads import Progress
from .fields import label_fields
from .volumes import keep_volumes
from .walls import extract_walls

MOST_LABELS = 1000  # more values than these are densities
SLIGHT, MOST_REPEATS = 0.01, 8  # voxels from planes within which triangles are spared by default


def reconstruct_labels(
    values: ArrayLike | str | PathLike[str],
    labels: str | Sequence[int] = "all",
    network: Decoder | None = None,
    factor: int | None = None,
    *,
    spacing: Any = None,
    origin: Any = None,
    direction: Any = None,
    axes: options.AxisOrder | None = None,
    keep_volume: bool = False,
    tolerance: float | None = None,
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
        As in ``reconstruct``; of shipped networks that for masks is used. The factor is 2 by
        default.
    spacing, origin, direction, axes
        Where the samples lie in the world, as in ``read_grid``; by default as the file says.
    keep_volume : bool
        Give each mesh the volume of its samples, see ``keep_volumes``.
    tolerance : float, optional
        Simplify the walls within this distance, in world units, both ways (extra ``simplify``). By
        default triangles are spared within about a hundredth of a voxel.

    Returns
    -------
    dict of int to Mesh
        The meshes by label, in ascending order, in world units.

    SuperSdfError if a value is no whole number, a label is missing, there is no surface, an
    argument is invalid, or the image does not fit in memory.
    """
    place = {"spacing": spacing, "origin": origin, "direction": direction}
    wanted = in_order(labels)
    image = find_image(values, wanted, place, axes, max_memory)
    for label in image.missing:
        labelled(image.grid.samples, label)  # raises
    chosen = load_network() if network is None else network
    more: dict[str, Any] = {"keep_volume": keep_volume, "tolerance": tolerance}
    asked = options.Options(factor, max_memory=max_memory, **more)
    return dict(zip(image.labels, label_meshes(image, chosen, asked, progress)[0]))


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
    values, spacing, origin = placed(values, place["spacing"], place["origin"])
    samples = as_samples(values)
    check_kind(samples.dtype, samples.shape)
    labels, numbers, counts = find_labels(samples, wanted)
    if spacing is None:
        notes.append("spacing not given: taken as 1, since labels show none (give --spacing)")
    if origin is None:
        notes.append("origin not given: sample (0, 0, 0) is at 0, 0, 0")
    ends = [numbers.take(end, axis).ravel() for axis in range(3) for end in (0, -1)]
    if cut := [labels[n - 1] for n in np.unique(np.concatenate(ends)).tolist() if n]:
        said = "solids of labels run out of the grid: closed along the border"
        notes.append(f"{said} ({named(cut)})")
    steps = check_spacing(1.0 if spacing is None else spacing)
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
    given = options.OPTIONS["labels"].check(labels)
    if isinstance(given, str):
        return None
    chosen = sorted({options.LABEL.check(label, "--labels") for label in given})
    if not 0 < len(chosen) <= MOST_LABELS:
        raise OptionError(f"--labels are {len(chosen):,}: give 1 to {MOST_LABELS:,} at a time")
    return chosen


def find_labels(
    samples: Any, wanted: Sequence[int] | None
) -> tuple[list[int], NDArray[np.int16], NDArray[np.int64]]:
    """Return the labels and numbers of a ``LabelImage``, and how many samples each label has."""
    kinds = np.zeros(0, samples.dtype)
    for plane in samples:  # to save memory
        flat = np.asarray(plane).ravel()
        each = flat[np.append(True, flat[1:] != flat[:-1])]  # one of each run
        kinds = np.unique(np.concatenate([kinds, each]))
        whole = np.isfinite(kinds) & (np.rint(kinds) == kinds)
        if kinds.dtype.kind == "f" and not whole.all():
            raise GridError(
                f"a value is {kinds[~whole][0]:g}: labels are whole numbers; choose what is above "
                "a value with --level if they are densities"
            )
        if wanted is None and len(kinds) > MOST_LABELS + 1:
            raise GridError(
                f"the values are more than {MOST_LABELS:,} different whole numbers: choose some of "
                "them (--labels 1,2,3) if they are labels, or a --level if they are densities"
            )
    listed = {as_sample(label, samples.dtype) for label in wanted or ()}
    chosen = [kind for kind in kinds if (kind != 0 if wanted is None else kind in listed)]
    if wanted and not chosen:
        labelled(samples, wanted[0])  # raises
    if not chosen or len(kinds) == 1:
        raise GridError(f"every sample has the label {int(kinds[0])}: there is no surface")
    kinds, numbers = np.array(chosen, samples.dtype), np.zeros(samples.shape, np.int16)
    counts = np.zeros(len(kinds) + 1, np.int64)
    for plane, out in zip(samples, numbers):
        at = np.searchsorted(kinds, plane).clip(max=len(kinds) - 1)
        out[...] = np.where(kinds[at] == plane, at + 1, 0)
        counts += np.bincount(out.ravel(), minlength=len(counts))
    return [int(label) for label in kinds], numbers, counts[1:]


def label_meshes(
    image: LabelImage, network: Decoder, chosen: options.Options, progress: Progress | None
) -> tuple[list[Mesh], list[str], list[str]]:
    """Return the meshes of an image's labels, notes and warnings.

    OutOfMemoryError if the fields do not fit in memory.
    """
    options.NETWORK.check(network, "network")
    grid, factor, count = image.grid, chosen.factor_for(mask=True), len(image.labels)
    if chosen.goals():
        check_modules("simplifying", "simplify")
    kind = vertex_type(grid, factor)  # raises if not even float64 resolves the vertices
    adapter = adapt(network_for(network, "mask"))
    fields = label_fields(image.numbers, count, grid, adapter, factor, chosen.max_memory, progress)
    walls = extract_walls(fields)
    del fields
    faces = walls.faces[:, ::-1] if grid.is_mirrored else walls.faces
    vertices = grid.to_world(walls.vertices / factor - 0.5).astype(kind)
    walls = Walls(vertices, faces, walls.sides)
    if chosen.keep_volume:
        walls = keep_volumes(walls, image.volumes, mean_spacing(grid))
    notes, warnings, voxel = [], [], grid.voxel_size
    if find_spec("pyfqmr") is None:
        notes.append("pyfqmr is not installed: no triangles are spared")
    else:
        walls = spared(walls, SLIGHT * voxel, voxel / factor)
    if error := chosen.error(voxel):
        found = within(Unsimplified(walls), error)
        if not found:
            warnings.append("the meshes were not simplified: no way was found within the error")
        walls = found or walls
    return [mesh for mesh, _ in labels_apart(walls)], notes, warnings


def spared(walls: Walls, distance: float, spacing: float) -> Walls:
    """Return walls after collapses within a distance of planes, without ``faults``.

    Round a fault, the vertices up to about a ``spacing`` of the lattice away are held, and farther
    ones each time that all is done anew. If that does not help, the walls stay as they were.
    """
    held, vertices = np.zeros(len(walls.vertices), bool), walls.vertices
    for turn in range(MOST_REPEATS):
        made = collapse_edges(walls, held, distance=distance)[0]
        places = made.vertices[faults(made, spacing)]
        if not len(places):
            return made
        reach = spacing * 1.5**turn
        low = vertices.min(0) - 8 * reach
        cells, near = (np.floor((some - low) / reach) for some in (vertices, places))
        _, ny, nz = cells.max(0) + 8
        near = np.unique(near, axis=0)[:, None] + NEIGHBOURHOOD
        along = np.array([ny * nz, nz, 1])
        held |= np.isin(cells @ along, near @ along)
    return walls
