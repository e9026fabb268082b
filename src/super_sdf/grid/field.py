"""What the values of a grid are, and what the method may do with them.

exact      distances
truncated  distances that are cut off near the surface
mask       inside or outside, nothing else
scaled     a field of another slope than 1: another unit, or no distance at all
noisy      distances with noise
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Triple
from ..options import AUTO as AUTO
from ..options import EXACT as EXACT
from ..options import FIELDS as FIELDS
from ..options import MASK as MASK
from ..options import NOISY as NOISY
from ..options import SCALED as SCALED
from ..options import TRUNCATED as TRUNCATED
from ..options import ReadOptions, check_inside
from .census import Extremes
from .placement import check_spacing
from .planes import SampleArray, changed

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
class Request:
    """What the user says of the values: what they are, the spacing if it is known, the inside."""

    wanted: ReadOptions
    spacing: Triple | None
    inside: str

    @classmethod
    def checked(cls, wanted: ReadOptions, spacing: ArrayLike | None, inside: str) -> Request:
        """Return a request whose parts have been checked; OptionError or GridError if one fails."""
        check_inside(inside)
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
