"""All labels of an image in one run: closed meshes whose shared walls coincide.

``fields`` refines the labels, ``walls`` makes the surfaces of these fields, and ``volumes`` makes
up for what smooth surfaces lack. Then triangles are spared, see ``simplify.collapsing``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import options
from ..errors import GridError, OptionError, check_modules, seen, tell
from ..files.grids import read_array
from ..files.readers import PLACE
from ..grid.derived import extremes_of_masks
from ..grid.interpret import MASK
from ..grid.look import MOST_LABELS, as_labels, named
from ..grid.samples import check_spacing, placed
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
    """Turn a label image into a closed mesh of each label, with shared walls.

    Where two labels touch, both meshes have the same vertices and triangles, in opposite
    directions, without gaps or overlaps. Meshes are closed along the border of the grid, too.

    Parameters
    ----------
    values : (nx, ny, nz) array_like or path
        Whole numbers, of any integer or floating-point type; or a file, see ``read_grid``.
    labels : "all" or sequence of ints
        The labels to mesh; "all" means all but 0. Other labels count as 0.
    network, factor, max_memory, progress
        As in ``reconstruct``; by default the factor is 2, and the network the shipped one for
        masks.
    spacing, origin, direction, axes
        Position of the samples, as in ``read_grid``; by default from the file.
    keep_volume : bool
        Give each mesh the volume of its samples, see ``keep_volumes``.
    tolerance : float, optional
        Simplify the walls within this distance, in world units, both ways (extra ``simplify``). By
        default triangles coplanar within about a hundredth of a voxel are merged.

    Returns
    -------
    dict of int to Mesh
        The meshes by label, in ascending order, in world units, each with all notes and warnings.

    SuperSdfError if a value is no whole number, a label is missing, there is no surface, an
    argument is invalid, or the image does not fit in memory.
    """
    told: dict[str, Any] = {"labels": labels, "axes": axes, "max_memory": max_memory}
    asked = options.Options(factor, keep_volume=keep_volume, tolerance=tolerance, **told)
    image = find_image(values, asked, (spacing, origin, direction))
    chosen = load_network() if network is None else network
    meshes, notes, doubts = label_meshes(image, chosen, asked, progress)
    said, doubted = tell((*image.grid.flagged, *notes), doubts)
    meshes = [replace(mesh, notes=said, warnings=doubted) for mesh in meshes]
    return dict(zip(image.volumes, meshes))


@dataclass(frozen=True, eq=False)
class LabelImage:
    """Samples with labels, and those of the labels that are to be meshed."""

    grid: SdfGrid  # the labels as its samples, and where they lie
    volumes: dict[int, float]  # the labels to mesh, ascending, and of their samples, as boxes
    numbers: NDArray[np.int16]  # of each sample: n for the n-th of these labels, 0 for others
    missing: list[int]  # labels that were asked for, and that no sample has


def find_image(
    values: Any, asked: options.Options, given: Sequence[Any], *, partly: bool = False
) -> LabelImage:
    """Return the labels of an array or a file at a ``given`` place; ``partly``: some may lack."""
    place, notes = dict[str, Any](zip(PLACE, given)), list[str]()
    if isinstance(values, (str, PathLike)):
        place = read_array(values, place, asked.axes, asked.space, asked.max_memory)
        values, notes = place["values"], list(place["notes"])
    elif asked.axes is not None:
        raise OptionError(f"--axes is {seen(asked.axes)}: that is for files; transpose the array")
    samples, spacing, origin = placed(values, place["spacing"], place["origin"])
    counts, numbers, missing = find_labels(samples, in_order(asked.labels), partly=partly)
    if spacing is None:
        notes.append("spacing not given: taken as 1, since labels show none (give --spacing)")
    notes += ["origin not given: sample (0, 0, 0) is at 0, 0, 0"] * (origin is None)
    if unknown := int(samples.dtype.kind == "f" and sum(np.isnan(x).sum() for x in samples)):
        notes.append(f"{unknown:,} samples are unknown: taken as outside all labels")
    ends = [numbers.take(end, axis).ravel() for axis in range(3) for end in (0, -1)]
    if by := [[*counts][n - 1] for n in np.unique(np.concatenate(ends)) if n]:
        notes.append(f"solids of labels run out of the grid: closed along the border ({named(by)})")
    steps = check_spacing(1.0 if spacing is None else spacing)
    more = {"direction": place["direction"], "extremes": extremes_of_masks(min(steps))}
    grid = SdfGrid.trusted(samples, steps, origin, tuple(notes), **more, field=MASK)
    volumes = {label: mean_spacing(grid) ** 3 * count for label, count in counts.items()}
    return LabelImage(with_fields(grid, space=place.get("space")), volumes, numbers, missing)


def in_order(labels: Any) -> list[int] | None:
    """Return labels in ascending order, each once; None for all."""
    if labels == "all":
        return None
    chosen = sorted({options.LABEL.check(label, "--labels") for label in labels})
    if not 0 < len(chosen) <= MOST_LABELS:
        raise OptionError(f"--labels has {len(chosen):,} labels: give 1 to {MOST_LABELS:,}")
    return chosen


def find_labels(
    samples: Any, wanted: list[int] | None, *, partly: bool
) -> tuple[dict[int, int], NDArray[np.int16], list[int]]:
    """Return how many samples each label has, numbers of a ``LabelImage``, and missing labels."""
    counts, samples = Counter[Any](), as_labels(samples, unknown=0)
    for plane in samples:  # to save memory
        values, times = np.unique(plane, return_counts=True)
        odd = values[~np.isfinite(values) | (np.rint(values) != values)]
        if len(odd):
            way_out = "choose what is above a value with --level if they are densities"
            raise GridError(f"a value is {odd[0]:g}: labels are whole numbers; {way_out}")
        counts.update(dict(zip(values.tolist(), times.tolist())))
        if wanted is None and len(counts) > MOST_LABELS + 1:
            raise GridError(
                f"the values are more than {MOST_LABELS:,} different whole numbers: choose some of "
                "them (--labels 1,2,3) if they are labels, or a --level if they are densities"
            )
    kinds = sorted(counts)
    is_label = np.array([kind != 0 if wanted is None else kind in wanted for kind in kinds])
    found = {int(kind): counts[kind] for kind, chosen in zip(kinds, is_label) if chosen}
    missing = [label for label in wanted or () if label not in found]
    if missing and not (partly and found):
        raise GridError(f"no sample has the label {missing[0]}: the labels are {named(kinds)}")
    if not found or len(kinds) == 1:
        raise GridError(f"every sample has the label {int(kinds[0])}: there is no surface")
    number_of = (np.cumsum(is_label) * is_label).astype(np.int16)
    numbers, ordered = np.empty(samples.shape, np.int16), np.array(kinds, samples.dtype)
    for plane, out in zip(samples, numbers):
        out[...] = number_of[np.searchsorted(ordered, plane)]
    return found, numbers, missing


def label_meshes(
    image: LabelImage, network: Decoder, asked: options.Options, progress: Progress | None
) -> tuple[list[Mesh], list[str], list[str]]:
    """Return the meshes of an image's labels, notes and warnings."""
    options.NETWORK.check(network, "network")
    if asked.goals():
        check_modules("simplifying", "simplify")
    grid, factor, voxel = image.grid, asked.factor_for(mask=True), image.grid.voxel_size
    kind = vertex_type(grid, factor)  # raises if not even float64 resolves the vertices
    adapter, count = adapt(network_for(network, "mask")), len(image.volumes)
    fields = label_fields(image.numbers, count, grid, adapter, factor, asked.max_memory, progress)
    walls = extract_walls(fields)
    del fields
    faces = walls.faces[:, ::-1] if grid.is_mirrored else walls.faces
    vertices = grid.to_world(walls.vertices / factor - 0.5).astype(kind)
    walls, notes, warnings = Walls(vertices, faces, walls.sides), list[str](), list[str]()
    if asked.keep_volume:
        walls = keep_volumes(walls, [*image.volumes.values()], mean_spacing(grid))
    if find_spec("pyfqmr") is None:
        notes.append("pyfqmr is not installed: no triangles are spared")
    else:
        walls = spared(walls, SLIGHT * voxel, voxel / factor)
    if error := asked.error(voxel):
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
    from scipy.spatial import cKDTree

    held, vertices = np.zeros(len(walls.vertices), bool), walls.vertices
    for turn in range(MOST_REPEATS):
        made = collapse_edges(walls, held, distance)[0]
        places = made.vertices[faults(made, spacing)]
        if not len(places):
            return made
        reach, low = spacing * 1.5**turn, vertices.min(0)
        cells, near = (np.floor((some - low) / reach) for some in (vertices, places))
        held |= cKDTree(near).query(cells, p=np.inf, distance_upper_bound=1.5)[0] < 1.5
    return walls
