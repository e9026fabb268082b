"""A surface, and the two ways to one that need no network: marching cubes and splines."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage
from skimage.measure import marching_cubes

from super_sdf.arrays import FloatArray
from super_sdf.surface.mesh import Mesh

NUDGE = np.float32(1e-9)  # replaces exact zeros: a vertex on a node can open the surface
EMPTY = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))


@dataclass(frozen=True, eq=False)
class Surface:
    """The result of a method: a mesh, and the refined field if the method has one.

    ``field`` returns the values at the fine nodes, (K n + 1)^3, known at least in the band. It is
    a function so that it is not computed while the method is timed. ``facts`` are further entries
    of the measurement.
    """

    mesh: Mesh
    field: Callable[[], FloatArray] | None = None
    facts: Mapping[str, Any] | None = None


def isosurface(field: FloatArray, spacing: float, low: float, table: str = "lorensen") -> Mesh:
    """Mesh a dense field by marching cubes; zeros in it are replaced by ``NUDGE``."""
    field[field == 0] = NUDGE
    if not field.min() < 0 < field.max():
        return EMPTY
    vertices, faces, _, _ = marching_cubes(field, 0.0, method=table)
    return Mesh(vertices.astype(np.float64) * spacing + low, faces.astype(np.int32))


def interpolate_spline(coarse: FloatArray, factor: int, order: int) -> FloatArray:
    """Return SciPy's spline interpolation of a given order at the fine nodes, (K n + 1)^3."""
    field = np.asarray(coarse, np.float32)
    for _ in range(3):  # refines the first axis and moves it to the end; after three, all in order
        field = np.tensordot(field, lattice_weights(field.shape[0], factor, order), (0, 1))
    return field


@lru_cache(maxsize=8)
def lattice_weights(n: int, factor: int, order: int) -> FloatArray:
    """Return the matrix that interpolates n samples at the K n + 1 nodes of one axis, (K n + 1, n).

    Spline interpolation is linear in the samples and separable, so one matrix for each axis does
    it, without the 3 GB of coordinates of a 513^3 lattice. In the half voxel beyond the outer
    samples, their values are continued ("nearest").
    """
    position = [np.arange(factor * n + 1) / factor - 0.5]
    columns = [
        ndimage.map_coordinates(unit, position, order=order, mode="nearest") for unit in np.eye(n)
    ]
    return np.stack(columns, axis=1).astype(np.float32)


def closed_isosurface(field: FloatArray, spacing: ArrayLike, low: ArrayLike) -> Mesh:
    """Mesh a dense field by marching cubes, closed at its border; see ``isosurface``.

    ``spacing`` and ``low``, the position of the first node, are one number or three.
    """
    beyond = max(float(np.abs(field).max()), 1e-6)
    padded = np.pad(field, 1, constant_values=beyond)
    return stretched(isosurface(padded, 1.0, -1.0), spacing, low)


def stretched(mesh: Mesh, spacing: ArrayLike, low: ArrayLike) -> Mesh:
    step = np.broadcast_to(np.asarray(spacing, np.float64), 3)
    return mesh.transformed(np.diag(step), np.broadcast_to(np.asarray(low, np.float64), 3))
