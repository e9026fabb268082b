"""The symmetries of the cube, which turn distance fields into distance fields.

A network only nearly gives the turned field the turned surface. The mean over its answers to the
field in several positions, each turned back, has a smaller error, for so many times the work.
"""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from ..arrays import FloatArray, IntArray
from ..neighbourhood import NEIGHBOURHOOD


def cube_symmetries() -> IntArray:
    """Return the 48 turns and reflections of the cube, (48, 3, 3).

    First the identity, then the other seven that swap no axes.
    """
    signs = [np.diag(sign) for sign in product((1, -1), repeat=3)]
    orders = [np.eye(3, dtype=np.int32)[list(order)] for order in permutations(range(3))]
    return np.array([sign @ order for order in orders for sign in signs], np.int32)


def turned_places(symmetry: IntArray) -> IntArray:
    """Return where in the neighbourhood stood what a symmetry, (3, 3), puts at each place, (27,).

    With it patches and neighbour tables are turned: ``patches[:, turned_places(symmetry)]``. Query
    offsets are turned by ``offsets @ symmetry.T``.
    """
    source = NEIGHBOURHOOD @ symmetry
    places: IntArray = ((source + 1) @ np.array([9, 3, 1])).astype(np.int32)
    return places


def turn(
    symmetry: IntArray, patches: FloatArray, table: IntArray, offsets: FloatArray
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Turn a band: patches (V, 27), neighbour table (V, 27), query offsets (Q, 3)."""
    places = turned_places(symmetry)
    turned = np.ascontiguousarray(patches[:, places]), np.ascontiguousarray(table[:, places])
    return *turned, offsets @ symmetry.T.astype(np.float32)
