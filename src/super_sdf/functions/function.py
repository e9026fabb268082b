"""Signed distances by a function of points, and its samples on a lattice.

>>> from super_sdf import reconstruct
>>> mesh = reconstruct(function=f, bounds=(-1, 1), spacing=0.05)   # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from numbers import Real
from typing import Any, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import CORNERS, FloatArray, without_device
from ..errors import GridError, OptionError, OptionTypeError, seen
from ..grid.interpret import ORDINARY
from ..grid.samples import as_triple, check_spacing
from ..grid.sdf_grid import SdfGrid, check_grid, make_grid

Points = NDArray[np.float64]  # (n, 3)
Numbers = NDArray[np.float64]  # (n,)

BATCH = 1 << 18  # points of a call at most
MOST_SAMPLES = 1 << 31
REACH = 4  # spacings from the surface: the network sees samples that are 3.2 off
STRIDE = 8  # spacings along the largest cells of a function; a power of two
STEEPER = 1.25  # than seen between samples may the function be

At: TypeAlias = Callable[[NDArray[Any]], NDArray[Any]]
Cells: TypeAlias = NDArray[np.int32]  # (n, 3) the lowest sample of each


class DistanceFunction:
    """Signed distances by a function of points, called in batches.

    Parameters
    ----------
    function : callable
        Takes world positions, (n, 3) float64, and returns n distances, (n,) or (n, 1): an array, or
        a tensor of PyTorch or JAX on any device, with or without gradients. Any continuous
        function that is 0 on the surface will do; it may be positive inside. If it is much steeper
        near a part of the surface than elsewhere, sample it with an infinite ``reach``.

    Attributes
    ----------
    evaluations : int
        At how many points it was evaluated so far.

    Raises
    ------
    OptionTypeError
        If it is not callable; in a call, if it does not return one number for each point.
    """

    def __init__(self, function: Callable[[Points], Any]) -> None:
        if not callable(function):
            raise OptionTypeError(f"function is {seen(function)}: give a function of points (n, 3)")
        self.function, self.evaluations = function, 0

    def __call__(self, points: Points) -> Numbers:
        """Return the distances at points (n, 3), (n,)."""
        found = [np.zeros(0)]
        for start in range(0, len(points), BATCH):
            batch = points[start : start + BATCH]
            self.evaluations += len(batch)
            values = as_numbers(self.function(batch))
            if values.size != len(batch):
                raise OptionTypeError(
                    f"the function returns an array of shape {values.shape} for {len(batch)} "
                    "points: return one number for each"
                )
            found.append(values.reshape(-1))
        return np.concatenate(found)

    def sample(self, bounds: ArrayLike, spacing: ArrayLike, reach: float | None = None) -> SdfGrid:
        """Return the samples on a lattice that covers a box. The surface is where they are 0.

        Coarse cells are asked first, so that far from the surface few points are.

        Parameters
        ----------
        bounds : two numbers, or two points
            The lowest and the highest coordinates of the box; the first sample is at the lowest.
            The solid should end a few spacings inside.
        spacing : number or three
            World distance between neighbouring samples.
        reach : float, optional
            World distance from the surface at which samples are cut off, by default 4 spacings;
            infinite for all as they are.

        Raises
        ------
        OptionError
            If the box is empty, or takes more than 2^31 samples.
        GridError
            If no sample is inside, or none is outside; else as in ``make_grid``.
        """
        low, high = corners_of(bounds)
        step = np.array(check_spacing(spacing))
        shape = np.ceil((high - low) / step - 1e-9).astype(np.int64) + 1
        if np.prod(shape.astype(float)) > MOST_SAMPLES:
            raise OptionError(f"spacing is {seen(spacing)}: the box takes more than 2^31 samples")
        reach = REACH * float(step.max()) if reach is None else reach
        if not isinstance(reach, Real) or not reach > 0:
            raise OptionError(f"reach is {seen(reach)}: give a number greater than 0, or infinity")

        corners = self(low + step * (np.array(shape) - 1) * CORNERS)
        largest = np.abs(corners[np.isfinite(corners)]).max(initial=0)
        scale = largest if largest and not ORDINARY[0] < largest < ORDINARY[1] else 1.0

        def at(indices: NDArray[Any]) -> Numbers:
            """Return the values at samples (n, 3) of the lattice, in numbers of usual size."""
            return self(low + step * indices) / scale

        samples, cut = sample_near(at, tuple(shape), step, float(reach))
        if not ((samples < 0).any() and (samples > 0).any()):  # it may be steeper than seen
            samples, cut = sample_near(at, tuple(shape), step, np.inf)
        known = samples[np.isfinite(samples)]
        if not len(known):
            raise GridError("the function has no finite value at any sample: give other bounds")
        least, most = known.min() * scale, known.max() * scale
        if not least < 0 < most:
            raise GridError(
                f"the function goes from {least:.6g} to {most:.6g} at {len(known):,} samples, and "
                "its surface is where it is 0: subtract a level, or give a finer spacing or other "
                "bounds"
            )
        np.clip(samples, -cut, cut, out=samples)
        make = partial(make_grid, samples, spacing=spacing, origin=low)
        try:
            return make()
        except GridError:  # the spacing is right: what contradicts it is no distance
            with suppress(GridError):
                return make(field="smooth")
            raise


Function: TypeAlias = DistanceFunction | Callable[[Points], Any]
"""A function of points; one that counts what it is asked, or any other."""


def as_function(function: Function) -> DistanceFunction:
    """Return a function that counts at how many points it is evaluated."""
    return function if isinstance(function, DistanceFunction) else DistanceFunction(function)


def sampled(
    grid: SdfGrid | None,
    function: DistanceFunction | None,
    bounds: ArrayLike | None,
    spacing: ArrayLike | None,
    offset: float,
) -> SdfGrid:
    """Return the grid, or samples of the function as far as an offset needs if there is none.

    OptionError unless either a grid is given, or a function with bounds and spacing.
    """
    if grid is not None or function is None:
        if bounds is not None or spacing is not None:
            raise OptionError("bounds and spacing are for a function without a grid: give that")
        return check_grid(grid)
    if bounds is None or spacing is None:
        raise OptionError("a function needs bounds and spacing, or a grid of its samples")
    reach = REACH * max(check_spacing(spacing)) + abs(offset)
    return function.sample(bounds, spacing, reach)


def corners_of(bounds: ArrayLike) -> tuple[Points, Points]:
    """Return the lowest and highest corners, (3,) each, of bounds; OptionError if there is none."""
    try:
        low, high = cast("Iterable[Any]", bounds)
        corners = [np.array(as_triple(corner, "bounds")) for corner in (low, high)]
    except (TypeError, ValueError, GridError):
        raise OptionError(
            f"bounds are {seen(bounds)}: give (lowest, highest), numbers or points"
        ) from None
    if not (corners[0] < corners[1]).all():
        raise OptionError(f"bounds are {seen(bounds)}: the box is empty, give (lowest, highest)")
    return corners[0], corners[1]


def as_numbers(values: Any) -> Numbers:
    """Return an array or a tensor of any library as float64."""
    try:
        array = np.asanyarray(without_device(values))
        if array.dtype.kind not in "fiub" and array.dtype.name != "bfloat16":  # None is no NaN
            raise TypeError
        if hasattr(array, "mask"):  # what is masked is unknown
            array = np.ma.filled(array.astype(np.float64), np.nan)
        return np.asarray(array, np.float64)
    except (TypeError, ValueError):
        raise OptionTypeError(f"the function returns {seen(values)}: return numbers") from None


def sample_near(
    at: At, shape: tuple[int, ...], step: NDArray[Any], reach: float
) -> tuple[FloatArray, float]:
    """Return the samples of a function near its surface, and its value at ``reach`` from there.

    Cells of 8^3 spacings are asked first, then their eighths. A cell is left out, infinite with its
    sign, if even the steepest slope seen would not bring the values at its corners down to those of
    ``reach`` within it (Kalra and Barr, "Guaranteed ray intersections with implicit surfaces",
    1989).

    Parameters
    ----------
    at : callable
        Takes indices of samples, (n, 3), and returns the values there, (n,).
    shape : three int
        Samples along each axis.
    step : array, (3,)
        World distance between neighbouring samples along each axis.
    reach : float
        World distance from the surface; infinite for all samples.
    """
    samples = np.full(shape, np.nan, np.float32)
    last = np.array(shape, np.int32) - 1
    cells = (STRIDE * np.argwhere(np.ones(-(-last // STRIDE), bool))).astype(np.int32)
    stride, steepest = STRIDE, _steepest_at(samples, at, cells, step)
    while len(cells):
        sizes = np.minimum(stride, last - cells)  # on the border cells are smaller
        _evaluate(samples, at, (cells + sizes * corner for corner in CORNERS))
        if stride == 1:
            break
        corners = [cells + sizes * corner for corner in CORNERS]
        values = np.stack([samples[tuple(corner.T)] for corner in corners], 1)
        rises = [np.diff(values.reshape(-1, 2, 2, 2), axis=axis) for axis in (1, 2, 3)]
        rise = np.stack([np.abs(each).max((1, 2, 3)) for each in rises], 1) / (sizes * step)
        slopes = np.sqrt((rise**2).sum(1))  # along each edge of a cell, and so in any direction
        steepest = max(steepest, float(slopes[np.isfinite(slopes)].max(initial=0)))
        least = STEEPER * steepest * (reach + stride / 2 * float(np.linalg.norm(step)))
        far = np.abs(values).min(1) > least  # not where a value is unknown
        for offset in np.ndindex((stride + 1,) * 3):  # what is far from the surface gets its side
            places = np.minimum(cells[far] + np.array(offset, np.int32), last)
            new = np.isnan(samples[tuple(places.T)])
            samples[tuple(places[new].T)] = np.copysign(np.inf, values[far, 0])[new]
        stride //= 2
        cells = (cells[~far, None] + stride * CORNERS).reshape(-1, 3)
        cells = cells[(cells < last).all(1)]
    return samples, steepest * reach if steepest else np.inf


def _steepest_at(samples: FloatArray, at: At, cells: Cells, step: NDArray[Any]) -> float:
    """Return the largest slope at the lowest samples of cells, by their neighbours on either side.

    Of the two slopes of a sample the lesser counts: beside a kink the other one is too large.
    """
    last, axes = np.array(samples.shape, np.int32) - 1, np.eye(3, dtype=np.int32)
    sides = [[np.clip(cells + side * axis, 0, last) for axis in axes] for side in (-1, 1)]
    _evaluate(samples, at, [cells, *sides[0], *sides[1]])
    rises = [[samples[tuple(c.T)] - samples[tuple(cells.T)] for c in side] for side in sides]
    with np.errstate(invalid="ignore"):
        slopes = [np.linalg.norm(np.stack(rise, 1) / step, axis=1) for rise in rises]
    on_border = ((cells == 0) | (cells == last)).any(1)  # has no neighbour on one side
    slope = np.where(on_border, np.maximum(*slopes), np.minimum(*slopes))
    return float(slope[np.isfinite(slope)].max(initial=0))


def _evaluate(samples: FloatArray, at: At, corners: Iterable[NDArray[Any]]) -> None:
    """Fill in the samples at corners that are not known yet."""
    wanted = np.zeros(samples.shape, bool)
    for corner in corners:
        wanted[tuple(corner.T)] = True
    places = np.argwhere(wanted & np.isnan(samples))
    for start in range(0, len(places), BATCH):
        some = places[start : start + BATCH]
        samples[tuple(some.T)] = at(some)
