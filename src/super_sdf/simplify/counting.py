"""A number of triangles instead of an error: the error is sought that leaves it.

Each error that is tried is a whole simplification, as for an error alone, so that a number costs
some five times as much, and its mesh is as good as that of the error.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ..surface.mesh import Mesh
from .collapsing import PLANE_DISTANCES, Passes, Rounds, collapse_to, within
from .measuring import Original, mean_side

MOST_ERRORS = 12  # that are tried
FIRST_ERROR = 0.006  # in sides of a triangle, over the share of the triangles that is wanted
STRIDE, CLOSE = 4.0, 1.02  # largest ratio of an error to the next, and smallest of two in the end
FARTHEST = 0.05  # over the diagonal of the box: larger errors leave no fewer
NEAR_END = 1.2  # ratio of the largest error that is of use to one that need not rise any more
# Simplified once more within the same error, meshes have fewer triangles, by about this factor.
MARGIN = 1.06


class Search:
    """The error within which somewhat more than a number of triangles is left.

    ``low`` and ``high`` are an error and what it leaves: too many, and few enough.
    """

    def __init__(self, mesh: Mesh, triangles: int) -> None:
        self.triangles, self.most = triangles, MARGIN**2 * triangles
        self.all = len(mesh.faces)
        self.low, self.high = (0.0, self.all), (np.inf, 0)
        self.is_near = False  # whether the high one leaves hardly less than the number
        self.farthest = FARTHEST * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
        guess = FIRST_ERROR * mean_side(mesh) * len(mesh.faces) / triangles
        self.error = min(guess, self.farthest)

    def goes_on(self, once: int, left: int) -> bool:
        """Take what the error left, once and in the end; return whether another is to be tried."""
        all_alike = not self.low[0] and once == self.high[1]  # as on planes
        if once == self.all > self.low[1] and not self.high[1]:  # the error is too large
            self.farthest = min(self.farthest, self.error)
        elif left > self.triangles:
            self.low = self.error, once
        else:
            self.high, self.is_near = (self.error, once), self.triangles < MARGIN * left
        found = self.is_near and left <= self.triangles < once
        is_end = not self.high[1] and self.farthest < NEAR_END * self.low[0]
        if found or all_alike or is_end:
            return False
        if self.high[0] < CLOSE * self.low[0]:
            if self.is_near:
                return False
            self.low = 0.0, self.low[1]  # smaller errors may leave few enough, too
        self.error = self._next()
        return True

    def _next(self) -> float:
        """Return an error between: what is left falls about as a power of the error."""
        (low, more), (high, fewer), wanted = self.low, self.high, MARGIN * self.triangles
        if high == np.inf:
            rise = np.clip(more / wanted, 1.1, STRIDE)
            return low * float(min(rise, max(1.1, np.sqrt(self.farthest / low))))
        if not low:
            return high * float(np.clip(fewer / wanted, 1 / STRIDE, 0.9))
        share = np.log(more / wanted) / np.log(more / fewer)
        return float(low * (high / low) ** np.clip(share, 0.15, 0.85))


def down_to(
    mesh: Mesh, original: Original, triangles: int, rounds: Rounds
) -> tuple[Mesh, tuple[str, ...]]:
    """Return a mesh of at most ``triangles`` triangles, or the smallest found and a warning."""
    if len(mesh.faces) <= triangles:
        return mesh, ()
    search, least, reached, error = Search(mesh, triangles), mesh, None, 0.0
    for _ in range(MOST_ERRORS):
        result, _ = within(mesh, original, search.error, rounds)
        once = count(result)
        if triangles < once < search.most:
            result, _ = within(result, original, search.error, rounds)
        if count(result) <= triangles:
            reached = result
        elif count(result) < count(least):
            least, error = result, search.error
        if not search.goes_on(once, count(result)):
            break
    if reached:
        return reached, ()
    if error:
        least, _ = within(least, original, error, rounds)
    passes = [partial(collapse_to, triangles=triangles)] * len(PLANE_DISTANCES)
    exact = Passes(least, passes).result(rounds)  # whatever the distance
    if exact and count(exact) <= triangles:
        return exact, ()
    return least, (f"{triangles:,} triangles cannot be reached while the mesh stays a manifold of "
                   f"the same topology: it has {count(least):,}",)  # fmt: skip


def count(mesh: Mesh) -> int:
    """Return the number of triangles."""
    return len(mesh.faces)
