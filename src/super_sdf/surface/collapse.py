"""Collapsing edges with pyfqmr: fast quadric mesh simplification (Forstmann).

An edge is collapsed if the sum of squared distances of the new vertex to the planes of the
triangles it replaces is under a threshold, which rises in every round.
"""

from __future__ import annotations

from threading import Lock
from typing import Any

from ..arrays import IntArray, Vectors

ONE_AT_A_TIME = Lock()  # pyfqmr has one mesh, in global variables
FEW_ROUNDS = 8, 5.0  # of the threshold, and its rise: from more, large meshes get no smaller


def collapse(points: Vectors, faces: IntArray, **options: Any) -> tuple[Vectors, IntArray]:
    """Return the points and triangles that are left, in their order; open edges stay."""
    from pyfqmr import Simplify

    with ONE_AT_A_TIME:
        library = Simplify()
        library.setMesh(points, faces)
        library.simplify_mesh(preserve_border=True, verbose=False, **options)
        points, faces, _ = library.getMesh()
    return points, faces


def up_to_1(rounds: int, rise: float) -> dict[str, Any]:
    """Return the options for collapses within 1 of the planes round the new vertex."""
    thresholds = {"max_iterations": rounds, "alpha": rounds**-rise, "K": 1}
    return {"target_count": 0, "aggressiveness": rise, **thresholds}
