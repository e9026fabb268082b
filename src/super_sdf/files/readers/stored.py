"""Spacing, origin and direction of arrays in HDF5 and Zarr, by their attributes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arrays import Triple
from ...errors import FileError
from ..volume import axes_direction, in_array_order


def place_of(
    attributes: dict[str, Any], axes: str
) -> tuple[Triple | None, Triple | None, NDArray[np.float64]]:
    """Return spacing and direction of the array's axes, and the origin.

    ``element_size_um``, as ImageJ and ilastik write it, has the order of the array's axes;
    ``spacing`` and ``origin`` are x, y, z. The columns of ``direction``, nine numbers row by row,
    are the world directions of the array's axes x, y and z.
    """
    spacing = _triple(attributes, "element_size_um")
    if spacing is None:
        spacing = _triple(attributes, "spacing")
        spacing = None if spacing is None else in_array_order(spacing, axes)
    return spacing, _triple(attributes, "origin"), _direction(attributes) @ axes_direction(axes)


def _direction(attributes: dict[str, Any]) -> NDArray[np.float64]:
    """Return the attribute ``direction``, the identity if there is none."""
    if "direction" not in attributes:
        return np.eye(3)
    try:
        return np.asarray(attributes["direction"], np.float64).reshape(3, 3)
    except (TypeError, ValueError):
        raise FileError(
            f"its attribute direction is {attributes['direction']!r}: give nine numbers"
        ) from None


def _triple(attributes: dict[str, Any], name: str) -> Triple | None:
    """Return an attribute of one number or three; None if there is none of this name."""
    if name not in attributes:
        return None
    try:
        x, y, z = np.broadcast_to(np.asarray(attributes[name], np.float64).ravel(), 3)
    except (TypeError, ValueError):
        raise FileError(
            f"its attribute {name} is {attributes[name]!r}: give one number or three"
        ) from None
    return float(x), float(y), float(z)
