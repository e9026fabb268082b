"""The families of procedural solids, by name.

A family is a function ``rng -> Manifold`` that draws one kind of solid, about one unit long and
anywhere in space.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from manifold3d import Manifold

from export.basic import csg, facets, lathe, prism, rounded
from export.edges import chamfered, filleted
from export.lettering import text
from export.mechanical import gear, plate, repeated, ribs, threads
from export.organic import blends, blobs, creature, displaced, gyroid
from export.slender import frame, lattice, pipe, shell, thin

Family = Callable[[np.random.Generator], Manifold]

FAMILIES: dict[str, Family] = {
    family.__name__: family
    for family in (
        prism, csg, lathe, rounded, facets,
        filleted, chamfered,
        plate, gear, repeated, threads, ribs,
        shell, frame, pipe, thin, lattice, text,
        blobs, gyroid, blends, creature, displaced,
    )
}  # fmt: skip
