"""The 27 voxels of a neighbourhood, in the order of patches and neighbour tables.

The 48 symmetries of the cube map it to itself. A transformed distance field is the distance field
of the transformed surface, but a network reproduces this only approximately. The mean of its values
for several transformed fields, each mapped back, has a smaller error.
"""

from __future__ import annotations

from itertools import permutations, product
from math import prod

import numpy as np

from ..arrays import CENTRE as CENTRE
from ..arrays import CORNERS as CORNERS
from ..arrays import NEIGHBOURHOOD, STRIDES, FloatArray, IntArray


def cube_symmetries() -> IntArray:
    """Return the 48 rotations and reflections of the cube as matrices, (48, 3, 3) int32.

    The first is the identity, the next three are half turns about the axes: no axis is favoured,
    and their mean turns with the field. The first eight keep every axis on itself.
    """
    by_handedness = sorted(product((1, -1), repeat=3), key=lambda sign: -prod(sign))
    signs = [np.diag(sign) for sign in by_handedness]
    orders = [np.eye(3, dtype=np.int32)[list(order)] for order in permutations(range(3))]
    return np.array([sign @ order for order in orders for sign in signs], np.int32)


def turned_places(symmetry: IntArray) -> IntArray:
    """Return for each place of a neighbourhood the place that a symmetry (3, 3) maps to it, (27,).

    It transforms patches and neighbour tables: ``patches[:, turned_places(symmetry)]``. Query
    offsets are transformed by ``offsets @ symmetry.T``.
    """
    places: IntArray = ((NEIGHBOURHOOD @ symmetry + 1) @ STRIDES).astype(np.int32)
    return places


def turn(
    symmetry: IntArray, patches: FloatArray, table: IntArray, offsets: FloatArray
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Transform a band by a symmetry: patches (V, 27), neighbour table (V, 27), offsets (Q, 3)."""
    places = turned_places(symmetry)
    turned = np.ascontiguousarray(patches[:, places]), np.ascontiguousarray(table[:, places])
    return *turned, offsets @ symmetry.T.astype(np.float32)
