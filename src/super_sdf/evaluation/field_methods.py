"""What is done with grids that are not exact distances: by us, and by people today.

Meshes are closed: beyond the border of a grid everything is outside.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from ..arrays import BoolArray, FloatArray
from ..errors import GridError
from ..grid.field import AUTO, SCALED
from ..grid.sdf_grid import SdfGrid, make_grid
from ..mesh import Mesh
from ..network.decoder import Decoder
from ..pipeline import reconstruct
from .cases import Case
from .field_kinds import KINDS, FieldSamples, Kind, level_set, samples_of
from .methods import EMPTY, Method, Surface, interpolate_spline, isosurface
from .names import OURS, WIDTHS, on_kind

KindMethod = Callable[[Kind, Case, Decoder], Surface]


def closed_isosurface(field: FloatArray, spacing: ArrayLike, low: ArrayLike) -> Mesh:
    """Mesh a dense field by marching cubes, closed at its border; see ``isosurface``.

    ``spacing`` and ``low``, the position of the first node, are one number or three.
    """
    beyond = max(float(np.abs(field).max()), 1e-6)
    padded = np.pad(field, 1, constant_values=beyond)
    return stretched(isosurface(padded, 1.0, -1.0), spacing, low)


def stretched(mesh: Mesh, spacing: ArrayLike, low: ArrayLike) -> Mesh:
    """Return a mesh in samples as one in the world."""
    step = np.broadcast_to(np.asarray(spacing, np.float64), 3)
    return mesh.transformed(np.diag(step), np.broadcast_to(np.asarray(low, np.float64), 3))


def coarse_of_kind(kind: Kind, case: Case, network: Decoder) -> Surface:
    """Mesh the values by marching cubes, as they are."""
    return coarse_mesh(samples_of(kind, case), partial(level_set, kind))


def coarse_mesh(samples: FieldSamples, change: Callable[[NDArray[Any]], FloatArray]) -> Surface:
    """Mesh changed values by marching cubes."""
    field = change(samples.values)
    return Surface(closed_isosurface(field, samples.spacing, samples.origin))


def spline_of_kind(kind: Kind, case: Case, network: Decoder) -> Surface:
    """Mesh the cubic B-spline of the values at the fine nodes."""
    field = interpolate_spline(level_set(kind, samples_of(kind, case).values), case.factor, 3)
    return Surface(closed_isosurface(field, case.fine, case.low))


def transform_of_mask(kind: Kind, case: Case, network: Decoder) -> Surface:
    """Mesh SciPy's distance transform of a mask by marching cubes."""
    return coarse_mesh(samples_of(kind, case), lambda values: distances_of(values > 0))


def distances_of(inside: BoolArray) -> FloatArray:
    """Return SciPy's distances of a mask, in voxels, half a voxel less on either side."""
    out, into = (ndimage.distance_transform_edt(side) for side in (~inside, inside))
    return np.where(inside, 0.5 - into, out - 0.5).astype(np.float32)


def smoothed_mask(kind: Kind, case: Case, network: Decoder, *, width: float) -> Surface:
    """Mesh a mask by marching cubes, smoothed by a Gaussian of a width in voxels."""
    return coarse_mesh(samples_of(kind, case), partial(smoothed, width=width))


def smoothed(values: NDArray[Any], width: float) -> FloatArray:
    """Return 1/2 less the smoothed values of a mask, negative inside."""
    return 0.5 - ndimage.gaussian_filter(values.astype(np.float32), width, mode="nearest")


def our_surface_of_kind(kind: Kind, case: Case, network: Decoder) -> Surface:
    """Mesh the values with super-sdf, as a user of the command would.

    If the default call is refused, and the kind is scaled, ``--field scaled`` is tried. ``facts``
    has what the values were taken as and whether the user had to say so, or why they were refused.
    """
    refusals = []
    for told in (AUTO, SCALED) if kind.is_scaled else (AUTO,):
        try:
            grid = grid_of(kind, case, told)
            mesh = reconstruct(grid, network, factor=case.factor, cap=True)
        except GridError as problem:
            refusals.append(str(problem))
        else:
            facts = {"taken_as": grid.field.kind, "told": told != AUTO}
            return Surface(placed(mesh, kind, case), facts=facts)
    return Surface(EMPTY, facts={"refused": refusals[0]})


def grid_of(kind: Kind, case: Case, told: str) -> SdfGrid:
    """Return the grid of a kind's values; ``told`` is the value of ``--field``."""
    samples, options = samples_of(kind, case), dict(kind.options)
    if kind.unit is None:
        options |= {"spacing": samples.spacing, "origin": samples.origin}
    return make_grid(samples.values, field=told, **options)


def placed(mesh: Mesh, kind: Kind, case: Case) -> Mesh:
    """Return a mesh in the frame of the case; without a spacing it was in units of the values."""
    if kind.unit is None:
        return mesh
    return stretched(mesh, 1 / kind.unit, samples_of(kind, case).origin)


def resampled_by_hand(
    kind: Kind, case: Case, network: Decoder, *, order: int, finest: bool
) -> Surface:
    """Mesh with super-sdf what SciPy resampled to one spacing; ``order`` is that of the spline."""
    samples = samples_of(kind, case)
    h = samples.spacing.min() if finest else samples.spacing.max()
    step = h / samples.spacing
    shape = np.rint((np.array(samples.values.shape) - 1) / step).astype(int) + 1
    values = ndimage.affine_transform(
        samples.values, step, output_shape=tuple(shape), order=order, mode="nearest"
    )
    grid = SdfGrid.trusted(values, h, samples.origin)
    try:
        return Surface(reconstruct(grid, network, factor=case.factor, cap=True))
    except GridError as problem:
        return Surface(EMPTY, facts={"refused": str(problem)})


BY_NAME: dict[str, KindMethod] = {
    "mc": coarse_of_kind,
    "mc-distances": transform_of_mask,
    **{f"mc-gaussian-{width:g}": partial(smoothed_mask, width=width) for width in WIDTHS},
    "bspline": spline_of_kind,
    "linear-finest": partial(resampled_by_hand, order=1, finest=True),
    "spline-finest": partial(resampled_by_hand, order=3, finest=True),
    "spline-coarsest": partial(resampled_by_hand, order=3, finest=False),
    OURS: our_surface_of_kind,
}

FIELD_METHODS: dict[str, Method] = {
    on_kind(method, name): partial(BY_NAME[method], kind)
    for name, kind in KINDS.items()
    for method in kind.methods
}
