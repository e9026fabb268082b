"""What arrays in HDF5, Zarr and TIFF share: place by attributes, and parts that are not stored."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arrays import Triple
from ...errors import FileError, GridError
from ..boxes import Box
from ..volume import axes_direction, in_array_order

ReadBox = Callable[[Box], NDArray[Any]]


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


def without_gaps(read_box: ReadBox, absent: int, total: int, fill: Any) -> ReadBox:
    """Return ``read_box``, which refuses signed samples if parts that are not stored read as 0.

    A file leaves out parts that hold nothing but its fill value. In masks and densities 0 is the
    background, but of signed distances it is the surface. Any other fill value is as good as a
    stored one.

    Parameters
    ----------
    read_box : callable
        Returns a box of samples.
    absent, total : int
        How many parts (chunks, strips) of the array are not stored, of how many.
    fill : number or None
        What they read as; None if the file does not say.

    Raises
    ------
    GridError
        Now, if ``fill`` is None; else when a negative sample is read.
    """
    gaps = GridError(
        f"{absent:,} of its {total:,} chunks are not stored and read as 0, which is the surface: "
        "write them all, or give the array a fill value other than 0 (NaN for unknown)"
    )
    if absent and fill is None:
        raise gaps

    def read(box: Box) -> NDArray[Any]:
        samples = read_box(box)
        if samples.dtype.kind in "fi" and (samples < 0).any():
            raise gaps
        return samples

    return read if absent and fill == 0 else read_box
