"""What the user says of a grid, and what is made of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from numpy.typing import ArrayLike

from ..arrays import Triple
from ..options import ReadOptions, check_inside
from .field import AUTO, Field
from .planes import SampleArray
from .samples import Extremes
from .spacing import check_spacing


@dataclass(frozen=True)
class Request:
    """What the user says of the values.

    Attributes
    ----------
    wanted : ReadOptions
        What they are.
    spacing : three floats, optional
        World distance between neighbouring samples along each axis, if it is known.
    inside : str
        One of ``options.INSIDE``.
    """

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
    """Distances near the surface, and how they are to be used.

    Attributes
    ----------
    samples : array or Planes
        The values.
    extremes : two floats
        Their minimum and maximum.
    spacing : three floats
    positive_inside : bool
        Whether positive values are inside.
    field : Field
    """

    samples: SampleArray
    extremes: Extremes
    spacing: Triple
    positive_inside: bool
    field: Field
