"""A label image: which labels its samples have, in which boxes, and where the samples lie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import IntArray
from ..errors import GridError, OptionError, seen
from ..files.grids import read_array
from ..grid.derived import extremes_of_masks
from ..grid.field import NONE_EXACT, Field
from ..grid.interpret import as_sample, labelled, named
from ..grid.samples import as_samples, check_kind, check_spacing, is_cubic, placed
from ..grid.sdf_grid import SdfGrid, with_fields
from ..options import MASK, AxisOrder, Space, check_label, check_labels

MOST_LABELS = 1000  # more values than these are densities


@dataclass(frozen=True, eq=False)
class LabelImage:
    """Samples with labels, and those of the labels that are to be meshed."""

    grid: SdfGrid  # the labels as its samples, and where they lie
    labels: NDArray[Any]  # (L,), those to mesh, ascending, of the type of the samples
    boxes: IntArray  # (L, 2, 3), the lowest and the highest indices of their samples
    counts: NDArray[np.int64]  # (L,), how many samples each has

    def numbers(self, first: int, last: int) -> NDArray[np.int16]:
        """Return planes ``first`` to before ``last``: n for the label ``labels[n - 1]``, else 0."""
        numbers = np.zeros((last - first, *self.grid.shape[1:]), np.int16)
        for plane, out in zip(range(first, last), numbers):  # one by one, to save memory
            values = np.asarray(self.grid.samples[plane])
            at = np.searchsorted(self.labels, values).clip(max=len(self.labels) - 1)
            out[...] = np.where(self.labels[at] == values, at + 1, 0)
        return numbers

    def names(self) -> list[int]:
        """Return the labels as whole numbers."""
        return [int(label) for label in self.labels]

    def missing(self, wanted: str | list[int]) -> list[int]:
        """Return which of the wanted labels no sample has."""
        return [] if isinstance(wanted, str) else [n for n in wanted if n not in self.names()]

    def volumes(self) -> list[float]:
        """Return the volume of each label's samples, each of which counts as a box."""
        box = float(np.prod(self.grid.spacing))
        return [count * box for count in self.counts.tolist()]


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
    labels, boxes, counts = find_labels(samples, None if isinstance(wanted, str) else wanted)
    if given.spacing is None:
        notes.append("spacing not given: taken as 1, since labels show none (give --spacing)")
    if given.origin is None:
        notes.append("origin not given: sample (0, 0, 0) is at 0, 0, 0")
    at_border = (boxes[:, 0] == 0) | (boxes[:, 1] == np.array(samples.shape) - 1)
    if cut := [int(label) for label in labels[at_border.any(1)]]:
        notes.append(
            f"solids of labels run out of the grid: closed along the border ({named(cut)})"
        )
    steps = check_spacing(1.0 if given.spacing is None else given.spacing)
    grid = SdfGrid.trusted(
        samples,
        steps,
        0.0 if given.origin is None else given.origin,
        tuple(notes),
        direction=place["direction"],
        extremes=extremes_of_masks(min(steps)),
        field=Field(MASK, True, NONE_EXACT, on_lattice=not is_cubic(steps)),
    )
    return LabelImage(with_fields(grid, space=place.get("space")), labels, boxes, counts)


def in_order(labels: Any) -> str | list[int]:
    """Return labels in ascending order, each once; "all" for all."""
    given = check_labels(labels)
    if isinstance(given, str):
        return given
    chosen = sorted({check_label(label, "labels") for label in given})
    if not 0 < len(chosen) <= MOST_LABELS:
        raise OptionError(f"labels are {len(chosen):,}: give 1 to {MOST_LABELS:,} at a time")
    return chosen


def find_labels(
    samples: Any, wanted: Sequence[int] | None
) -> tuple[NDArray[Any], IntArray, NDArray[np.int64]]:
    """Return labels, their boxes and counts, see ``LabelImage``; ``wanted`` None is all but 0.

    The planes are read once. In a row of samples, each run of the same label is looked at once.
    """
    keep = [as_sample(label, samples.dtype) for label in wanted or ()]
    listed = np.array([value for value in keep if value is not None], samples.dtype)
    boxes: dict[Any, NDArray[np.int64]] = {}
    counts: dict[Any, int] = {}
    others = False
    for nth in range(len(samples)):
        plane = np.asarray(samples[nth])
        starts = np.ones(plane.shape, bool)
        np.not_equal(plane[:, 1:], plane[:, :-1], out=starts[:, 1:])
        runs, at = plane[starts], np.flatnonzero(starts)
        length = np.diff(at, append=plane.size)
        if runs.dtype.kind == "f" and len(wrong := runs[(np.rint(runs) != runs) | np.isinf(runs)]):
            raise GridError(
                f"a value is {wrong[0]:g}: labels are whole numbers; choose what is above a value "
                "with --level if they are densities"
            )
        some = runs != 0 if wanted is None else np.isin(runs, listed)
        others |= not some.all()
        kinds, kind = np.unique(runs[some], return_inverse=True)
        length = length[some]
        row, low = np.divmod(at[some], plane.shape[1])
        for number, value in enumerate(kinds[: MOST_LABELS + 1].tolist()):
            mine = np.flatnonzero(kind == number)
            least = np.array([nth, row[mine[0]], low[mine].min()])
            most = np.array([nth, row[mine[-1]], (low + length)[mine].max() - 1])
            box = boxes.setdefault(value, np.stack([least, most]))
            box[0], box[1] = np.minimum(box[0], least), np.maximum(box[1], most)
            counts[value] = counts.get(value, 0) + int(length[mine].sum())
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
    order = sorted(boxes)
    found = [np.array([each[label] for label in order]) for each in (boxes, counts)]
    return np.array(order, samples.dtype), found[0], found[1]
