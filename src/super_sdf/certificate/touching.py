"""How far the sphere of each sample is from touching the mesh.

An exact sample is the radius of an empty ball that touches the surface. Its residual is its
distance to the mesh minus that radius: positive if the mesh does not reach the ball, negative if it
pierces it. All lengths are in voxels unless they are named otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import BoolArray, FloatArray
from ..grid.sdf_grid import SdfGrid
from ..machine.threads import chunks_of
from ..mesh import Mesh
from ..neighbourhood import CENTRE
from ..steps.survey import Band
from ..truth.solid import Points, Solid
from .slabs import Found

WIDTH = 4  # 2^17 samples at a time
NOTICEABLE = 0.1  # voxels: a residual that is counted as large


@dataclass(frozen=True, eq=False)
class Touching:
    """The exact samples of a grid near the surface, and where their balls meet the mesh.

    Attributes
    ----------
    cut_off, noisy : int
        Samples near the surface that promise nothing and were left out: at the limit of truncated
        values or at the band's edge; and all that differ from a neighbour by more than distances
        can, together with the rest if they are many.
    points : (n, 3) float64
        World positions of the exact samples.
    values : (n,) float32
        Their distances, negative inside.
    residuals : (n,) float32
        Distance to the mesh minus absolute value.
    feet : (n, 3) float64
        World positions of the nearest points of the mesh.
    wrong_side : (n,) bool
        Whether sample and mesh disagree on the side, by more than ``NOTICEABLE``.
    """

    cut_off: int
    noisy: int
    points: Points
    values: FloatArray
    residuals: FloatArray
    feet: Points
    wrong_side: BoolArray

    def report(self) -> dict[str, Any]:
        """Return the figures as they stand in JSON; None where no sample is exact."""
        return {
            "samples": {"exact": len(self.values), "cut_off": self.cut_off, "noisy": self.noisy},
            "residual": self.summary() if len(self.values) else None,
            "wrong_side": int(self.wrong_side.sum()) if len(self.values) else None,
        }

    def summary(self) -> dict[str, Any]:
        """Return mean, 99th percentile and maximum of the absolute residuals, and where it is."""
        size = np.abs(self.residuals)
        worst = int(size.argmax())
        return {
            "mean": float(size.mean(dtype=np.float64)),
            "p99": float(np.quantile(size, 0.99)),
            "largest": float(size[worst]),
            "largest_signed": float(self.residuals[worst]),
            "largest_at": [float(x) for x in self.points[worst]],
            "share_above_tenth": float((size > NOTICEABLE).mean()),
            "share_not_touching": float((self.residuals > NOTICEABLE).mean()),
            "share_pierced": float((self.residuals < -NOTICEABLE).mean()),
        }


@dataclass(frozen=True, eq=False)
class Samples:
    """The exact samples of a grid near the surface; see ``Touching`` for what its fields are."""

    cut_off: int
    noisy: int
    points: Points
    values: FloatArray


def exact_samples(band: Band, grid: SdfGrid) -> Samples:
    """Return the exact samples of a band: of its grid, from ``survey``."""
    trusted = band.exact & ~at_limit(band.patches[:, CENTRE])
    if band.sampled is not None:
        trusted &= band.sampled  # of a resampled grid, what is interpolated promises nothing
    exact = np.flatnonzero(trusted)
    # if none is exact, too many are no distances for any to be taken for one
    count = len(band.exact) if band.sampled is None else int(np.count_nonzero(band.sampled))
    noisy = band.noisy_voxels if len(exact) else count
    points = grid.to_world(band.voxel_ijk[exact])
    values = band.patches[exact, CENTRE] / 2  # from half voxels
    return Samples(count - len(exact) - noisy, noisy, points, values)


def touch(
    mesh: Mesh, samples: Samples, found: Found, voxel_size: float, *, simple: bool
) -> Touching:
    """Return where the balls of exact samples meet a mesh.

    Parameters
    ----------
    mesh : Mesh
        In world units.
    samples : Samples
    found : Found
        By ``slabs.search`` for the points of the samples.
    voxel_size : float
        Spacing of the grid.
    simple : bool
        Whether what is behind the surface is inside: see ``Surface.is_simple``.
    """
    distances, size = found.distances / voxel_size, np.abs(samples.values)
    residuals = (distances - size).astype(np.float32)
    apart = distances + size > NOTICEABLE  # where the side matters
    inside = found.facing < 0
    unsure = np.flatnonzero(apart & (found.facing == 0) if simple else apart)
    inside[unsure] = sides(mesh, samples.points[unsure])
    wrong = apart & (inside != (samples.values <= 0))
    return Touching(
        samples.cut_off,
        samples.noisy,
        samples.points,
        samples.values,
        residuals,
        found.feet,
        wrong,
    )


def at_limit(samples: FloatArray) -> BoolArray:
    """Return which samples, (n,), are the largest or smallest of all.

    ``is_cut_off`` keeps truncated samples beside the surface, whose neighbours are steep.
    """
    found: BoolArray = (samples == samples.min()) | (samples == samples.max())
    return found


def sides(mesh: Mesh, points: Points) -> BoolArray:
    """Return which of the points (n, 3) a mesh encloses, (n,), by its winding number."""
    solid, inside = Solid(mesh), np.zeros(len(points), bool)
    for chunk in chunks_of(len(points), WIDTH):
        inside[chunk] = solid.is_inside(points[chunk])
    return inside
