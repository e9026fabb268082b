"""Label images: which labels there are, and the part of the grid in which each lies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import BoolArray, IntArray
from ..errors import GridError, OptionError, seen
from ..options import MASK, check_label
from .derived import REACH, extremes_of_masks, mask_planes
from .field import NONE_EXACT, Field
from .interpret import as_sample, labelled
from .placement import as_samples, check_kind, check_spacing, is_cubic, placed
from .planes import NoPlanes, SampleArray, SamplePlanes, changed
from .refusals import MOST_NAMED
from .sdf_grid import SdfGrid

ALL = "all"
MOST_LABELS = 1000  # more values than these are densities
MARGIN = REACH + 1  # samples beside a label on which its distances, and those beside them, depend

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

    def names(self) -> list[int]:
        """Return the labels as whole numbers."""
        return [int(label) for label in self.labels]

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


def make_labels(
    values: ArrayLike | SamplePlanes,
    labels: str | Sequence[int] = ALL,
    *,
    spacing: ArrayLike | None = None,
    origin: ArrayLike | None = None,
    direction: ArrayLike | None = None,
    notes: tuple[str, ...] = (),
) -> LabelImage:
    """Return the label image of an array; the parameters are those of ``reconstruct_labels``."""
    wanted = check_labels(labels)
    given = placed(values, spacing, origin)
    samples = as_samples(given.values)
    check_kind(samples.dtype, samples.shape)
    boxes = find_labels(samples, None if isinstance(wanted, str) else wanted)
    added: list[str] = []
    steps = None if given.spacing is None else check_spacing(given.spacing)
    if steps is None:
        added.append("spacing not given: taken as 1, since labels show none (give --spacing)")
        steps = (1.0, 1.0, 1.0)
    if given.origin is None:
        added.append("origin not given: sample (0, 0, 0) is at 0, 0, 0")
    ends, shape = np.array(list(boxes.values())), np.array(samples.shape)
    is_cut = (ends[:, 0] == 0).any(1) | (ends[:, 1] == shape - 1).any(1)
    cut = [str(int(label)) for label, leaves in zip(boxes, is_cut) if leaves]
    if cut:
        named = ", ".join(cut[:MOST_NAMED]) + ", ..." * (len(cut) > MOST_NAMED)
        added.append(f"solids of labels run out of the grid: closed along the border ({named})")
    low, high = np.maximum(ends[:, 0] - MARGIN, 0), np.minimum(ends[:, 1] + MARGIN + 1, shape)
    low, high = np.vstack([low.min(0), low]), np.vstack([high.max(0), high])
    grid = SdfGrid.trusted(
        NoPlanes(samples.shape, samples.dtype),
        steps,
        0.0 if given.origin is None else given.origin,
        (*notes, *added),
        direction=direction,
        extremes=extremes_of_masks(min(steps)),
        field=Field(MASK, True, NONE_EXACT, on_lattice=not is_cubic(steps)),
    )
    around = [_box(*pair) for pair in zip(low.tolist(), high.tolist())]
    return LabelImage(samples, np.array(list(boxes), samples.dtype), around, grid)


def _box(low: list[int], high: list[int]) -> Box:
    i, j, k = map(slice, low, high)
    return i, j, k


def check_labels(labels: Any) -> str | list[int]:
    """Return labels in ascending order, each once; "all" for all."""
    if isinstance(labels, str) and labels == ALL:
        return ALL
    if isinstance(labels, (str, bytes)) or not hasattr(labels, "__iter__"):
        raise OptionError(f"labels is {seen(labels)}: give all, or some labels such as 1,2,3")
    chosen = sorted({check_label(label, "labels") for label in labels})
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
        _check_whole(runs)
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
    for label in wanted or ():
        if label not in boxes:
            labelled(samples, label)  # raises
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


def _check_whole(values: NDArray[Any]) -> None:
    if values.dtype.kind != "f":
        return
    wrong = values[(np.rint(values) != values) | ~np.isfinite(values)]
    if len(wrong):
        raise GridError(
            f"a value is {wrong[0]:g}: labels are whole numbers; choose what is above a value with "
            "--level if they are densities"
        )
