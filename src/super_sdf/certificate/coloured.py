"""A mesh coloured by the residuals of the samples whose foot points lie on it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..arrays import FloatArray
from ..errors import OptionError
from ..files.output import check_free
from ..files.plain_meshes import write_coloured_ply
from .check import Certificate
from .touching import Touching

NEIGHBOURS = 8  # foot points that a vertex looks at
SMOOTHING = 0.02  # voxels: distance of a foot point that halves its weight
FARTHEST = 1.5  # voxels: foot points farther away say nothing of a vertex
FULL = 0.1  # voxels: residual at which a colour is saturated
TOUCHING, PIERCED, NOT_TOUCHING, UNKNOWN = (
    (240, 240, 240),
    (190, 20, 30),
    (20, 70, 190),
    (120, 120, 60),
)


def check_coloured(path: Path, *, force: bool = False) -> None:
    """Raise if a coloured mesh cannot be written; called before the work starts."""
    if path.suffix.lower() != ".ply":
        raise OptionError(f"{path} is not a coloured mesh file: give .ply")
    check_free(path, force=force)


def write_coloured(certificate: Certificate, path: Path, *, force: bool = False) -> None:
    """Write the mesh of a certificate as PLY, with a colour and ``residual`` for each vertex."""
    residuals = vertex_residuals(
        certificate.mesh.vertices, certificate.touching, certificate.voxel_size
    )
    write_coloured_ply(certificate.mesh, residuals, colours(residuals), path, force=force)


def vertex_residuals(
    vertices: NDArray[np.float64], touching: Touching, voxel_size: float
) -> FloatArray:
    """Return the residual at each vertex, (n,), in voxels; NaN where no foot point is near.

    Its size is the mean of the absolute residuals at the nearest foot points, each weighted by the
    inverse of its distance; its sign is that of the mean with signs.
    """
    if not len(touching.values):
        return np.full(len(vertices), np.nan, np.float32)
    reach = FARTHEST * voxel_size
    away, rows = cKDTree(touching.feet).query(
        vertices, NEIGHBOURS, distance_upper_bound=reach, workers=-1
    )
    weight = np.where(np.isfinite(away), 1 / (away + SMOOTHING * voxel_size), 0)
    said = np.append(touching.residuals, np.float32(0))[rows]  # the last for missing neighbours
    with np.errstate(invalid="ignore"):
        size = (weight * np.abs(said)).sum(1) / weight.sum(1)
    return np.copysign(size, (weight * said).sum(1)).astype(np.float32)


def colours(residuals: FloatArray) -> NDArray[np.uint8]:
    """Return red, green and blue, (n, 3), of residuals (n,) in voxels."""
    share = np.nan_to_num(np.clip(np.abs(residuals) / FULL, 0, 1))[:, None]
    end = np.where((residuals < 0)[:, None], PIERCED, NOT_TOUCHING)
    mixed = (1 - share) * np.array(TOUCHING) + share * end
    mixed[np.isnan(residuals)] = UNKNOWN
    return np.rint(mixed).astype(np.uint8)
