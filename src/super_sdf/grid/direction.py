"""The direction of a grid: how the axes of its array lie in the world."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import Triple
from ..errors import GridError, seen

Direction: TypeAlias = tuple[Triple, Triple, Triple]
"""A matrix, row by row; its columns are the world directions of the array's axes."""

STRAIGHT: Direction = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
SKEW = 1e-3  # largest error of a product of two columns: files hold few digits
DIGITS = 1e-9  # a matrix this near to the identity is it


def check_direction(direction: ArrayLike | None) -> Direction:
    """Return a direction row by row; None is along the world's axes.

    Parameters
    ----------
    direction : (3, 3) array_like or nine numbers, row by row
        The columns are unit vectors at right angles; they may be mirrored.

    Raises
    ------
    GridError
        If it is something else.
    """
    if direction is None:
        return STRAIGHT
    matrix = _as_matrix(direction)
    products = matrix.T @ matrix
    off = np.abs(products - np.eye(3))
    if off.max() > SKEW:
        a, b = (int(n) for n in np.unravel_index(off.argmax(), (3, 3)))
        fault = f"column {a + 1} has length {np.sqrt(products[a, a]):.4g}"
        if a != b:
            fault = f"columns {a + 1} and {b + 1} are not at right angles"
        raise GridError(
            f"direction is {in_rows(matrix)}: {fault}; give unit vectors at right angles, or "
            "resample a sheared grid"
        )
    if np.abs(matrix - np.eye(3)).max() <= DIGITS:
        return STRAIGHT
    return as_direction(matrix)


def _as_matrix(direction: ArrayLike) -> NDArray[np.float64]:
    """Return nine numbers as a matrix."""
    try:
        array = np.asarray(direction)
        if array.dtype.kind not in "fiu" or array.shape not in ((9,), (3, 3)):
            raise TypeError
    except (TypeError, ValueError, RuntimeError):
        raise GridError(
            f"direction is {seen(direction)}: give nine numbers, row by row, or a 3 x 3 matrix"
        ) from None
    matrix = array.astype(np.float64).reshape(3, 3)
    if not np.isfinite(matrix).all():
        raise GridError(f"direction is {in_rows(matrix)}: it must be finite")
    return matrix


def as_direction(matrix: Any) -> Direction:
    """Return a 3 x 3 matrix row by row, as floats."""
    (a, b, c), (d, e, f), (g, h, i) = (map(float, row) for row in np.asarray(matrix))
    return (a, b, c), (d, e, f), (g, h, i)


def in_rows(matrix: Any) -> str:
    """Return a matrix as text, row by row."""
    return "; ".join(", ".join(f"{entry:.4g}" for entry in row) for row in np.asarray(matrix))


def is_mirrored(direction: Direction) -> bool:
    """Return whether the axes are left-handed in the world."""
    return bool(np.linalg.det(np.array(direction)) < 0)
