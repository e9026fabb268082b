"""The families of procedural solids, by name.

A family is a function ``rng -> Manifold`` that draws one kind of solid, about one unit long and
anywhere in space.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from manifold3d import Manifold

from export.shapes.basic import csg, facets, lathe, prism, rounded
from export.shapes.edges import chamfered, filleted
from export.shapes.lettering import text
from export.shapes.mechanical import gear, plate, repeated, ribs, threads
from export.shapes.organic import blends, blobs, creature, displaced, gyroid
from export.shapes.sculpted import sculpture
from export.shapes.slender import frame, lattice, pipe, section, shell, thin

Family = Callable[[np.random.Generator], Manifold]

MACHINED: tuple[Family, ...] = (
    prism, csg, lathe, rounded, facets,
    filleted, chamfered,
    plate, gear, repeated, threads, ribs,
    shell, frame, pipe, thin, section, lattice, text,
)  # fmt: skip
GROWN: tuple[Family, ...] = (blobs, gyroid, blends, creature, displaced, sculpture)
FAMILIES: dict[str, Family] = {family.__name__: family for family in (*MACHINED, *GROWN)}

GROWN_SHARE = 0.4  # few of the meshes at hand have smooth, irregular shapes


def draw_family(rng: np.random.Generator, names: Sequence[str] = ()) -> Family:
    """Draw a family: one of those named, equally likely each time they are, or of all."""
    if names:
        return FAMILIES[names[rng.integers(len(names))]]
    families = GROWN if rng.random() < GROWN_SHARE else MACHINED
    return families[rng.integers(len(families))]
