"""Signed distance grids of solids: every sample exact, or every sample near the surface.

The grid is processed in cubes of 8^3 samples. The distance at the centre of a cube decides whether
any of its samples can lie in the band; only those cubes are evaluated. The sign is evaluated once
per connected region away from the surface, since it cannot change there. In an open mesh it can, so
it is evaluated at every sample.
"""

from __future__ import annotations

from collections.abc import Callable
from math import prod

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..errors import MeshError, OptionError, seen
from ..grid.sdf_grid import SdfGrid
from ..surface.mesh import Mesh
from ..threads import check_fits
from .solid import Points, Solid

EDGE = 8  # samples along a cube
CHUNK = 512  # cubes at a time: 2^18 points, 20 MB
EXACT_SAMPLES = 1 << 24  # up to 256^3 every sample is exact unless a band is given
BIG_GRID_BAND = 4.0  # voxels; upsampling uses none beyond 1.5 + sqrt(3)
LEAST_BAND = 1.5  # voxels; the band of the pipeline
MOST_ALONG_AXIS = 1e9  # samples; a larger number can only be a mistake
POSITION_ERROR = 1e-4  # largest error of a sample's position, over the spacing
PADDING = 2.37  # voxels; a whole number puts faces of a box on planes of samples
ON_PLANE = 0.1  # voxels between a face of the box and a plane of samples
WORK_BYTES = 500_000_000  # for search trees and chunks, besides the values

Progress = Callable[[int, int], None]
Layout = tuple[tuple[int, int, int], float, NDArray[np.float64]]
"""Samples along the axes, spacing, and the position of sample (0, 0, 0)."""


def check_numbers(
    n: int | None = None,
    spacing: float | None = None,
    padding: float = PADDING,
    band: float | None = None,
) -> None:
    """Raise OptionError if a number that is given is out of range, whatever the mesh."""
    if n is not None and not 2 <= n < MOST_ALONG_AXIS:
        raise OptionError(f"n is {seen(n)}: give 2 to {MOST_ALONG_AXIS:g} samples along an axis")
    if spacing is not None and not 0 < spacing < np.inf:
        raise OptionError(f"spacing is {spacing:g}: it must be greater than 0")
    if not 0 <= padding < np.inf:
        raise OptionError(f"padding is {padding:g}: give 0 voxels or more")
    if n is not None and n - 1 - 2 * padding < 1:
        raise OptionError(f"{n} samples leave no room within a padding of {padding:g} voxels")
    if band is not None and not band >= LEAST_BAND:
        raise OptionError(f"band is {band:g}: give at least {LEAST_BAND:g} voxels")


def unit_layout(n: int, side: float = 1.0) -> Layout:
    """Return the layout of the test grids: voxel centres (i + 1/2)/n - 1/2, times ``side``."""
    check_numbers(n=n, padding=0)
    return (n, n, n), side / n, np.full(3, (0.5 / n - 0.5) * side)


def fitted_layout(
    mesh: Mesh, *, n: int | None = None, spacing: float | None = None, padding: float = PADDING
) -> Layout:
    """Return the layout of a grid around a mesh, in the units of the mesh.

    Give the samples ``n`` along the longest axis of its bounding box, or the ``spacing``.
    ``padding`` is the least number of voxels between the box and the outermost samples. Faces of
    the box lie on no plane of samples, unless n and the padding put them there.
    """
    if (n is None) == (spacing is None):
        raise OptionError("give either the number of samples or the spacing")
    check_numbers(n=n, spacing=spacing, padding=padding)
    low, high = mesh.vertices.min(0).astype(np.float64), mesh.vertices.max(0).astype(np.float64)
    size, is_free = high - low, np.ones(3, bool)
    if spacing is None:
        spacing, is_free = float(size.max() / ((n or 0) - 1 - 2 * padding)), size < size.max()
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.ceil(size / spacing + 2 * padding - 1e-6)
        room = (steps - size / spacing) / 2
        steps += is_free & (np.abs(room - np.rint(room)) < ON_PLANE)
        origin = (low + high - steps * spacing) / 2  # not finite: refused by the grid
    if steps.max() >= MOST_ALONG_AXIS:
        raise OptionError(f"spacing is {spacing:g}: it makes {steps.max():.3g} samples an axis")
    nx, ny, nz = (int(count) + 1 for count in steps)
    return (nx, ny, nz), spacing, origin


def sample_solid(
    solid: Solid, layout: Layout, *, band: float | None = None, progress: Progress | None = None
) -> SdfGrid:
    """Sample the signed distance to a solid as an ``SdfGrid``; see ``sample_grid``.

    Without a ``band``, distances in grids of over 256^3 samples are clamped ``BIG_GRID_BAND``
    voxels from the surface, and the grid's notes say so.
    """
    shape, spacing, origin = layout
    if band is None:
        band = BIG_GRID_BAND if prod(shape) > EXACT_SAMPLES else np.inf
    values = sample_grid(solid, layout, band=band, progress=progress)
    notes = [f"distances are exact up to {band:g} voxels and clamped there"] * (band < np.inf)
    return SdfGrid.trusted(values, spacing, origin, tuple(notes))


def sample_grid(
    solid: Solid, layout: Layout, *, band: float = np.inf, progress: Progress | None = None
) -> NDArray[np.float32]:
    """Return the signed distance at every sample of a grid, (nx, ny, nz) float32, negative inside.

    ``band`` is the distance in voxels up to which values are exact (to float32), at least 1.5; they
    are clamped there. ``progress`` is called with (cubes done, all cubes). MeshError if floating
    point cannot hold the distances or the positions; OutOfMemoryError.
    """
    shape, spacing, origin = layout
    check_numbers(band=band)
    away = float(np.abs(origin).max()) + spacing * max(shape)
    if not (spacing > 1e-30 and away < 1e30 and np.spacing(away) <= POSITION_ERROR * spacing):
        raise MeshError(
            f"a grid with a spacing of {spacing:g} that reaches to {away:g} cannot be held in "
            "floating point: scale the mesh, or move it to the origin"
        )
    need, size = prod(shape) * 4 + WORK_BYTES, " x ".join(map(str, shape))
    check_fits(need, f"a grid of {size}", "take fewer samples")
    values, limit = np.empty(shape, np.float32), band * spacing
    corners = np.argwhere(np.ones([-(-n // EDGE) for n in shape], bool)) * EDGE
    cube = np.moveaxis(np.indices((EDGE,) * 3), 0, -1)
    within_cube = np.zeros((3, 3, 3, 3), bool)
    within_cube[1] = ndimage.generate_binary_structure(3, 1)
    for start in range(0, len(corners), CHUNK):
        chunk = corners[start : start + CHUNK]
        near = np.ones(len(chunk), bool)
        cubes = np.empty((len(chunk), EDGE, EDGE, EDGE), np.float32)
        if np.isfinite(limit) and solid.is_closed:
            centres = (chunk + (EDGE - 1) / 2) * spacing + origin
            near = solid.distance(centres) <= limit + 3**0.5 * (EDGE - 1) / 2 * spacing
            sides = np.where(solid.is_inside(centres[~near]), -1, 1)
            cubes[~near] = (sides * limit)[:, None, None, None]
        points = (chunk[near][:, None, None, None] + cube).reshape(-1, 3) * spacing + origin
        found = solid.distance(points)
        # Neighbours that are both more than half a spacing from the surface are on the same side of
        # it: one sample tells that of each connected region of them.
        apart = (found > 0.5 * spacing * (1 + 1e-9)) & solid.is_closed
        regions = ndimage.label(apart.reshape(-1, EDGE, EDGE, EDGE), within_cube)[0].ravel()
        inside = np.zeros(len(points), bool)
        inside[~apart] = solid.is_inside(points[~apart])
        region, first = np.unique(regions[apart], return_index=True)
        side = np.zeros(len(region) + 1, bool)
        side[region] = solid.is_inside(points[apart][first])
        inside[apart] = side[regions[apart]]
        signed = np.where(inside, -found, found).clip(-limit, limit)
        cubes[near] = signed.reshape(-1, EDGE, EDGE, EDGE)
        for (i, j, k), one in zip(chunk, cubes):
            part = values[i : i + EDGE, j : j + EDGE, k : k + EDGE]
            part[...] = one[tuple(map(slice, part.shape))]
        if progress:
            progress(min(start + CHUNK, len(corners)), len(corners))
    return values


def grid_points(layout: Layout) -> Points:
    """Return the position of every sample of a grid, (n, 3) in C order."""
    shape, spacing, origin = layout
    return np.indices(shape).reshape(3, -1).T * spacing + origin
