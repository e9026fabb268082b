"""Products, lengths and directions of rows of vectors, (n, 3), summed in a fixed order."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Vectors = NDArray[np.float64]
Numbers = NDArray[np.float64]


def dot(a: Vectors, b: Vectors) -> Numbers:
    """Return the products of vectors, (n,)."""
    product: Numbers = a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]
    return product


def length(vectors: Vectors) -> Numbers:
    """Return the lengths of vectors, (n,)."""
    lengths: Numbers = np.sqrt(dot(vectors, vectors))
    return lengths


def unit(vectors: Vectors) -> Vectors:
    """Return vectors of length 1; 0 stays 0."""
    units: Vectors = vectors / np.maximum(length(vectors), 1e-12)[..., None]
    return units


def sums(row: NDArray[np.int64], vectors: Vectors, count: int) -> Vectors:
    """Return the sums of the vectors of each of ``count`` rows, (count, 3), in their order."""
    return np.stack([np.bincount(row, component, count) for component in vectors.T], 1)
