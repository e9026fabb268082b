"""Gradients of a field, from which the spacing is estimated.

Where a distance field is smooth its gradient has length 1 in world units, so its length in index
units is the spacing. Next to the surface of a thin part no sample is smooth, so samples away from
the surface count as well; but only those next to it tell how a field that is no distance changes
there.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray
from ..errors import GridError
from .planes import SampleArray, few_of, lowest, over_planes, ranks_of, spread_planes

# Values are clamped to this, so that squares of their differences do not overflow.
LARGEST_VALUE = 1e150
ENOUGH = 30  # least number of samples for an estimate
STRAIGHT = 0.3  # largest bend (see surface_gradients) of a field that is nearly linear
BENT = 0.6  # larger bends: lengths may agree by chance, as for the distance to a mask
# Gradients are consistent if nine in ten of the straightest ones agree within 5 %.
AGREEING, AGREEMENT = 0.9, 0.05
UNEQUAL = 1.3  # ratio of the spacings measured along two axes from which they differ
PLANES_AT_FIRST = 64  # read of a large grid, unless too few samples are found there
MOST_BESIDE = 1 << 18  # samples beside the surface of which gradients are taken
MOST_SAMPLES = 1 << 19  # of which gradients are taken, wherever they lie; all of them up to 80^3

Gradients = tuple[NDArray[np.float64], NDArray[np.float64]]


def surface_gradients(values: SampleArray) -> Gradients:
    """Return gradients and bends of the field at samples next to the surface.

    At most 64 planes are read, spread evenly along x, unless they show too little of the surface.
    Of more than ``MOST_BESIDE`` samples, some are taken, spread evenly.

    Parameters
    ----------
    values : (nx, ny, nz) array or Planes
        Samples; positive on one side of the surface.

    Returns
    -------
    gradients : (n, 3) float64
        Central differences, in index units.
    bend : (n,) float64
        Sum of the absolute second differences over the length of the gradient: 0 for a linear
        field.
    """
    gradients, bend = _gradients_in_planes(
        values, spread_planes(0, len(values) - 1, PLANES_AT_FIRST)
    )
    if (bend < STRAIGHT).sum() < ENOUGH and len(values) > PLANES_AT_FIRST:
        return _gradients_in_planes(values, list(range(len(values))))
    return gradients, bend


def _gradients_in_planes(values: SampleArray, planes: list[int]) -> Gradients:
    """Return gradients and bends at samples next to the surface in some planes."""
    plane = values.shape[1] * values.shape[2]
    ranges = [(max(i - 1, 0), min(i + 2, len(values)), min(i, 1), i * plane) for i in planes]
    gradients, bend = few_of(over_planes(values, _plane_gradients, ranges), MOST_BESIDE)
    return gradients, bend


def straight_gradients(values: SampleArray) -> Gradients:
    """Return gradients and bends at samples anywhere in the grid at which the field is not bent.

    Where the values are constant, as those of a truncated field are, there is no gradient. Of large
    grids, 64 planes are read, and fewer rows of them.

    Returns
    -------
    gradients, bend
        As of ``surface_gradients``.
    """
    nx, ny, nz = values.shape
    if min(nx, ny, nz) < 3:
        return np.empty((0, 3)), np.empty(0)
    planes = [i for i in spread_planes(0, nx - 1, PLANES_AT_FIRST) if 0 < i < nx - 1] or [1]
    step = -(-len(planes) * ny * nz // MOST_SAMPLES)
    ranges = [(i - 1, i + 2, step) for i in planes]
    found = over_planes(values, _row_gradients, ranges)
    gradients, bend = (np.concatenate(parts) for parts in zip(*found))
    return gradients, bend


def _row_gradients(slab: NDArray[Any], step: int) -> Gradients:
    """Return gradients (n, 3) and bends (n,) of every ``step``-th inner row of the middle plane."""
    inner = slice(1, -1, step), slice(1, -1)
    above = slab[2][inner], slab[1, 2::step, 1:-1], slab[1, 1:-1:step, 2:]
    below = slab[0][inner], slab[1, :-2:step, 1:-1], slab[1, 1:-1:step, :-2]
    centre, *sides = (_as_float(samples) for samples in (slab[1][inner], *above, *below))
    pairs = list(zip(sides[:3], sides[3:]))
    gradient = np.stack([(high - low) / 2 for high, low in pairs], -1).reshape(-1, 3)
    change = sum(np.abs(high - 2 * centre + low) for high, low in pairs)
    relative = _relative_bend(np.ravel(change), lengths(gradient))
    straight = relative <= BENT
    return gradient[straight], relative[straight]


def _relative_bend(change: NDArray[np.float64], length: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the bend: infinite where opposite neighbours are equal, or nearly."""
    relative = np.full(len(length), np.inf)
    np.divide(change, length, out=relative, where=length > 1e-9 * change)
    return relative


def _plane_gradients(
    slab: NDArray[Any], middle: int, number: int
) -> tuple[NDArray[np.uint64], NDArray[np.float64], NDArray[np.float64]]:
    """Return ranks, gradients (n, 3) and bends (n,) at samples next to the surface in a plane.

    The slab has the planes beside it, too. ``number`` is that of the plane's first sample.
    """
    slab = np.asarray(slab)
    beside = np.flatnonzero(_beside_surface(slab <= 0, middle))
    ranks = ranks_of(beside + number)
    some = lowest(ranks, MOST_BESIDE)
    at = [np.full(1, middle), *np.unravel_index(beside[some], slab.shape[1:])]
    centre = _read(slab, at)
    gradient, change = np.empty((len(centre), 3)), np.zeros(len(centre))
    for axis in range(3):
        low, high = (list(at), list(at))
        low[axis] = np.maximum(at[axis] - 1, 0)
        high[axis] = np.minimum(at[axis] + 1, slab.shape[axis] - 1)
        below, above, steps = _read(slab, low), _read(slab, high), high[axis] - low[axis]
        gradient[:, axis] = (above - below) / steps
        change += np.where(steps == 2, np.abs(above - 2 * centre + below), 0)
    return ranks[some], gradient, _relative_bend(change, lengths(gradient))


def _beside_surface(inside: BoolArray, middle: int) -> BoolArray:
    """Return which samples of a plane have a neighbour along an axis on the other side."""
    plane = inside[middle]
    beside = np.zeros(plane.shape, bool)
    for other in (*inside[:middle], *inside[middle + 1 :]):
        beside |= plane != other
    for axis in range(2):
        samples, marks = np.moveaxis(plane, axis, 0), np.moveaxis(beside, axis, 0)
        crossed = samples[1:] != samples[:-1]
        marks[1:] |= crossed
        marks[:-1] |= crossed
    return beside


def _read(slab: NDArray[Any], at: list[NDArray[np.intp]]) -> NDArray[np.float64]:
    """Return samples at some indices, clamped to ``LARGEST_VALUE``."""
    return _as_float(slab[tuple(at)])


def _as_float(samples: NDArray[Any]) -> NDArray[np.float64]:
    """Return samples clamped to ``LARGEST_VALUE``."""
    return np.clip(samples.astype(np.float64), -LARGEST_VALUE, LARGEST_VALUE)


def typical_length(gradients: NDArray[np.float64], bend: NDArray[np.float64]) -> float:
    """Return the half-sample mode of the lengths of gradients (n, 3), at the straighter samples.

    Raises
    ------
    GridError
        If there is no gradient.

    References
    ----------
    Bickel and Frühwirth, "On a fast, robust estimator of the mode", 2006.
    """
    if not len(gradients):
        raise GridError("the values show no spacing, since they are smooth nowhere: give --spacing")
    length: NDArray[np.float64] = np.sort(lengths(gradients[_straighter(bend)]))
    while len(length) > 2:
        half = (len(length) + 1) // 2
        width = length[half - 1 :] - length[: len(length) - half + 1]
        start = int(width.argmin())
        length = length[start : start + half]
    return float(length.mean())


def lengths(gradients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lengths, (n,), of gradients (n, 3)."""
    length: NDArray[np.float64] = np.sqrt((gradients**2).sum(1))
    return length


def _straighter(bend: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask, (n,), of the samples in the less bent half of the field.

    If enough samples are below ``STRAIGHT``, only those are kept. Thin walls, edges and noise bend
    the field, and make its gradient too short or too long.
    """
    limit = float(np.median(bend))
    if (bend < STRAIGHT).sum() >= ENOUGH:
        limit = min(limit, STRAIGHT)
    return bend <= limit


def are_consistent(
    measured: float, gradients: NDArray[np.float64], bend: NDArray[np.float64]
) -> bool:
    """Return whether the lengths at the straighter samples agree with the measured spacing."""
    if len(bend) < ENOUGH:
        return False
    length = lengths(gradients[_straighter(bend) & (bend <= BENT)])
    agreeing = np.abs(length - measured) <= AGREEMENT * measured
    return len(length) >= ENOUGH and bool(agreeing.mean() >= AGREEING)


def unequal_axes(gradients: NDArray[np.float64], bend: NDArray[np.float64]) -> dict[str, float]:
    """Return the spacing that the gradients along each axis show; empty unless they differ."""
    length = lengths(gradients)
    found: dict[str, float] = {}
    for axis, name in enumerate("xyz"):
        along = (np.abs(gradients[:, axis]) > 0.95 * length) & (bend < STRAIGHT)
        if along.sum() >= ENOUGH:
            found[name] = typical_length(gradients[along], bend[along])
    if found and max(found.values()) > UNEQUAL * min(found.values()):
        return found
    return {}


def spacing_of_axes(
    gradients: NDArray[np.float64], bend: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Return the spacings (3,) with which most gradients (n, 3) have length 1; None if none have.

    (g_x / h_x)^2 + (g_y / h_y)^2 + (g_z / h_z)^2 = 1 is linear in 1 / h^2. It is solved for the
    straight gradients, in the mean, then again and again for those that agree better and better.
    """
    squares = gradients[bend <= BENT] ** 2
    agreeing = np.ones(len(squares), bool)
    for tolerance in (0.5, 0.3, 0.2, 0.1, AGREEMENT, AGREEMENT):
        if agreeing.sum() < ENOUGH:
            return None
        inverse, _, rank, _ = np.linalg.lstsq(squares[agreeing], np.ones(agreeing.sum()), 1e-6)
        if rank < 3 or inverse.min() <= 0:
            return None
        agreeing = np.abs(np.sqrt(squares @ inverse) - 1) <= tolerance
    spacings: NDArray[np.float64] = 1 / np.sqrt(inverse)
    return spacings if agreeing.mean() >= AGREEING else None
