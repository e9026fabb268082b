"""Kinds of grids that are not exact distances, each made from the exact samples of a case.

``KINDS`` is the table: to measure another kind, add an entry to it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..arrays import FloatArray
from ..truth.solid import Solid
from .cases import FIELD_NOISE, Case
from .names import FIELD_METHOD_LABELS, OURS, on_kind

Array = NDArray[Any]

CUTS = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0)  # voxels
UNEVEN_CUTS = (1.0, 2.5)  # voxels, inside and outside
UNKNOWN = 2.0  # voxels from which on values are NaN
UNIT = 0.01  # of values in another unit
WAVES = 2.0  # periods of the varying slope along an axis of the grid
SLOPES = (0.5, 1.5)  # least and largest of the varying slope
NOISES = (0.1, 0.25)  # amplitudes, voxels
RATIOS = (1.5, 5.0)  # of the coarse spacing to the others
MOST_BY_HAND = 2.0  # ratio up to which grids are resampled by hand to the finest spacing
CHUNK = 1 << 18  # samples at a time

DISTANCES = ("mc", "bspline", OURS)
MASKS = ("mc", *(name for name in FIELD_METHOD_LABELS if name.startswith("mc-")), OURS)
TO_FINEST, TO_COARSEST = ("linear-finest", "spline-finest"), "spline-coarsest"
AXES = "xyz"


@dataclass(frozen=True, eq=False)
class Kind:
    """A kind of grid, and what is done with it.

    Attributes
    ----------
    group : str
        One of ``FIELD_GROUPS``.
    title : str
        What tables call it. Kinds with the same title share their rows.
    make : callable
        Takes a case; returns the values as they stand in a user's file.
    methods : tuple of str
        What is measured, by the names in ``FIELD_METHOD_LABELS``.
    level : float, optional
        Of a mask or of densities: the other methods mesh the surface at this value, and what is
        above it is inside. Default: distances, negative inside.
    options : mapping
        What the user says of the values, as options of ``make_grid``.
    unit : float, optional
        The values are distances times this unit, and the user knows no spacing. Default: the
        spacing is given.
    ratio : float
        The spacing along ``axis`` (x, y or z) over that along the others, which have more samples.
    """

    group: str
    title: str
    make: Callable[[Case], Array]
    methods: tuple[str, ...] = DISTANCES
    level: float | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    unit: float | None = None
    ratio: float = 1.0
    axis: str = ""

    @property
    def name(self) -> str:
        """What the kind is called in ``KINDS`` and in the rows of an evaluation."""
        return f"{self.title}, {self.axis}" if self.axis else self.title

    @property
    def is_scaled(self) -> bool:
        """Whether a user says ``--field scaled`` if the default call is refused."""
        return self.group == "scaled"

    @property
    def is_cubic(self) -> bool:
        """Whether the spacing is the same on all axes."""
        return self.ratio == 1


@dataclass(frozen=True, eq=False)
class FieldSamples:
    """The values of a kind for a case.

    Attributes
    ----------
    values : (nx, ny, nz) array
        As in a user's file.
    spacing, origin : (3,) float64
        World distance between samples along each axis, and position of sample (0, 0, 0).
    """

    values: Array
    spacing: NDArray[np.float64]
    origin: NDArray[np.float64]


@lru_cache(maxsize=1)
def samples_of(kind: Kind, case: Case) -> FieldSamples:
    """Return the values of a kind; the methods of a kind follow one another, so one is kept."""
    values = kind.make(case)
    spacing = case.side / np.array(values.shape)
    return FieldSamples(values, spacing, case.low + spacing / 2)


def level_set(kind: Kind, values: Array) -> FloatArray:
    """Return what the other methods mesh at 0, negative inside, float32.

    Unknown values (NaN) are those of the nearest known sample.
    """
    signed = values if kind.level is None else kind.level - values.astype(np.float32)
    return without_unknown(np.asarray(signed, np.float32))


def without_unknown(values: FloatArray) -> FloatArray:
    """Return values with each NaN replaced by that of the nearest sample that has none."""
    unknown = np.isnan(values)
    if not unknown.any():
        return values
    nearest = ndimage.distance_transform_edt(unknown, return_distances=False, return_indices=True)
    return values[tuple(nearest)]


def exact(case: Case) -> Array:
    """Return the exact distances."""
    return case.coarse


def mask(case: Case) -> Array:
    """Return 1 inside and 0 outside, uint8."""
    return (case.coarse <= 0).astype(np.uint8)


def truncated(case: Case, *, inside: float, outside: float) -> Array:
    """Return distances that are cut off at a number of voxels on either side."""
    h = case.spacing
    return np.clip(case.coarse, -inside * h, outside * h)


def partly_unknown(case: Case, *, beyond: float) -> Array:
    """Return distances that are NaN beyond some voxels from the surface."""
    return np.where(np.abs(case.coarse) <= beyond * case.spacing, case.coarse, np.float32(np.nan))


def scaled(case: Case, *, unit: float) -> Array:
    """Return distances in another unit."""
    return case.coarse * np.float32(unit)


def saturating(case: Case) -> Array:
    """Return w tanh(d/w) of distances d, w two voxels: slope 1 at the surface, less beyond."""
    width = np.float32(2 * case.spacing)
    return width * np.tanh(case.coarse / width)


def steepening(case: Case) -> Array:
    """Return d + d^2 of distances d, in sides of the grid: slope 1 at the surface, more outside.

    It is monotone, since no distance inside is beyond half of the side.
    """
    side = np.float32(case.side)
    return case.coarse + case.coarse**2 / side


def varying(case: Case) -> Array:
    """Return distances times a smooth factor of the position, within ``SLOPES``."""
    place = (np.indices(case.coarse.shape).sum(0) + 1.5) / case.setting.size
    low, high = SLOPES
    factor = (low + high) / 2 + (high - low) / 2 * np.sin(2 * np.pi * WAVES * place)
    return (case.coarse * factor).astype(np.float32)


def occupancy(case: Case) -> Array:
    """Return 1 / (1 + exp(d / h)) of distances d: 1 deep inside, 1/2 on the surface."""
    return (0.5 - 0.5 * np.tanh(case.coarse / (2 * case.spacing))).astype(np.float32)


def shares(case: Case) -> Array:
    """Return about the share of each voxel that is inside: 1/2 - d/h, between 0 and 1."""
    return np.clip(0.5 - case.coarse / case.spacing, 0, 1).astype(np.float32)


def noisy(case: Case, *, amplitude: float) -> Array:
    """Return distances with uniform noise of an amplitude in voxels."""
    random = np.random.default_rng(case.shape.seed(FIELD_NOISE))
    noise = random.uniform(-amplitude, amplitude, case.coarse.shape) * case.spacing
    return (case.coarse + noise).astype(np.float32)


def unequal(case: Case, *, ratio: float, axis: str) -> Array:
    """Return exact distances at the case's samples along an axis, and more along the others."""
    size = case.setting.size
    x, y, z = (size if letter == axis else round(size * ratio) for letter in AXES)
    return sample_box(case.shape.solid, (x, y, z), case.side)


def sample_box(solid: Solid, shape: tuple[int, int, int], side: float) -> FloatArray:
    """Return the distances at the centres of the boxes into which a cube of some side is cut."""
    spacing = side / np.array(shape)
    values = np.empty(shape, np.float32)
    flat = values.reshape(-1)
    for start in range(0, flat.size, CHUNK):
        numbers = np.arange(start, min(start + CHUNK, flat.size))
        ijk = np.stack(np.unravel_index(numbers, shape), axis=1)
        flat[numbers] = solid.signed_distance((ijk + 0.5) * spacing - side / 2)
    return values


def truncated_kind(title: str, inside: float, outside: float) -> Kind:
    """Return the kind of distances cut off at these voxels."""
    make = partial(truncated, inside=inside, outside=outside)
    return Kind("truncated", f"cut off at {title}", make)


def unequal_kind(ratio: float, axis: str) -> Kind:
    """Return the kind of grid that is coarser along an axis."""
    by_hand = (*TO_FINEST, TO_COARSEST) if ratio <= MOST_BY_HAND else (TO_COARSEST,)
    make, methods = partial(unequal, ratio=ratio, axis=axis), ("mc", *by_hand, OURS)
    return Kind("unequal", f"spacing 1:1:{ratio:g}", make, methods, ratio=ratio, axis=axis)


HALF: dict[str, Any] = {"level": 0.5, "options": {"level": 0.5}}
ALL_KINDS = (
    Kind("exact", "exact", exact),
    Kind("mask", "mask", mask, MASKS, level=0.5),
    *(truncated_kind(f"{cut:g}", cut, cut) for cut in CUTS),
    truncated_kind("-1 and 2.5", *UNEVEN_CUTS),
    Kind("truncated", f"unknown beyond {UNKNOWN:g}", partial(partly_unknown, beyond=UNKNOWN)),
    Kind("scaled", "d/100, no spacing given", partial(scaled, unit=UNIT), unit=UNIT),
    Kind("scaled", "d/100, spacing given", partial(scaled, unit=UNIT)),
    Kind("scaled", "2h tanh(d/2h)", saturating),
    Kind("scaled", "d + d^2", steepening),
    Kind("scaled", "d times 0.5 to 1.5", varying),
    Kind("density", "1/(1 + exp(d/h))", occupancy, **HALF),
    Kind("density", "share of the voxel", shares, **HALF),
    *(Kind("noisy", f"noise of {noise:g}", partial(noisy, amplitude=noise)) for noise in NOISES),
    *(unequal_kind(ratio, axis) for ratio in RATIOS for axis in AXES),
)
KINDS = {kind.name: kind for kind in ALL_KINDS}


def kinds_at(size: int, sizes: Sequence[int], groups: Sequence[str]) -> list[str]:
    """Return the kinds of some groups at a size: unequal spacings only at the smallest."""
    return [
        name
        for name, kind in KINDS.items()
        if kind.group in groups and (kind.is_cubic or size == min(sizes))
    ]


def methods_on(kinds: Sequence[str]) -> tuple[str, ...]:
    """Return the names under which the methods are measured on some kinds."""
    return tuple(on_kind(method, name) for name in kinds for method in KINDS[name].methods)
