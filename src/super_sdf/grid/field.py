"""What the values of a grid are, and what the method may do with them.

exact      distances
truncated  distances that are cut off near the surface
mask       inside or outside, nothing else
scaled     a field of another slope than 1: another unit, or no distance at all
noisy      distances with noise
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..options import AUTO as AUTO
from ..options import EXACT as EXACT
from ..options import FIELDS as FIELDS
from ..options import MASK as MASK
from ..options import NOISY as NOISY
from ..options import SCALED as SCALED
from ..options import TRUNCATED as TRUNCATED
from .planes import SampleArray
from .samples import Extremes

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
