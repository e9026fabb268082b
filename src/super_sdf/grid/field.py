"""What the values of a grid are, and what the method may do with them.

exact      distances
truncated  distances that are cut off near the surface
mask       inside or outside, nothing else
scaled     a field of another slope than 1: another unit, or no distance at all
noisy      distances with noise
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Triple
from ..errors import OptionError, seen
from .census import Extremes
from .placement import check_spacing
from .planes import SampleArray, changed

FIELDS = ("auto", "exact", "truncated", "mask", "scaled", "noisy")
AUTO, EXACT, TRUNCATED, MASK, SCALED, NOISY = FIELDS
INSIDE = ("auto", "negative", "positive")
NONE_EXACT: Extremes = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Field:
    """The kind of a field.

    Attributes
    ----------
    kind : str
        One of ``FIELDS``, but not "auto".
    given : bool
        Whether the user said so; otherwise the samples show it.
    exact : two floats
        Only samples between these, in world units, negative inside, may be exact distances.
    smooth : array or Planes, optional
        Of a scaled field: the values whose cubic spline has the surface, negative inside.
    has_kinks : bool
        Whether a scaled field is mostly a distance, so that the network may refine its kinks.
    is_uneven : bool
        Whether the slope of that field jumps, as that of fused depth images.
    on_lattice : bool
        Whether the values are distances on the lattice of the samples, in steps of the finest
        spacing, and not in the world. Then no axis is resampled if the spacings differ.
    evidence : dict
        What the samples show, for ``--json``.
    unseen : bool array or Planes, optional
        Samples that are unknown and may hide the surface: it ends there, and cannot be closed.
    """

    kind: str = EXACT
    given: bool = False
    exact: Extremes = (-np.inf, np.inf)
    smooth: SampleArray | None = None
    has_kinks: bool = False
    is_uneven: bool = False
    on_lattice: bool = False
    evidence: dict[str, Any] = field(default_factory=dict)
    unseen: SampleArray | None = None

    def report(self) -> dict[str, Any]:
        """Return kind and evidence as a dictionary that can be written as JSON."""
        return {"kind": self.kind, "given": self.given, **self.evidence}


@dataclass(frozen=True)
class Wanted:
    """What the user says about the values; see ``make_grid``."""

    field: str = AUTO
    label: int | None = None
    level: float | None = None
    scale: float | None = None

    def check(self) -> None:
        """Raise OptionError if an option is unknown, not a number, or contradicts another."""
        if not isinstance(self.field, str) or self.field not in FIELDS:
            raise OptionError(f"field is {seen(self.field)}: give one of {', '.join(FIELDS)}")
        if self.label is not None:
            check_label(self.label)
        for name in ("level", "scale"):
            number = getattr(self, name)
            if number is not None and not _is_finite(number):
                raise OptionError(f"{name} is {seen(number)}: give a number")
        if self.scale is not None and self.scale <= 0:
            raise OptionError(f"scale is {self.scale:g}: it must be greater than 0")
        if self.label is not None and self.level is not None:
            raise OptionError(f"label {self.label} and level {self.level:g}: give only one of them")
        if self.label is not None and self.field not in (AUTO, MASK):
            raise OptionError(
                f"label {self.label} and field {self.field}: the samples of a label are a mask"
            )


def check_label(label: Any, name: str = "label") -> int:
    """Return a label; ``name`` is the argument's in messages.

    Raises
    ------
    OptionError
        If it is no whole number that an integer of 64 bits can be, signed or not.
    """
    is_whole = isinstance(label, Integral) and not isinstance(label, bool)
    is_whole |= isinstance(label, (float, np.floating)) and float(label).is_integer()
    if not (is_whole and -(2**63) <= int(label) < 2**64):
        raise OptionError(f"{name} is {seen(label)}: give a whole number, -2^63 to 2^64 - 1")
    return int(label)


def _is_finite(number: Any) -> bool:
    try:
        return not isinstance(number, (bool, np.bool_, str)) and bool(np.isfinite(float(number)))
    except (TypeError, ValueError):
        return False


@dataclass(frozen=True)
class Request:
    """What the user says of the values: what they are, the spacing if it is known, the inside."""

    wanted: Wanted
    spacing: Triple | None
    inside: str

    @classmethod
    def checked(cls, wanted: Wanted, spacing: ArrayLike | None, inside: str) -> Request:
        """Return a request whose parts have been checked; OptionError or GridError if one fails."""
        wanted.check()
        if not isinstance(inside, str) or inside not in INSIDE:
            raise OptionError(f"inside is {seen(inside)}: give one of {', '.join(INSIDE)}")
        return cls(wanted, None if spacing is None else check_spacing(spacing), inside)

    @property
    def is_auto(self) -> bool:
        """Whether the samples are to show what the values are."""
        return self.wanted.field == AUTO

    @property
    def is_density(self) -> bool:
        """Whether the values are densities, from which a level was taken."""
        return self.wanted.level is not None

    def above_is_inside(self) -> Request:
        """Return the request with what is above a level inside, unless the user says otherwise."""
        return replace(self, inside="positive") if self.inside == AUTO else self

    def with_spacing(self, spacing: float, why: str, notes: list[str]) -> Request:
        """Return the request with a spacing if none is given, and why in a note."""
        if self.spacing is not None:
            return self
        notes.append(f"spacing not given: taken as {spacing:.6g}, {why}")
        return replace(self, spacing=check_spacing(spacing))


@dataclass(frozen=True, eq=False)
class Interpreted:
    """Distances near the surface with their extremes, and how they are to be used."""

    samples: SampleArray
    extremes: Extremes
    spacing: Triple
    positive_inside: bool
    field: Field

    def with_field(self, **changes: Any) -> Interpreted:
        """Return the same with some attributes of the field changed."""
        return replace(self, field=replace(self.field, **changes))

    def divided(self, slope: float) -> Interpreted:
        """Return values divided by a slope."""
        low, high = self.extremes
        samples = changed(self.samples, lambda values: values / slope)
        return replace(self, samples=samples, extremes=(low / slope, high / slope))
