"""Types of the arrays that the steps exchange."""

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


def without_device(values: Any) -> Any:
    """Return a tensor of PyTorch so that NumPy takes it; other values as they are.

    It may be on a GPU, have gradients, or be bfloat16, of which NumPy has none.
    """
    for method in ("detach", "cpu"):
        values = getattr(values, method, lambda same=values: same)()
    return values.float() if str(getattr(values, "dtype", "")) == "torch.bfloat16" else values
