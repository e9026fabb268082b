"""Types of the arrays that the steps exchange."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float32]
IntArray: TypeAlias = NDArray[np.int32]
BoolArray: TypeAlias = NDArray[np.bool_]
Signs: TypeAlias = NDArray[np.int8]
"""1 outside, -1 inside, 0 unknown."""
Triple: TypeAlias = tuple[float, float, float]
"""One number per axis: x, y, z."""
