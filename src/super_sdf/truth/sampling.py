"""Signed distance grids of solids: every sample exact, or every sample near the surface.

The grid is processed in cubes of 8^3 samples. The distance at the centre of a cube decides whether
any of its samples can lie in the band; only those cubes are evaluated. It also decides whether the
surface can cross the cube: if not, all its samples are on the same side. Across the holes of an
open mesh the side changes without a surface, so it is evaluated at every sample.
"""

from __future__ import annotations

from collections.abc import Callable
from math import prod

import numpy as np
from numpy.typing import NDArray

from ..errors import MeshError, OptionError
from ..grid.sdf_grid import SdfGrid
from ..surface.mesh import Mesh
from ..threads import check_fits, chunks_of
from .solid import Solid

EDGE = 8  # samples along a cube
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


def fitted_layout(
    mesh: Mesh, *, n: int | None = None, spacing: float | None = None, padding: float = PADDING
) -> Layout:
    """Return the layout of a grid around a mesh, in the units of the mesh.

    Give the samples ``n`` along the longest axis of its bounding box, or the ``spacing``.
    ``padding`` is the least number of voxels between the box and the outermost samples. Faces of
    the box lie on no plane of samples, unless n and the padding put them there.
    """
    if n is not None and not n - 1 - 2 * padding >= 1:
        raise OptionError(f"{n} samples leave no room within a padding of {padding:g} voxels")
    low, high = mesh.vertices.min(0).astype(np.float64), mesh.vertices.max(0).astype(np.float64)
    size, is_free = high - low, np.ones(3, bool)
    if spacing is None:
        spacing, is_free = float(size.max() / ((n or 0) - 1 - 2 * padding)), size < size.max()
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.ceil(size / spacing + 2 * padding - 1e-6)
        room = (steps - size / spacing) / 2
        steps += is_free & (np.abs(room - np.rint(room)) < ON_PLANE)
        origin = (low + high - steps * spacing) / 2  # not finite: refused by the grid
    if not steps.max() < MOST_ALONG_AXIS:
        raise OptionError(f"spacing is {spacing:g}: it makes {steps.max():.3g} samples an axis")
    nx, ny, nz = (int(count) + 1 for count in steps)
    return (nx, ny, nz), spacing, origin


def sample_solid(
    solid: Solid, layout: Layout, *, band: float | None = None, progress: Progress | None = None
) -> SdfGrid:
    """Sample the signed distance to a solid.

    ``band`` is the distance in voxels up to which values are exact (to float32), at least 1.5; they
    are clamped there, as the grid's notes say. Default: ``BIG_GRID_BAND`` in grids of over 256^3
    samples, else none. ``progress`` is called with (cubes done, all cubes). MeshError if floating
    point cannot hold the distances or the positions; OutOfMemoryError.
    """
    shape, spacing, origin = layout
    if band is None:
        band = BIG_GRID_BAND if prod(shape) > EXACT_SAMPLES else np.inf
    if not band >= LEAST_BAND:
        raise OptionError(f"band is {band:g}: give at least {LEAST_BAND:g} voxels")
    reach = float(np.abs(origin).max()) + spacing * max(shape)
    if not (spacing > 1e-30 and reach < 1e30 and np.spacing(reach) <= POSITION_ERROR * spacing):
        said = f"a spacing of {spacing:g} in a grid that reaches to {reach:g} is too fine for "
        raise MeshError(f"{said}floating point: scale the mesh, or move it to the origin")
    size = " x ".join(map(str, shape))
    check_fits(prod(shape) * 8 + WORK_BYTES, f"a grid of {size}", "take fewer samples")
    counts, limit = [-(-n // EDGE) for n in shape], band * spacing
    cubes, within_cube = np.argwhere(np.ones(counts, bool)) * EDGE, np.argwhere(np.ones([EDGE] * 3))
    values = np.empty((len(cubes), EDGE**3), np.float32)
    half = 3**0.5 * (EDGE - 1) / 2 * spacing  # from the centre of a cube to its corners
    for some in chunks_of(len(cubes), EDGE**3):
        centres = (cubes[some] + (EDGE - 1) / 2) * spacing + origin
        away, side = solid.distance(centres), np.where(solid.is_inside(centres), -1.0, 1.0)
        crossed = (away <= half * (1 + 1e-9)) | (solid.unbalanced_edges > 0)
        found = np.repeat(side[:, None] * limit, EDGE**3, axis=1)
        near = ~crossed & (away <= limit + half)
        for chosen, measure in ((near, solid.distance), (crossed, solid.signed_distance)):
            points = ((cubes[some][chosen, None] + within_cube) * spacing + origin).reshape(-1, 3)
            found[chosen] = measure(points).reshape(-1, EDGE**3)
        found[near] *= side[near, None]
        values[some] = found.clip(-limit, limit)
        if progress:
            progress(min(some.stop, len(cubes)), len(cubes))
    cut = values.reshape(*counts, EDGE, EDGE, EDGE).transpose(0, 3, 1, 4, 2, 5)
    whole = cut.reshape([n * EDGE for n in counts])[tuple(map(slice, shape))]
    notes = [f"distances are exact up to {band:g} voxels and clamped there"] * (band < np.inf)
    return SdfGrid.trusted(whole, spacing, origin, tuple(notes))
