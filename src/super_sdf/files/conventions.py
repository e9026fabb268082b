"""What an array says of itself: which sign is inside, and how far apart the samples are.

A distance field says both. The border of a grid is outside; and wherever the field is smooth its
gradient has length 1, so its change from sample to sample, near the surface, is the spacing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import GridError, OptionError
from ..grid import SdfGrid, Triple, check_spacing, check_values
from ..planes import Samples

INSIDE = ("auto", "negative", "positive")
SNAP = 0.02  # an estimate this near to a usual spacing is taken for it
TOLERATED, REFUSED = 1.1, 2.0  # ratio of measured to given spacing: noted beyond, refused beyond
UNEQUAL = 1.3  # ratio of the spacings along two axes that the values themselves show
ENOUGH = 30  # samples for a statement
STRAIGHT = 0.3  # bend (see surface_gradients) below which a field is linear enough to measure


def make_grid(
    values: Samples,
    *,
    spacing: Any = None,
    origin: Any = None,
    inside: str = "auto",
    level: float = 0.0,
) -> SdfGrid:
    """Make a grid from an array of signed distances, inferring what is not given.

    Parameters
    ----------
    values : (nx, ny, nz) array
        Signed distances.
    spacing : number or three, optional
        World distance between samples; estimated from the gradient if not given.
    origin : three numbers, optional
        World position of sample (0, 0, 0); the world's origin if not given.
    inside : {"auto", "negative", "positive"}
        The sign of samples inside the solid; "auto" takes the border of the grid for outside.
    level : float
        The surface is where ``values == level``, after the sign was made negative inside.

    Returns
    -------
    SdfGrid
        Negative inside; ``notes`` says what was inferred.

    Raises
    ------
    GridError
        If the values are no signed distances, or contradict the spacing.
    """
    extremes = check_values(values)
    check_not_flat(values, extremes)
    notes: list[str] = []
    flipped = _is_positive_inside(values, inside, level, extremes, notes)
    chosen = _choose_spacing(values, -level if flipped else level, spacing, notes)
    if origin is None:
        notes.append("origin not given: sample (0, 0, 0) is at 0, 0, 0")
    at = 0.0 if origin is None else origin
    return SdfGrid(values, chosen, at, tuple(notes), positive_inside=flipped, extremes=extremes)


def check_not_flat(values: Samples, extremes: tuple[float, float]) -> None:
    """Raise if the values are constant or an occupancy grid."""
    low, high = extremes
    if low == high:
        raise GridError(f"every value is {low:.6g}: a constant field has no surface")
    if min(values.shape) > 2 and all(((p == low) | (p == high)).all() for p in values):
        raise GridError(
            f"the only values are {low:.6g} and {high:.6g}: an occupancy grid holds no distances; "
            "make them with scipy.ndimage.distance_transform_edt"
        )


def check_both_sides(extremes: tuple[float, float], level: float) -> None:
    """Raise if all values are on one side of the level."""
    low, high = extremes
    if low >= level:
        raise GridError(
            f"no value is below {level:g} (the smallest is {low:.6g}): an unsigned field has no "
            "inside; if the solid is thinner than the spacing, say --inside negative"
        )
    if high <= level:
        raise GridError(
            f"no value is above {level:g} (the largest is {high:.6g}): the grid lies within the "
            "solid; if that is outside and the solid thin, say --inside positive"
        )


def _is_positive_inside(
    values: Samples,
    inside: str,
    level: float,
    extremes: tuple[float, float],
    notes: list[str],
) -> bool:
    """Say whether the values are positive inside, by word or by what the border is."""
    if inside not in INSIDE:
        raise OptionError(f"inside is {inside!r}: give one of {', '.join(INSIDE)}")
    if inside != "auto":
        return inside == "positive"
    check_both_sides(extremes, level)
    below, total = _count_border(values, level)
    positive = bool(2 * below > total)
    share = max(below, total - below) / total
    if positive or share < 1:
        sign = "positive" if positive else "negative"
        notes.append(
            f"{sign} values are taken as inside: {share:.0%} of the grid's border has the other "
            "sign (say otherwise with --inside)"
        )
    return positive


def _count_border(values: Samples, level: float) -> tuple[int, int]:
    """Return how many samples of the grid's six faces are below the level, and how many there are.

    A sample on an edge counts for each of its faces.
    """
    below = sum(int((values[end] < level).sum()) for end in (0, -1))
    for plane in values:
        below += sum(int((edge < level).sum()) for edge in (plane[0], plane[-1], *plane.T[[0, -1]]))
    nx, ny, nz = values.shape
    return below, 2 * (nx * ny + ny * nz + nz * nx)


def surface_gradients(
    values: Samples, level: float = 0.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return index-space gradients at samples next to the surface, and how bent the field is there.

    Returns
    -------
    (n, 3) and (n,) float64
        Central differences; and the sum of the second differences over the gradient's length. At
        most 64 planes are looked at.
    """
    planes = np.unique(np.linspace(0, len(values) - 1, 64).astype(int))
    found = [_plane_gradients(values, int(i), level) for i in planes]
    gradients, bend = (np.concatenate(parts) for parts in zip(*found))
    return gradients, bend


def _plane_gradients(
    values: Samples, i: int, level: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return gradients (n, 3) and their relative change (n,) next to the surface in plane i."""
    first = max(i - 1, 0)
    slab = values[first : i + 2].astype(np.float64) - level
    inside = slab <= 0
    near = np.zeros(slab.shape, bool)
    bend = np.zeros(slab.shape)
    for axis in range(3):
        s, d, n, b = (np.moveaxis(a, axis, 0) for a in (inside, slab, near, bend))
        crossed = s[1:] != s[:-1]
        n[1:] |= crossed
        n[:-1] |= crossed
        b[1:-1] += np.abs(d[2:] - 2 * d[1:-1] + d[:-2])
    chosen = near[i - first]
    gradient = np.asarray(np.gradient(slab))[:, i - first][:, chosen].T
    length = np.sqrt((gradient**2).sum(1))
    return gradient, bend[i - first][chosen] / np.maximum(length, np.finfo(float).tiny)


def typical_length(gradients: NDArray[np.float64], bend: NDArray[np.float64]) -> float:
    """Return the length round which the gradients (n, 3) cluster: their half-sample mode.

    Only the straighter half counts, and of it what is straight indeed if that is enough: thin
    walls, edges and noise bend the field, and make its gradient too small or too large.
    Reference: Bickel and Frühwirth, "On a fast, robust estimator of the mode", 2006.
    """
    if not len(gradients):
        raise GridError("all values are on one side of the surface: give --spacing")
    limit = float(np.median(bend))
    if (bend < STRAIGHT).sum() >= ENOUGH:
        limit = min(limit, STRAIGHT)
    straight = gradients[bend <= limit]
    length: NDArray[np.float64] = np.sort(np.sqrt((straight**2).sum(1)))
    while len(length) > 2:
        half = (len(length) + 1) // 2
        width = length[half - 1 :] - length[: len(length) - half + 1]
        start = int(width.argmin())
        length = length[start : start + half]
    return float(length.mean())


def _check_equal_axes(gradients: NDArray[np.float64], bend: NDArray[np.float64]) -> None:
    """Raise if the values themselves show different spacings along the axes."""
    length = np.sqrt((gradients**2).sum(1))
    seen: dict[str, float] = {}
    for axis, name in enumerate("xyz"):
        along = (np.abs(gradients[:, axis]) > 0.95 * length) & (bend < STRAIGHT)
        if along.sum() >= ENOUGH:
            seen[name] = typical_length(gradients[along], bend[along])
    if seen and max(seen.values()) > UNEQUAL * min(seen.values()):
        steps = ", ".join(f"{step:.4g} along {name}" for name, step in seen.items())
        raise GridError(
            f"the values change by {steps} from sample to sample: the method needs cubic voxels; "
            "resample the grid to one spacing on all axes"
        )


def _choose_spacing(values: Samples, level: float, spacing: Any, notes: list[str]) -> Triple:
    """Return the spacing that is given, or else measured; they must not contradict each other."""
    given = None if spacing is None else check_spacing(spacing)
    gradients, bend = surface_gradients(values, level)
    if given and not len(gradients):
        return given
    measured = typical_length(gradients, bend)
    _check_equal_axes(gradients, bend)
    if given is None:
        return _infer_spacing(measured, values.shape, notes)
    _check_unit(measured, given, notes)
    return given


def _infer_spacing(measured: float, shape: tuple[int, ...], notes: list[str]) -> Triple:
    """Return the measured spacing, or the usual one that it is close to."""
    n = max(shape)
    usual = {"1": 1.0, f"1/{n}": 1 / n, f"1/{n - 1}": 1 / (n - 1)}
    usual |= {f"2/{n}": 2 / n, f"2/{n - 1}": 2 / (n - 1)}
    name = min(usual, key=lambda key: abs(np.log(usual[key] / measured)))
    if abs(measured / usual[name] - 1) <= SNAP:
        notes.append(f"spacing not given: taken as {name}, the values show {measured:.6g}")
        return (usual[name],) * 3
    notes.append(
        f"spacing not given: estimated as {measured:.6g} from the values, so the size of the mesh "
        "is approximate (give --spacing)"
    )
    return (measured,) * 3


def _check_unit(measured: float, spacing: Triple, notes: list[str]) -> None:
    """Raise or note if the values contradict the given spacing."""
    ratio = measured / (sum(spacing) / 3)
    said = f"the values change by {measured:.6g} from sample to sample, but spacing is "
    if not 1 / REFUSED <= ratio <= REFUSED:
        raise GridError(
            f"{said}{spacing[0]:.6g}: distances and spacing must be in one unit; "
            f"scale the values by {1 / ratio:.6g} or give another --spacing"
        )
    if not 1 / TOLERATED <= ratio <= TOLERATED:
        notes.append(f"{said}{spacing[0]:.6g}: they are no exact distances, or the unit is wrong")
