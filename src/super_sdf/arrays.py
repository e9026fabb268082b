"""Types of the arrays that the steps exchange, the places of a neighbourhood, and vectors."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float32]
IntArray: TypeAlias = NDArray[np.int32]
BoolArray: TypeAlias = NDArray[np.bool_]
Triple: TypeAlias = tuple[float, float, float]  # one number per axis: x, y, z

NEIGHBOURHOOD: IntArray = np.indices((3, 3, 3)).reshape(3, 27).T.astype(np.int32) - 1
"""Steps from the centre voxel to the 27 of a patch or of a row of a neighbour table, (27, 3)."""
CORNERS: IntArray = np.indices((2, 2, 2)).reshape(3, 8).T.astype(np.int32)
"""Steps from the lowest corner of a cell to all of them, (8, 3)."""
CENTRE = 13  # index of the centre voxel itself
STRIDES = np.array([9, 3, 1])  # from a place to that beside it along each axis, in indices

Index: TypeAlias = NDArray[np.int64]
Numbers: TypeAlias = NDArray[np.float64]
Vectors: TypeAlias = NDArray[np.float64]  # a vector in each row, (n, 3)


def dot(a: Vectors, b: Vectors) -> Numbers:
    """Return the products of vectors, (n,)."""
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2])


def inner(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """Return the products of vectors in columns, (3, ...): faster than in rows."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def face_normals(points: Vectors, faces: NDArray[Any]) -> Vectors:
    """Return normals of triangles (m, 3), as long as twice their areas."""
    a, b, c = (points.take(corner, 0) for corner in faces.T)
    return np.asarray(np.cross(b - a, c - a))


def length(vectors: Vectors) -> Numbers:
    """Return the lengths of vectors, (n,)."""
    return np.asarray(np.sqrt(dot(vectors, vectors)))


def unit(vectors: Vectors) -> Vectors:
    """Return vectors of length 1; 0 stays 0."""
    return np.asarray(vectors / np.maximum(length(vectors), 1e-150)[..., None])


def sums_at(place: Index, vectors: Vectors, count: int) -> Vectors:
    """Return the sums of vectors (m, 3) at each of ``count`` places, (count, 3)."""
    return np.stack([np.bincount(place, component, count) for component in vectors.T], 1)


def without_device(values: Any) -> Any:
    """Return a tensor of PyTorch so that NumPy takes it; other values as they are.

    It may be on a GPU, have gradients, or be bfloat16, of which NumPy has none.
    """
    for method in ("detach", "cpu"):
        values = getattr(values, method, lambda same=values: same)()
    return values.float() if str(getattr(values, "dtype", "")) == "torch.bfloat16" else values
