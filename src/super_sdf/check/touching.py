"""How far the spheres of samples are from touching the mesh, and which vertices they contradict.

An exact sample is the radius of an empty ball that touches the surface. Its residual is its
distance to the mesh minus that radius: positive if the mesh does not reach the ball, negative if it
pierces it. All lengths are in voxels unless they are named otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from ..grid.sdf_grid import SdfGrid
from ..threads import chunks_of
from ..surface.mesh import Mesh
from ..network.neighbourhood import CENTRE, NEIGHBOURHOOD
from ..refine.band import plane_blocks, rescale
from ..refine.nodes import VoxelIndex
from ..refine.survey import Band
from ..truth.solid import Points, Solid
from .search import Found

WIDTH = 4  # 2^17 samples at a time
CLEAR = 0.5  # cosine to the nearest triangle's normal above which that tells the side
NOTICEABLE = 0.1  # voxels: a residual that is counted as large
STRAY = 0.5  # voxels within a ball, from which on a vertex is counted
NEAREST_FEET = 8  # foot points that a vertex looks at
SMOOTHING = 0.02  # voxels: distance of a foot point that halves its weight
FARTHEST = 1.5  # voxels: foot points farther away say nothing of a vertex


@dataclass(frozen=True, eq=False)
class Samples:
    """The exact samples of a grid near the surface, in C order.

    Those that promise nothing are counted and left out: cut off at the limit of truncated values or
    at the band's edge; and noisy ones, which differ from a neighbour by more than distances can,
    together with the rest if they are many.
    """

    cut_off: int
    noisy: int
    voxel_ijk: IntArray  # (n, 3)
    points: Points  # (n, 3), in world units
    values: FloatArray  # (n,), negative inside


@dataclass(frozen=True, eq=False)
class Touching(Samples):
    """The exact samples of a grid, and where their balls meet the mesh."""

    residuals: FloatArray  # (n,): distance to the mesh minus absolute value
    feet: Points  # (n, 3): the nearest points of the mesh, in world units
    wrong_side: BoolArray  # (n,): mesh and sample disagree on it by more than ``NOTICEABLE``

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


@dataclass(frozen=True)
class Strays:
    """Vertices that lie where the nearest sample says that no surface is.

    The samples near the surface see nothing of a piece that lies far from it. But every sample,
    however far away, promises a ball without surface, also if its value was truncated.
    """

    count: int  # vertices more than ``STRAY`` voxels inside the ball of their nearest sample
    beyond: int  # vertices more than half a voxel from the outermost samples
    deepest: float  # of a vertex in the ball of its nearest sample; 0 if there is none


def exact_samples(band: Band, grid: SdfGrid) -> Samples:
    """Return the exact samples of a band: of its grid, from ``survey``."""
    values = band.patches[:, CENTRE]
    # ``is_cut_off`` keeps truncated samples beside the surface, whose neighbours are steep
    trusted = band.exact & (values > values.min()) & (values < values.max())
    if band.sampled is not None:
        trusted &= band.sampled  # of a resampled grid, what is interpolated promises nothing
    exact = np.flatnonzero(trusted)
    # if none is exact, too many are no distances for any to be taken for one
    count = len(band.exact) if band.sampled is None else int(np.count_nonzero(band.sampled))
    noisy = band.count_noisy() if len(exact) else count
    ijk = band.voxel_ijk[exact]
    cut_off, distances = count - len(exact) - noisy, values[exact] * np.float32(0.5)
    return Samples(cut_off, noisy, ijk, grid.to_world(ijk), distances)


def touch(
    mesh: Mesh, samples: Samples, found: Found, voxel_size: float, *, simple: bool
) -> Touching:
    """Return where the balls of exact samples meet a mesh.

    ``found`` is by ``search`` for the points of the samples, ``voxel_size`` the spacing of the
    grid. On which side of the mesh a sample lies is by its winding number; but if the mesh is
    ``simple``, see ``Surface``, not where the nearest triangle agrees with the sample.
    """
    distances, size = found.distances / voxel_size, np.abs(samples.values)
    residuals = (distances - size).astype(np.float32)
    solid, wrong = Solid(mesh), np.zeros(len(size), bool)
    agreed = simple & (np.where(samples.values > 0, 1, -1) * found.cosines > CLEAR)
    apart = np.flatnonzero((distances + size > NOTICEABLE) & ~agreed)  # where the side matters
    for chunk in chunks_of(len(apart), WIDTH):
        some = apart[chunk]
        wrong[some] = solid.is_inside(samples.points[some]) != (samples.values[some] <= 0)
    return Touching(**vars(samples), residuals=residuals, feet=found.feet, wrong_side=wrong)


def find_strays(
    vertices: NDArray[Any], grid: SdfGrid, band: Band, offset: float = 0.0, slack: float = 0.0
) -> Strays:
    """Look up the nearest sample of each vertex, (n, 3) in world units.

    A sample's value may be off by ``slack``, in voxels, as those of masks are.

    Planes of the grid are read only for vertices whose nearest sample is not in the band.
    """
    position = grid.to_index(vertices)
    nearest = np.rint(position).astype(np.int64)
    inside = ((nearest >= 0) & (nearest < grid.shape)).all(1)
    position, nearest = position[inside], nearest[inside]
    row = VoxelIndex(band.voxel_ijk, grid.shape).find(nearest)
    values = band.patches[:, CENTRE][row] if len(band.patches) else np.zeros(len(row))
    far = np.flatnonzero(row < 0)
    plane = nearest[far, 0]
    for first, last in plane_blocks(grid.shape):
        rows = far[(plane >= first) & (plane < last)]
        if len(rows):
            i, j, k = nearest[rows].T
            values[rows] = rescale(grid, offset, first, last)[i - first, j, k]
    depth = np.abs(values) / 2 - np.linalg.norm(position - nearest, axis=1) - slack
    count, beyond = np.count_nonzero(depth > STRAY), np.count_nonzero(~inside)
    return Strays(int(count), int(beyond), float(depth.max(initial=0)))


def vertex_residuals(vertices: NDArray[Any], touching: Touching, grid: SdfGrid) -> FloatArray:
    """Return the residual at each vertex, (n,), in voxels; NaN where no foot point is near.

    Its size is the mean of the absolute residuals at the nearest foot points of the samples around,
    each weighted by the inverse of its distance; its sign is that of the mean with signs.
    """
    residuals = np.full(len(vertices), np.nan, np.float32)
    index = VoxelIndex(touching.voxel_ijk, grid.shape)
    if not len(touching.values):
        return residuals
    for chunk in chunks_of(len(vertices), 8 * len(NEIGHBOURHOOD)):
        some = np.asarray(vertices[chunk], np.float64)
        nearest = np.rint(grid.to_index(some)).astype(np.int64)
        rows = index.find(nearest[:, None] + NEIGHBOURHOOD)
        away = np.linalg.norm(some[:, None] - touching.feet[rows], axis=2) / grid.voxel_size
        away[rows < 0] = np.inf
        limit = np.partition(away, NEAREST_FEET - 1, axis=1)[:, NEAREST_FEET - 1, None]
        weight = np.where(away <= np.minimum(limit, FARTHEST), 1 / (away + SMOOTHING), 0)
        there = touching.residuals[rows]
        with np.errstate(invalid="ignore"):
            size = (weight * np.abs(there)).sum(1) / weight.sum(1)
        residuals[chunk] = np.copysign(size, (weight * there).sum(1))
    return residuals
