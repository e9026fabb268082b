"""Marching cubes with the parameters and results of scikit-image's: one import changes a script.

>>> from super_sdf import marching_cubes  # in place of skimage.measure
>>> vertices, faces, normals, values = marching_cubes(volume, 0)         # doctest: +SKIP
"""

from __future__ import annotations

import warnings
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import SdfGrid, make_grid, reconstruct
from ..arrays import CORNERS, FloatArray, IntArray, Triple
from ..errors import GridError, OptionError, SuperSdfWarning, seen
from ..grid.samples import as_samples, check_spacing
from ..options import ANY, one_of
from .zero import normals_at

if TYPE_CHECKING:
    from ..network.contract import Decoder

Way = Literal["descent", "ascent"]
Method = Literal["lewiner", "lorensen"]


def marching_cubes(
    volume: ArrayLike,
    level: float | None = None,
    *,
    spacing: ArrayLike = (1.0, 1.0, 1.0),
    gradient_direction: Way = "descent",
    step_size: int = 1,
    allow_degenerate: bool = True,
    method: Method = "lewiner",
    mask: None = None,
    factor: int | None = None,
    network: Decoder | None = None,
) -> tuple[FloatArray, IntArray, FloatArray, FloatArray]:
    """Return the refined surface of a volume, as ``skimage.measure.marching_cubes`` does.

    Parameters
    ----------
    volume : (nx, ny, nz) array_like
        Distances, in any unit, a mask, or another field; see ``make_grid``.
    level : float, optional
        The value on the surface. Default: half-way between the smallest and the largest value.
    spacing : number or three
        Distance between samples along each axis. Sample (0, 0, 0) is at 0, 0, 0.
    gradient_direction : {"descent", "ascent"}
        "descent": triangles are counter-clockwise seen from larger values, as in scikit-image.
    step_size, mask
        Must be 1 and None.
    method, allow_degenerate
        No effect: no triangle is degenerate.
    factor, network
        As in ``reconstruct``.

    Returns
    -------
    vertices : (n, 3) float32
        Positions, ``spacing`` times the index of a sample; open where the surface leaves the grid.
    faces : (m, 3) int32
        Indices of the corners of triangles.
    normals : (n, 3) float32
        Unit vectors, towards smaller values.
    values : (n,) float32
        The range of the eight samples round each vertex.

    Raises
    ------
    OptionError
        If the level is not within the values, or an argument is not as above.
    """
    one_of(Way).check(gradient_direction, "gradient_direction")
    one_of(Method).check(method, "method")
    if mask is not None or step_size != 1:
        given = f"step_size is {seen(step_size)}" if mask is None else "mask is given"
        raise OptionError(f"{given}: all samples are refined, leave it out")
    samples = np.asarray(as_samples(volume))
    samples = samples.astype(np.promote_types(samples.dtype, np.float32))
    known = samples[np.isfinite(samples)]
    low, high = float(known.min(initial=np.inf)), float(known.max(initial=-np.inf))
    level = (low + high) / 2 if level is None else ANY.check(level, "level")
    if not low <= level <= high:
        raise OptionError(f"level is {level:g}: give one within the values, {low:g} to {high:g}")
    samples -= level
    grid = _grid_of(samples, steps := check_spacing(spacing))
    with warnings.catch_warnings():  # scikit-image has none
        warnings.simplefilter("ignore", SuperSdfWarning)
        mesh = reconstruct(grid, network, factor, cap=False)
    places = grid.to_index(mesh.vertices)
    cell = np.clip(np.floor(places).astype(int), 0, np.array(samples.shape) - 2)
    corners = np.stack([samples[tuple((cell + corner).T)] for corner in CORNERS])
    one = np.unravel_index(int(np.nanargmax(np.abs(samples))), samples.shape)
    is_above = bool(samples[one] > 0) == bool(grid.values[one] < 0)  # whether that is inside
    outward = normals_at(places * steps, mesh.faces)
    turned = is_above == (gradient_direction == "descent")
    return (
        (places * steps).astype(np.float32),
        np.ascontiguousarray(mesh.faces[:, ::-1] if turned else mesh.faces),
        (outward if is_above else -outward).astype(np.float32),
        np.ptp(corners, axis=0).astype(np.float32),
    )


def _grid_of(samples: NDArray[Any], spacing: Triple) -> SdfGrid:
    """Return a grid of samples, 0 on the surface: of distances in the unit of the spacing if so."""
    with suppress(GridError):
        return make_grid(samples, spacing=spacing)
    with suppress(GridError):  # distances in another unit, from which the spacing is known
        return make_grid(samples)
    return make_grid(samples, spacing=spacing, field="smooth")
