"""Signed distances by a function of points, and its samples on a lattice."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from numbers import Real
from typing import Any, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import CORNERS, FloatArray, IntArray, Numbers, Vectors, without_device
from ..errors import GridError, OptionError, OptionTypeError, seen
from ..grid.interpret import ORDINARY
from ..grid.samples import as_triple, check_spacing
from ..grid.sdf_grid import SdfGrid, as_grid, make_grid

BATCH = 1 << 18  # points of a call at most
MOST_SAMPLES = 1 << 31
REACH = 4  # spacings from the surface: the network sees samples that are 3.2 off
STRIDES = (8, 4, 2)  # spacings along the cells of a function, from the largest
STEEPER = 1.25  # than seen between samples may the function be

At: TypeAlias = Callable[[NDArray[Any]], Numbers]
"""Takes indices of samples, (n, 3), and returns the values there, (n,)."""


class DistanceFunction:
    """Signed distances by a function of points, called in batches.

    Parameters
    ----------
    function : callable or torch.nn.Module
        Takes world positions, (n, 3) float64, and returns n distances, (n,) or (n, 1): an array, or
        a tensor of PyTorch or JAX on any device, with or without gradients. A module is given a
        tensor of the type and on the device of its parameters, and makes no gradients. Any
        continuous function that is 0 on the surface is accepted, also positive inside. If it is
        much steeper near a part of the surface than elsewhere, sample with an infinite ``reach``.

    Attributes
    ----------
    evaluations : int
        Number of points at which the function has been evaluated.

    Raises
    ------
    OptionTypeError
        If ``function`` is not callable; in a call, if it does not return one number per point.
    """

    def __init__(self, function: Callable[[Vectors], Any]) -> None:
        if not callable(function):
            raise OptionTypeError(f"function is {seen(function)}: give a function of points (n, 3)")
        torch: Any = sys.modules.get("torch")  # whoever has a module has imported it
        if torch and isinstance(function, torch.nn.Module):
            function = of_module(function, torch)
        self.function, self.evaluations = function, 0

    def __call__(self, points: Vectors) -> Numbers:
        """Return the distances at points (n, 3), (n,)."""
        found = [np.zeros(0)]
        for start in range(0, len(points), BATCH):
            batch = points[start : start + BATCH]
            self.evaluations += len(batch)
            values = self.function(batch)
            try:
                array = np.asanyarray(without_device(values))
                if array.dtype.kind not in "fiub" and array.dtype.name != "bfloat16":
                    raise TypeError  # float64 would take None for NaN
                array = np.ma.filled(array.astype(np.float64), np.nan)  # what is masked is unknown
                found.append(array.reshape(len(batch)))
            except (TypeError, ValueError):
                shape = tuple(getattr(values, "shape", ()))
                said = f"an array of shape {shape}" if shape else seen(values)
                said += f" for {len(batch)} points: return a real number for each"
                raise OptionTypeError(f"the function returns {said}") from None
        return np.concatenate(found)

    def sample(self, bounds: ArrayLike, spacing: ArrayLike, reach: float | None = None) -> SdfGrid:
        """Return samples on a lattice that covers a box, as a grid.

        Coarse cells are evaluated first, so that few points far from the surface are.

        Parameters
        ----------
        bounds : two numbers, or two points
            The lowest and the highest coordinates of the box; the first sample is at the lowest.
            The solid should stay a few spacings away from the border of the box.
        spacing : number or three
            World distance between neighbouring samples.
        reach : float, optional
            World distance from the surface beyond which samples are truncated, by default 4
            spacings; infinite for no truncation.

        Raises
        ------
        OptionError
            If the box is empty, or has more than 2^31 samples.
        GridError
            If no sample is inside, or none is outside; else as in ``make_grid``.
        """
        try:
            low, high = (np.array(as_triple(corner, "bounds")) for corner in cast(Any, bounds))
            if not (low < high).all():
                raise ValueError
        except (TypeError, ValueError):
            give = "(lowest, highest), numbers or points, of a box that is not empty"
            raise OptionError(f"bounds are {seen(bounds)}: give {give}") from None
        step = np.array(check_spacing(spacing))
        shape = np.ceil((high - low) / step - 1e-9) + 1
        if np.prod(shape) > MOST_SAMPLES:
            raise OptionError(f"spacing is {seen(spacing)}: the box takes more than 2^31 samples")
        reach = REACH * float(step.max()) if reach is None else reach
        if not isinstance(reach, Real) or not reach > 0:
            raise OptionError(f"reach is {seen(reach)}: give a number greater than 0, or infinity")
        corners = self(low + step * (shape - 1) * CORNERS)
        largest = np.abs(corners[np.isfinite(corners)]).max(initial=0)
        scale = largest if largest and not ORDINARY[0] < largest < ORDINARY[1] else 1.0

        def at(indices: NDArray[Any]) -> Numbers:
            return self(low + step * indices) / scale  # numbers of usual size

        for distance in (float(reach), np.inf):  # the function may be steeper than seen
            samples, cut = sample_near(at, shape.astype(np.int32), step, distance)
            if (samples < 0).any() and (samples > 0).any():
                break
        known = samples[np.isfinite(samples)]
        if not len(known):
            raise GridError("the function has no finite value at any sample: give other bounds")
        least, most = known.min() * scale, known.max() * scale
        if not least < 0 < most:
            goes = f"goes from {least:.6g} to {most:.6g}" if least < most else f"is {least:.6g}"
            raise GridError(
                f"the function {goes} at all {len(known):,} samples, and its surface is where it "
                "is 0: subtract a level, or give a finer spacing or other bounds"
            )
        np.clip(samples, -cut, cut, out=samples)
        try:
            return make_grid(samples, spacing=spacing, origin=low)
        except GridError:  # the spacing is right: what contradicts it is no distance
            with suppress(GridError):
                return make_grid(samples, spacing=spacing, origin=low, field="smooth")
            raise


def of_module(module: Any, torch: Any) -> Callable[[Vectors], Any]:
    """Return a module of PyTorch as a function of arrays, on its device, without gradients."""
    like = next(module.parameters(), torch.empty(0))  # float32, on the CPU

    def function(points: Vectors) -> Any:
        with torch.no_grad():
            return module(torch.as_tensor(points, dtype=like.dtype, device=like.device))

    return function


def sampled(grid: Any, function: Any, bounds: Any, told: dict[str, Any], offset: float) -> SdfGrid:
    """Return the samples that an offset needs of a function in bounds, at the ``told`` spacing."""
    if grid is not None or function is None:
        raise OptionError("bounds are those of a function's samples: give function, and no grid")
    exact, spacing = DistanceFunction(function), told.pop("spacing")  # checks it
    if bounds is None or spacing is None:
        raise OptionError("a function needs bounds and spacing, or a grid of its samples")
    reach = REACH * max(check_spacing(spacing)) + abs(offset)
    return as_grid(exact.sample(bounds, spacing, reach), **told)


def sample_near(at: At, shape: IntArray, step: Numbers, reach: float) -> tuple[FloatArray, float]:
    """Return the samples of a function near its surface, and its value at ``reach`` from there.

    Cells of 8^3 spacings are asked first, then their eighths. A cell is left out, infinite with its
    sign, if even the steepest slope seen would not bring the values at its corners down to those of
    ``reach`` within it (Kalra and Barr, "Guaranteed ray intersections with implicit surfaces",
    1989).
    """
    samples, last, steepest = np.full(shape, np.nan, np.float32), shape - 1, 0.0
    cells = (STRIDES[0] * np.argwhere(np.ones(-(-last // STRIDES[0]), bool))).astype(np.int32)
    for stride in STRIDES:
        sizes = np.minimum(stride, last - cells)  # on the border cells are smaller
        corners = [cells + sizes * corner for corner in CORNERS]
        _evaluate(samples, at, corners)
        values = np.stack([samples[tuple(corner.T)] for corner in corners], 1)
        with np.errstate(invalid="ignore"):  # between samples that were left out
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
        cells = (cells[~far, None] + stride // 2 * CORNERS).reshape(-1, 3)
        cells = cells[(cells < last).all(1)]
    _evaluate(samples, at, (cells + corner for corner in CORNERS))
    return samples, steepest * reach if steepest else np.inf


def _evaluate(samples: FloatArray, at: At, corners: Iterable[NDArray[Any]]) -> None:
    """Fill in the samples at corners that are not known yet."""
    wanted = np.zeros(samples.shape, bool)
    for corner in corners:
        wanted[tuple(corner.T)] = True
    places = np.argwhere(wanted & np.isnan(samples))
    for start in range(0, len(places), BATCH):
        some = places[start : start + BATCH]
        samples[tuple(some.T)] = at(some)
