"""Samples of a function near its surface, coarse to fine.

Cells of 8^3 spacings are asked first, then their eighths. A cell is left out if even the steepest
slope seen would not bring the values at its corners down to those of ``reach`` within it (Kalra and
Barr, "Guaranteed ray intersections with implicit surfaces", 1989).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import combinations
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import CORNERS, FloatArray

STRIDE = 8  # spacings along the largest cells of a function; a power of two
AT_ONCE = 1 << 18  # samples
STEEPER = 1.25  # than seen between samples may the function be

At: TypeAlias = Callable[[NDArray[Any]], NDArray[Any]]
Cells: TypeAlias = NDArray[np.int32]  # (n, 3) the lowest sample of each


def sample_near(
    at: At, shape: tuple[int, ...], step: NDArray[Any], reach: float
) -> tuple[FloatArray, float]:
    """Return the samples of a function near its surface, and its value at ``reach`` from there.

    What was left out is infinite, with its sign.

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
        steepest = max(steepest, _steepest(values, sizes * step))
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
    places = np.flatnonzero(wanted & np.isnan(samples))
    for first in range(0, len(places), AT_ONCE):
        some = places[first : first + AT_ONCE]
        samples.reshape(-1)[some] = at(np.stack(np.unravel_index(some, samples.shape), 1))


def _steepest(values: NDArray[Any], sizes: NDArray[Any]) -> float:
    """Return the largest slope between two corners of a cell, from values (n, 8), sizes (n, 3)."""
    steepest = 0.0
    for one, other in combinations(range(8), 2):
        length = np.linalg.norm((CORNERS[one] - CORNERS[other]) * sizes, axis=1)
        with np.errstate(invalid="ignore"):  # between corners that were left out
            slopes = np.abs(values[:, one] - values[:, other]) / length
        steepest = max(steepest, float(slopes[np.isfinite(slopes)].max(initial=0)))
    return steepest
