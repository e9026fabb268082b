"""The coarse input: a regular grid of signed distances and its position in the world."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import Triple
from .field import AUTO, Field, Wanted
from .interpret import interpret
from .planes import Planes, SampleArray
from .samples import Extremes, as_samples, check_not_flat, check_values
from .sides import check_negative_inside
from .spacing import as_triple, check_spacing, choose_spacing


@dataclass(frozen=True, eq=False, init=False, repr=False)
class SdfGrid:
    """Signed distances at the points ``world = origin + spacing * (i, j, k)``.

    The constructor expects values that are negative inside and a known spacing, and refuses values
    that contradict either. ``make_grid`` infers the sign, and the spacing if it is not given.

    Parameters
    ----------
    values : (nx, ny, nz) array_like
        Signed distances in world units, negative inside; i runs along x, j along y, k along z. A
        memory-mapped array or a ``Planes`` is not loaded.
    spacing : float or three floats
        World distance between neighbouring samples; equal on all axes.
    origin : float or three floats
        World position of sample (0, 0, 0). Default: 0, 0, 0.

    Attributes
    ----------
    values : (nx, ny, nz) array
        All samples, negative inside. Samples in a file are loaded on first use and stay in memory;
        ``planes`` reads some of them without that.
    low, high : float
        The smallest and the largest sample, negative inside.
    notes : tuple of str
        Sentences that say what was inferred rather than given.
    field : Field
        What the values are, and which of them can be exact.

    Raises
    ------
    GridError
        If the array is not three-dimensional, finite, and at least 2 samples long on each axis; if
        most of its border is negative; if the spacing is not positive and equal on all axes; or if
        the values change from sample to sample by more than the spacing, or by much less.
    """

    samples: SampleArray
    spacing: Triple
    origin: Triple
    notes: tuple[str, ...]
    positive_inside: bool
    low: float
    high: float
    field: Field

    def __init__(
        self, values: ArrayLike | Planes, spacing: ArrayLike, origin: ArrayLike = 0.0
    ) -> None:
        samples, extremes = _checked(values)
        check_negative_inside(samples)
        notes: list[str] = []
        chosen = choose_spacing(samples, check_spacing(spacing), notes)
        self._set(samples, chosen, origin, tuple(notes), False, extremes)

    @classmethod
    def trusted(
        cls,
        values: ArrayLike | Planes,
        spacing: ArrayLike,
        origin: ArrayLike = 0.0,
        notes: tuple[str, ...] = (),
        *,
        positive_inside: bool = False,
        extremes: Extremes | None = None,
        field: Field | None = None,
    ) -> SdfGrid:
        """Return a grid whose sign and spacing are known and not checked against the values.

        With ``positive_inside`` the sign of the values is flipped. With ``extremes``, their minimum
        and maximum, they are not searched for NaN and infinity again. Values are taken as exact
        distances unless ``field`` says what they are.
        """
        samples = as_samples(values)
        grid = object.__new__(cls)
        found = extremes or check_values(samples)
        grid._set(samples, check_spacing(spacing), origin, notes, positive_inside, found, field)
        return grid

    def _set(
        self,
        samples: SampleArray,
        spacing: Triple,
        origin: ArrayLike,
        notes: tuple[str, ...],
        positive_inside: bool,
        extremes: Extremes,
        field: Field | None = None,
    ) -> None:
        """Set all fields."""
        set_ = partial(object.__setattr__, self)
        low, high = extremes
        set_("samples", samples)
        set_("spacing", spacing)
        set_("origin", as_triple(origin, "origin"))
        set_("notes", notes)
        set_("positive_inside", positive_inside)
        set_("low", -high if positive_inside else low)
        set_("high", -low if positive_inside else high)
        set_("field", field or Field())

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.shape))
        spacing, origin = (", ".join(f"{x:.6g}" for x in at) for at in (self.spacing, self.origin))
        return (
            f"SdfGrid({shape} {self.samples.dtype}, spacing {spacing}, origin {origin}, "
            f"values {self.low:.6g} to {self.high:.6g})"
        )

    @property
    def values(self) -> NDArray[Any]:
        """All samples, negative inside."""
        samples = self.samples
        whole = samples.loaded if isinstance(samples, Planes) else samples
        return negated(whole) if self.positive_inside else whole

    def planes(self, first: int, last: int) -> NDArray[Any]:
        """Return the samples with first <= i < last, negative inside, (last - first, ny, nz)."""
        samples = self.samples[first:last]
        return negated(samples) if self.positive_inside else samples

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of samples along x, y and z."""
        nx, ny, nz = self.samples.shape
        return nx, ny, nz

    @property
    def voxel_size(self) -> float:
        """The spacing h, in world units."""
        return sum(self.spacing) / 3


def make_grid(
    values: ArrayLike | Planes,
    *,
    spacing: ArrayLike | None = None,
    origin: ArrayLike | None = None,
    inside: str = "auto",
    field: str = AUTO,
    label: float | None = None,
    level: float | None = None,
    scale: float | None = None,
) -> SdfGrid:
    """Make a grid from an array of signed distances, or of other values with a surface.

    What is not given is inferred.

    Parameters
    ----------
    values : (nx, ny, nz) array_like
        Signed distances in world units; i runs along x, j along y, k along z. Or a mask, labels,
        densities, or another field.
    spacing : number or three, optional
        World distance between neighbouring samples. Default: estimated from the gradient.
    origin : number or three, optional
        World position of sample (0, 0, 0). Default: 0, 0, 0.
    inside : {"auto", "negative", "positive"}
        Sign of the values inside the solid; "auto" takes the border of the grid as outside.
    field : {"auto", "exact", "truncated", "mask", "scaled", "noisy"}
        What the values are; "auto" goes by what the samples show. A mask is known to half a voxel,
        and scaled is a field of another slope than 1.
    label : number, optional
        The samples with this value are the solid.
    level : number, optional
        The values are densities, and the surface is where they have this value; what is above is
        inside, unless ``inside`` is "negative".
    scale : number, optional
        World units per unit of the values, if they have another unit than the spacing.

    Returns
    -------
    SdfGrid
        The grid, negative inside; its ``notes`` say what was inferred.

    Raises
    ------
    GridError
        If the values have no surface, or contradict the spacing.
    OptionError
        If ``inside`` or ``field`` is not one of these, or another option is no number.
    """
    notes: list[str] = []
    wanted = Wanted(field, label, level, scale)
    found = interpret(as_samples(values), wanted, spacing, inside, notes)
    if origin is None:
        notes.append("origin not given: sample (0, 0, 0) is at 0, 0, 0")
        origin = 0.0
    return SdfGrid.trusted(
        found.samples,
        found.spacing,
        origin,
        tuple(notes),
        positive_inside=found.positive_inside,
        extremes=found.extremes,
        field=found.field,
    )


def _checked(values: ArrayLike | Planes) -> tuple[SampleArray, Extremes]:
    """Return samples as an array, and their extremes; raise GridError if they are no field."""
    samples = as_samples(values)
    extremes = check_values(samples)
    check_not_flat(samples, extremes)
    return samples, extremes


def negated(values: NDArray[Any]) -> NDArray[Any]:
    """Return the negated values, as floats so that unsigned integers work."""
    return -values.astype(np.promote_types(values.dtype, np.float32))
