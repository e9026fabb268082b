"""All labels of an image in one run: closed meshes whose shared walls coincide.

Each label is refined as the mask of its samples, and so is what is beside all of them; ``walls``
makes the surfaces of these fields. The work is done in slabs of all labels.

>>> from super_sdf import reconstruct_labels
>>> meshes = reconstruct_labels(image, spacing=(1, 1, 3))         # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import BoolArray, IntArray
from ..errors import GridError, OptionError, seen
from ..files.grids import read_array
from ..grid.derived import REACH, extremes_of_masks, mask_planes
from ..grid.field import NONE_EXACT, Field
from ..grid.interpret import as_sample, labelled
from ..grid.placement import as_samples, check_kind, check_spacing, is_cubic, placed
from ..grid.planes import NoPlanes, SampleArray, SamplePlanes, changed
from ..grid.refusals import named
from ..grid.sdf_grid import SdfGrid, with_fields
from ..threads import check_count, useful_threads
from ..surface.mesh import Mesh, join_meshes, vertex_type
from ..network.neighbourhood import CENTRE
from ..network.decoder import Adapter, Decoder, adapt
from ..network.network import network_for
from ..options import (ALL, MASK, OPTIONS, AxisOrder, Space, check_factor, check_label, check_labels, check_max_memory, check_network, check_progress)
from ..pipeline import refine_band
from ..progress import Progress, StepCounter, part_of
from ..refine.nodes import VoxelIndex
from ..refine.survey import Band, survey
from .walls import Labels, Part, absent_parts, extract_walls, put_together
from .volumes import keep_volumes, mean_spacing

MOST_LABELS = 1000  # more values than these are densities
MARGIN = REACH + 1  # samples beside a label on which its distances, and those beside them, depend
BAND_SHARE = 0.05  # of the time

Box = tuple[slice, slice, slice]


class PartOfPlanes(SamplePlanes):
    """The samples in a box of another array."""

    def __init__(self, source: SampleArray, box: Box) -> None:
        self.source, self.box, self.name = source, box, "the grid"
        self.shape, self.dtype = tuple(s.stop - s.start for s in box), np.dtype(source.dtype)

    def read(self, first: int, last: int) -> NDArray[Any]:
        """Return planes ``first`` to ``last`` (exclusive)."""
        start = self.box[0].start
        planes: NDArray[Any] = np.asarray(self.source[start + first : start + last])
        return planes[:, self.box[1], self.box[2]]


@dataclass(frozen=True, eq=False)
class LabelImage:
    """Samples with labels, of which some are to be meshed, and their place, without samples.

    ``labels`` (L,) ascend. ``boxes`` are L + 1 parts of the grid: those on which what is beside all
    labels depends, and then each label.
    """

    samples: SampleArray
    labels: NDArray[Any]
    boxes: list[Box]
    grid: SdfGrid

    def mask(self, number: int) -> SdfGrid:
        """Return distances to label ``labels[number - 1]``, in its box; 0 is beside all labels."""
        part = PartOfPlanes(self.samples, self.boxes[number])
        labels, label = self.labels, self.labels[number - 1]

        def chosen(planes: NDArray[Any]) -> BoolArray:
            return planes == label if number else ~np.isin(planes, labels)

        h = self.grid.voxel_size
        return SdfGrid.trusted(
            mask_planes(changed(part, chosen, np.bool_), h),
            self.grid.spacing,
            extremes=extremes_of_masks(h),
            field=self.grid.field,
        )

    @property
    def corners(self) -> IntArray:
        """The lowest indices of each box, (L + 1, 3)."""
        return np.array([[side.start for side in box] for box in self.boxes], np.int32)

    def names(self) -> list[int]:
        """Return the labels as whole numbers."""
        return [int(label) for label in self.labels]

    def missing(self, wanted: str | list[int]) -> list[int]:
        """Return which of the wanted labels no sample has."""
        return [] if isinstance(wanted, str) else [n for n in wanted if n not in self.names()]

    def counts(self) -> list[int]:
        """Return how many samples each label has."""
        parts = [PartOfPlanes(self.samples, box) for box in self.boxes[1:]]
        return [
            sum(int((part[i : i + 1] == label).sum()) for i in range(part.shape[0]))
            for part, label in zip(parts, self.labels)
        ]

    def volumes(self) -> list[float]:
        """Return the volume of each label's samples, each of which counts as a box."""
        return [count * float(np.prod(self.grid.spacing)) for count in self.counts()]

    def border(self, planes: tuple[int, int]) -> IntArray:
        """Return indices of border samples in some planes and the number of their mask, (b, 4)."""
        parts = [np.empty((0, 4), np.int64)]
        for plane in range(*planes):
            some = np.ones(self.grid.shape[1:], bool)
            some[1:-1, 1:-1] = plane in (0, self.grid.shape[0] - 1)
            values = np.asarray(self.samples[plane])[some]
            at = np.searchsorted(self.labels, values).clip(max=len(self.labels) - 1)
            number = np.where(self.labels[at] == values, at + 1, 0)
            parts.append(np.column_stack([np.full(len(values), plane), np.argwhere(some), number]))
        return np.concatenate(parts).astype(np.int32)


@dataclass(frozen=True, eq=False)
class LabelPiece:
    """A piece of the mesh of a label, and its share of the volume that all pieces enclose.

    Faces number the vertices of all pieces of the label so far.
    """

    label: int
    mesh: Mesh
    volume: float


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
        labelled(image.samples, label)  # raises
    if network is None:
        from ..network.network import load_network

        network = load_network()
    found: dict[int, list[Mesh]] = {label: [] for label in image.names()}
    for piece in label_slabs(image, network, factor, max_memory=max_memory, progress=progress):
        found[piece.label].append(piece.mesh)
    meshes = [join_meshes(pieces) for pieces in found.values()]
    if OPTIONS["keep_volume"].check(keep_volume):
        meshes = keep_volumes(meshes, image.volumes(), mean_spacing(image.grid))
    return dict(zip(found, meshes))


def find_image(
    values: Any,
    wanted: str | list[int],
    place: dict[str, Any],
    axes: AxisOrder | None,
    max_memory: int | None,
    space: Space | None = None,
) -> LabelImage:
    """Return the label image of an array or a file; ``place`` has spacing, origin and direction.

    Of labels ``in_order``, those that no sample has are left out; GridError if none is left.
    """
    notes: list[str] = []
    if isinstance(values, (str, PathLike)):
        place = read_array(values, place, axes, space, max_memory)
        values, notes = place["values"], list(place["notes"])
    elif axes is not None:
        raise OptionError(f"axes is {seen(axes)}: that is for files; transpose the array")
    given = placed(values, place["spacing"], place["origin"])
    samples = as_samples(given.values)
    check_kind(samples.dtype, samples.shape)
    boxes = find_labels(samples, None if isinstance(wanted, str) else wanted)
    if given.spacing is None:
        notes.append("spacing not given: taken as 1, since labels show none (give --spacing)")
    if given.origin is None:
        notes.append("origin not given: sample (0, 0, 0) is at 0, 0, 0")
    ends, shape = np.array(list(boxes.values())), np.array(samples.shape)
    is_cut = (ends[:, 0] == 0).any(1) | (ends[:, 1] == shape - 1).any(1)
    cut = [int(label) for label, leaves in zip(boxes, is_cut) if leaves]
    if cut:
        notes.append(
            f"solids of labels run out of the grid: closed along the border ({named(cut)})"
        )
    low, high = np.maximum(ends[:, 0] - MARGIN, 0), np.minimum(ends[:, 1] + MARGIN + 1, shape)
    low, high = np.vstack([low.min(0), low]), np.vstack([high.max(0), high])
    around = [
        (slice(a, d), slice(b, e), slice(c, f))
        for a, b, c, d, e, f in np.hstack([low, high]).tolist()
    ]
    steps = check_spacing(1.0 if given.spacing is None else given.spacing)
    grid = SdfGrid.trusted(
        NoPlanes(samples.shape, samples.dtype),
        steps,
        0.0 if given.origin is None else given.origin,
        tuple(notes),
        direction=place["direction"],
        extremes=extremes_of_masks(min(steps)),
        field=Field(MASK, True, NONE_EXACT, on_lattice=not is_cubic(steps)),
    )
    grid = with_fields(grid, space=place.get("space"))
    return LabelImage(samples, np.array(list(boxes), samples.dtype), around, grid)


def in_order(labels: Any) -> str | list[int]:
    """Return labels in ascending order, each once; "all" for all."""
    given = check_labels(labels)
    if isinstance(given, str):
        return given
    chosen = sorted({check_label(label, "labels") for label in given})
    if not 0 < len(chosen) <= MOST_LABELS:
        raise OptionError(f"labels are {len(chosen):,}: give 1 to {MOST_LABELS:,} at a time")
    return chosen


def find_labels(samples: SampleArray, wanted: list[int] | None) -> dict[Any, NDArray[np.int64]]:
    """Return the box of each label, (2, 3) lowest and highest indices, by its sample, in order.

    ``wanted`` are some labels; None are all but 0. The samples are read once.
    """
    keep = [as_sample(label, samples.dtype) for label in wanted or ()]
    listed = np.array([value for value in keep if value is not None], samples.dtype)
    boxes: dict[Any, NDArray[np.int64]] = {}
    others = False
    for plane, values in enumerate(samples):
        runs, low, high = _runs(values)
        if runs.dtype.kind == "f" and len(wrong := runs[(np.rint(runs) != runs) | np.isinf(runs)]):
            raise GridError(
                f"a value is {wrong[0]:g}: labels are whole numbers; choose what is above a value "
                "with --level if they are densities"
            )
        some = runs != 0 if wanted is None else np.isin(runs, listed)
        others |= not some.all()
        kinds, of_run = np.unique(runs[some], return_inverse=True)
        low, high = low[some], high[some]
        for number, value in enumerate(kinds[: MOST_LABELS + 1].tolist()):
            mine = of_run == number
            ends = np.array([[plane, *low[mine].min(0)], [plane, *high[mine].max(0)]])
            box = boxes.setdefault(value, ends)
            box[0], box[1] = np.minimum(box[0], ends[0]), np.maximum(box[1], ends[1])
        if len(boxes) > MOST_LABELS:
            raise GridError(
                f"the values are more than {MOST_LABELS:,} different whole numbers: choose some of "
                "them (--labels 1,2,3) if they are labels, or a --level if they are densities"
            )
    if wanted and not boxes:
        labelled(samples, wanted[0])  # raises
    if not boxes or (len(boxes) == 1 and not others):
        only = int(next(iter(boxes), 0))
        raise GridError(f"every sample has the label {only}: there is no surface")
    return dict(sorted(boxes.items()))


def _runs(plane: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.intp], NDArray[np.intp]]:
    """Return the runs of equal samples in the rows of a plane: values, and both ends (n, 2)."""
    begins = np.ones(plane.shape, bool)
    np.not_equal(plane[:, 1:], plane[:, :-1], out=begins[:, 1:])
    low = np.argwhere(begins)
    ends = np.ones(plane.shape, bool)
    ends[:, :-1] = begins[:, 1:]
    return plane[begins], low, np.argwhere(ends)


def label_slabs(
    image: LabelImage,
    network: Decoder,
    factor: int = 4,
    *,
    max_memory: int | None = None,
    progress: Progress | None = None,
) -> Iterator[LabelPiece]:
    """Yield the meshes of ``reconstruct_labels`` slab by slab, in as few as fit in memory.

    Joined, the pieces of a label are the same mesh, bit for bit, for any number of slabs.
    """
    check_network(network)
    check_progress(progress)
    factor = check_factor(factor)
    chosen = adapt(network_for(network, MASK))
    vertex_type(image.grid, factor)  # raises if not even float64 resolves the vertices
    check_max_memory(max_memory)
    threads = useful_threads(chosen.threads)
    work = Work(image, chosen, factor, threads, _bands(image, threads))
    if progress:
        progress(round(1000 * BAND_SHARE), 1000)
    slabs = [(0, image.grid.shape[0])]
    written = np.zeros(len(image.labels) + 1, np.int64)  # vertices of each label so far
    for nth, planes in enumerate(slabs):
        share = [BAND_SHARE + (1 - BAND_SHARE) * (nth + n) / len(slabs) for n in (0, 1)]
        yield from work.pieces(planes, written, part_of(progress, *share))


def _bands(image: LabelImage, threads: int) -> list[Band]:
    """Return the band of each label in its box; first, that of what is beside all of them.

    Of that, only those voxels are decoded that two labels or more have in their bands, too.
    """
    bands = [survey(image.mask(nth), 0.0, threads=threads) for nth in range(len(image.labels) + 1)]
    keys = [
        VoxelIndex(band.voxel_ijk + low, image.grid.shape).keys
        for band, low in zip(bands, image.corners)
    ]
    found, times = np.unique(np.concatenate(keys[1:]), return_counts=True)
    several = np.isin(keys[0], found[times > 1])
    return [replace(bands[0], decoded=several), *bands[1:]]


@dataclass(frozen=True, eq=False)
class Work:
    """What the slabs of an image have in common; ``bands`` are those of ``_bands``."""

    image: LabelImage
    network: Adapter
    factor: int
    threads: int
    bands: list[Band]

    def pieces(
        self, planes: tuple[int, int], written: NDArray[np.int64], progress: Progress | None
    ) -> Iterator[LabelPiece]:
        """Yield the meshes of labels in some planes, and count the vertices ``written`` of each."""
        grid = self.image.grid
        parts = self._parts(planes, progress)
        field = put_together(parts, next(parts)[1], grid.shape, self.factor, planes)
        places, faces, sides, before = extract_walls(field, self.image.border(planes))
        del field
        world: NDArray[Any] = grid.to_world(places / self.factor - 0.5)
        world = world.astype(vertex_type(grid, self.factor))
        middle = grid.to_world((np.array(grid.shape) - 1) / 2)
        a, b, c = ((world - middle)[corner] for corner in faces.T)
        volume = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6  # to the middle, seen from inside
        if grid.is_mirrored:
            faces, volume = faces[:, ::-1], -volume
        yield from self._by_label(world, faces, volume, sides, before, written)

    def _by_label(
        self,
        world: NDArray[Any],
        faces: IntArray,
        volume: NDArray[np.float64],
        sides: Labels,
        before: int,
        written: NDArray[np.int64],
    ) -> Iterator[LabelPiece]:
        """Yield the mesh of each label: the walls on either side of which it lies.

        The slab before has the first ``before`` vertices (n, 3); see ``extract_walls``.
        """
        names = self.image.names()
        both, label = np.concatenate([faces, faces[:, ::-1]]), sides.T.ravel()
        rank = label.astype(np.int64) * len(label) + np.tile(np.arange(len(faces)), 2)
        order = np.argsort(rank)
        ends = np.searchsorted(label[order], np.arange(1, len(self.bands) + 1))
        for number, some in enumerate(np.split(order, ends)[1:-1], 1):
            used, own = np.unique(both[some], return_inverse=True)
            shared = int(np.searchsorted(used, before))  # the slab before has them
            own += written[number] - shared
            written[number] += len(used) - shared
            check_count(int(written[number]), "vertices")
            mesh = Mesh(world[used[shared:]], own.reshape(-1, 3).astype(np.int32))
            if len(some):
                signs = np.where(some < len(faces), 1.0, -1.0)
                yield LabelPiece(names[number - 1], mesh, float(signs @ volume[some % len(faces)]))

    def _parts(
        self, planes: tuple[int, int], progress: Progress | None
    ) -> Iterator[tuple[int, Part]]:
        """Yield the fields of all labels that have voxels in some planes, in order; always of 0."""
        for number, band in enumerate(self.bands):
            voxel_ijk = band.voxel_ijk + self.image.corners[number]
            if number and not len(voxel_ijk):
                continue
            inside = band.patches[:, CENTRE] <= 0
            table = band.table.T.copy()
            absent = absent_parts(table, voxel_ijk, inside, self.image.grid.shape)
            blocks = np.full(((self.factor + 1) ** 3, len(voxel_ijk)), np.nan, np.float32)
            if band.decoded.any():
                share = number / len(self.bands), (number + 1) / len(self.bands)
                steps = StepCounter(part_of(progress, *share), ["network", "nodes"])
                field = refine_band(band, self.network, self.factor, self.threads, steps)
                blocks[:, band.decoded] = field.blocks
            yield number, Part(voxel_ijk, absent, blocks)
