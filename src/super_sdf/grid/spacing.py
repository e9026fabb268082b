"""The spacing of the samples: as given, or estimated from the values."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import Triple
from ..errors import GridError, seen
from .gradients import are_consistent, check_equal_axes, lengths, surface_gradients, typical_length
from .planes import SampleArray

# The method needs cubic voxels: spacings that differ by less than this ratio count as equal.
EQUAL_SPACING = 1e-3
# Within these, areas, volumes and squared areas neither overflow nor underflow.
LEAST_SPACING, MOST_SPACING = 1e-60, 1e60
SNAP = 0.02  # an estimate this close to a usual spacing is replaced by it
# Ratio of measured to given spacing, or its inverse, above which there is a note.
TOLERATED = 1.1
# Distances cannot change by more than the samples are apart. Larger ratios are refused: the first
# limit applies to gradients that agree with each other, the second to noisy or bent fields.
REFUSED, REFUSED_IF_UNSURE = 1.25, 2.0
# Distances change by less at thin parts and where they are truncated. If nine in ten samples change
# by less than half the spacing, the unit is wrong.
SLOW, SLOW_SHARE = 0.5, 0.9


def as_triple(number: ArrayLike, name: str) -> Triple:
    """Return one number or three as three floats.

    Raises
    ------
    GridError
        If ``number``, which the message calls ``name``, is neither or not finite.
    """
    try:
        array = np.asarray(number)
        if array.dtype.kind not in "fiu":  # booleans and strings are refused
            raise TypeError
        with np.errstate(over="ignore"):  # of long doubles, which are found to be infinite below
            triple = np.broadcast_to(array.astype(np.float64).ravel(), (3,))
    except (TypeError, ValueError, RuntimeError):
        raise GridError(f"{name} is {seen(number)}: give one number or three") from None
    if not np.isfinite(triple).all():
        raise GridError(f"{name} is {seen(number)}: it must be finite")
    return float(triple[0]), float(triple[1]), float(triple[2])


def check_spacing(spacing: ArrayLike) -> Triple:
    """Return the spacing as three floats.

    Raises
    ------
    GridError
        If they are not positive, out of range, or not equal within 0.1 %.
    """
    triple = as_triple(spacing, "spacing")
    if min(triple) <= 0:
        raise GridError(f"spacing is {_join(triple)}: it must be greater than 0")
    if not LEAST_SPACING <= min(triple) <= max(triple) <= MOST_SPACING:
        raise GridError(
            f"spacing is {_join(triple)}: give lengths in a unit in which it is between "
            f"{LEAST_SPACING:g} and {MOST_SPACING:g}"
        )
    if max(triple) > min(triple) * (1 + EQUAL_SPACING):
        raise GridError(
            f"spacing is {_join(triple)}: the method needs cubic voxels; "
            "resample the grid to one spacing on all axes"
        )
    return triple


def choose_spacing(values: SampleArray, spacing: ArrayLike | None, notes: list[str]) -> Triple:
    """Return the given spacing, or else the one that is measured on the values.

    ``notes`` gets a sentence if the spacing was inferred or is doubtful.

    Raises
    ------
    GridError
        If the values contradict the given spacing, or show none.
    """
    given = None if spacing is None else check_spacing(spacing)
    gradients, bend = surface_gradients(values)
    if given and not len(gradients):
        return given
    measured = typical_length(gradients, bend)
    check_equal_axes(gradients, bend)
    if given is None:
        return _infer_spacing(measured, values.shape, notes)
    _check_unit(measured, gradients, bend, given, notes)
    return given


def _infer_spacing(measured: float, shape: tuple[int, ...], notes: list[str]) -> Triple:
    """Return the measured spacing, or a usual one close to it."""
    if not LEAST_SPACING <= measured <= MOST_SPACING:
        raise GridError(
            f"spacing not given: the values change by {measured:.6g} from sample to sample; give "
            f"--spacing, in a unit in which it is between {LEAST_SPACING:g} and {MOST_SPACING:g}"
        )
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


def _check_unit(
    measured: float,
    gradients: NDArray[np.float64],
    bend: NDArray[np.float64],
    spacing: Triple,
    notes: list[str],
) -> None:
    """Raise GridError, or add a note, if the values contradict the given spacing."""
    h = sum(spacing) / 3
    observed = f"the values change by {measured:.6g} from sample to sample, but spacing is "
    allowed = REFUSED if are_consistent(measured, gradients, bend) else REFUSED_IF_UNSURE
    if measured > allowed * h or np.quantile(lengths(gradients), SLOW_SHARE) < SLOW * h:
        scale = f"scale the values by {h / measured:.6g} or " if measured > 0 else ""
        raise GridError(
            f"{observed}{spacing[0]:.6g}: distances and spacing must be in the same unit; "
            f"{scale}give another --spacing"
        )
    if not h / TOLERATED <= measured <= h * TOLERATED:
        notes.append(
            f"{observed}{spacing[0]:.6g}: they are not exact distances, or the unit is wrong"
        )


def _join(triple: Triple) -> str:
    return ", ".join(f"{number:g}" for number in triple)
