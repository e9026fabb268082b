"""Types of the arrays that the steps exchange, and the order of the voxels in a neighbourhood."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float32]
IntArray: TypeAlias = NDArray[np.int32]
BoolArray: TypeAlias = NDArray[np.bool_]
Signs: TypeAlias = NDArray[np.int8]
"""1 outside, -1 inside, 0 unknown."""
Triple: TypeAlias = tuple[float, float, float]
"""One number per axis: x, y, z."""

NEIGHBOURHOOD: IntArray = np.indices((3, 3, 3)).reshape(3, 27).T.astype(np.int32) - 1
"""Steps from the centre voxel to the 27 of a patch or of a row of a neighbour table, (27, 3)."""
CORNERS: IntArray = np.indices((2, 2, 2)).reshape(3, 8).T.astype(np.int32)
"""Steps from the lowest corner of a cell to all of them, (8, 3)."""
CENTRE = 13
"""Index of the centre voxel itself."""
STRIDES = np.array([9, 3, 1])
"""Difference of the indices of two places next to each other along each axis."""


def without_device(values: Any) -> Any:
    """Return a tensor of PyTorch so that NumPy takes it; other values as they are.

    It may be on a GPU, have gradients, or be bfloat16, of which NumPy has none.
    """
    for method in ("detach", "cpu"):
        values = getattr(values, method, lambda same=values: same)()
    return values.float() if str(getattr(values, "dtype", "")) == "torch.bfloat16" else values
