"""The spacing of the samples: as given, or estimated from the values."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import Triple
from ..errors import GridError, seen
from .advice import way_out
from .gradients import (
    ENOUGH,
    Gradients,
    are_consistent,
    spacing_of_axes,
    straight_gradients,
    surface_gradients,
    typical_length,
    unequal_axes,
)
from .planes import SampleArray

# Spacings that differ by less than this ratio count as equal. Coarser axes are resampled to the
# finest spacing, so a large ratio makes many samples of few.
EQUAL_SPACING, MOST_UNEQUAL = 1e-3, 50.0
# Within these, areas, volumes and squared areas neither overflow nor underflow.
LEAST_SPACING, MOST_SPACING = 1e-60, 1e60
SNAP = 0.02  # an estimate this close to a usual spacing is replaced by it
CLEARLY_UNEQUAL = 1.1  # ratio of estimated spacings, from which on they are taken as different
# Ratio of measured to given spacing, or its inverse, above which there is a note.
TOLERATED = 1.1
# Distances cannot change by more than the samples are apart. Larger ratios are refused: the first
# limit applies to gradients that agree with each other, the second to noisy or bent fields. They
# do change by less at thin parts and where they are truncated, so that is never refused.
REFUSED, REFUSED_IF_UNSURE = 1.25, 2.0


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
        If they are not positive, out of range, or one is more than 50 times another.
    """
    triple = as_triple(spacing, "spacing")
    if min(triple) <= 0:
        raise GridError(f"spacing is {_join(triple)}: it must be greater than 0")
    if not LEAST_SPACING <= min(triple) <= max(triple) <= MOST_SPACING:
        raise GridError(
            f"spacing is {_join(triple)}: give lengths in a unit in which it is between "
            f"{LEAST_SPACING:g} and {MOST_SPACING:g}"
        )
    if max(triple) > min(triple) * MOST_UNEQUAL:
        raise GridError(
            f"spacing is {_join(triple)}: the largest may be {MOST_UNEQUAL:g} times the smallest; "
            "leave out samples along the finer axes"
        )
    return triple


def is_cubic(spacing: Triple) -> bool:
    """Return whether a spacing is the same on all axes, up to 0.1 %."""
    return max(spacing) <= min(spacing) * (1 + EQUAL_SPACING)


def steps_of(spacing: Triple) -> Triple:
    """Return the spacing of each axis, the mean if they are nearly equal."""
    return (sum(spacing) / 3,) * 3 if is_cubic(spacing) else spacing


def choose_spacing(
    values: SampleArray, spacing: ArrayLike | None, notes: list[str], *, is_cut: bool = False
) -> Triple:
    """Return the given spacing, or else the one that is measured on the values.

    ``notes`` gets a sentence if the spacing was inferred or is doubtful. Values that are cut off
    (``is_cut``) may change by less along an axis with a large spacing.

    Raises
    ------
    GridError
        If the values change by more than the given spacing allows, or show none.
    """
    given = None if spacing is None else check_spacing(spacing)
    beside = surface_gradients(values)
    if given and not len(beside[0]):
        return given
    if given:
        if not is_cut:
            _check_axes(values, in_finest(beside, given), given)
        _check_unit(values, beside, given, notes, is_cut)
        return given
    everywhere = straight_gradients(values)
    unequal = unequal_axes(*beside) or unequal_axes(*everywhere)
    if unequal or not _show_one_spacing(everywhere):
        each = spacing_of_axes(*everywhere)
        if each is not None and each.max() > CLEARLY_UNEQUAL * each.min():
            return _infer_axes(each, notes)
    if unequal:
        steps = ", ".join(f"{step:.4g} along {name}" for name, step in unequal.items())
        raise GridError(
            f"spacing not given: the values change by {steps} from sample to sample, and do not "
            f"show it for all axes; {way_out(values)}"
        )
    return _infer_spacing(_measure(everywhere, beside), values.shape, notes)


def _show_one_spacing(gradients: Gradients) -> bool:
    """Return whether gradients agree on a spacing, whatever their direction."""
    return len(gradients[0]) < ENOUGH or are_consistent(typical_length(*gradients), *gradients)


def in_finest(gradients: Gradients, spacing: Triple) -> Gradients:
    """Return gradients in index units of the finest axis, if the spacings differ."""
    if is_cubic(spacing):
        return gradients
    return gradients[0] * (min(spacing) / np.array(spacing)), gradients[1]


def _check_axes(values: SampleArray, gradients: Gradients, spacing: Triple) -> None:
    """Raise GridError if gradients, scaled to one spacing, show different ones along the axes."""
    found, h = unequal_axes(*gradients), dict(zip("xyz", spacing))
    if found:
        steps = ", ".join(
            f"{step * h[name] / min(spacing):.4g} along {name}" for name, step in found.items()
        )
        raise GridError(
            f"the values change by {steps} from sample to sample, but spacing is "
            f"{_join(spacing[:1] if is_cubic(spacing) else spacing)}: {way_out(values, spacing)}"
        )


def _infer_axes(found: NDArray[np.float64], notes: list[str]) -> Triple:
    """Return the estimated spacings of the axes, those that are nearly equal as one."""
    for near in found.copy():  # axes that are equal but for the error of the estimate
        alike = np.abs(found / near - 1) <= SNAP
        found[alike] = found[alike].mean()
    spacing = check_spacing(found)
    notes.append(
        f"spacing not given: estimated as {', '.join(f'{h:.6g}' for h in spacing)} along x, y, z "
        "from the values, so the size of the mesh is approximate (give --spacing)"
    )
    return spacing


def measure_spacing(values: SampleArray) -> float:
    """Return the change of values from sample to sample where they are smooth; NaN if nowhere."""
    everywhere, beside = straight_gradients(values), surface_gradients(values)
    if not (len(everywhere[0]) or len(beside[0])):
        return float("nan")
    return _measure(everywhere, beside)


def _measure(everywhere: Gradients, beside: Gradients) -> float:
    """Return the change of the values from sample to sample where the field is smooth.

    It is that of the whole field, unless only the samples beside the surface agree with each other:
    then the field is no distance, and what it is at the surface matters.
    """
    if len(everywhere[0]) < ENOUGH and len(beside[0]):
        return typical_length(*beside)
    measured = typical_length(*everywhere)
    if len(beside[0]) and not are_consistent(measured, *everywhere):
        near = typical_length(*beside)
        return near if are_consistent(near, *beside) else measured
    return measured


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
    values: SampleArray, beside: Gradients, spacing: Triple, notes: list[str], is_cut: bool
) -> None:
    """Raise GridError, or add a note, if the values contradict the given spacing.

    They do if they change by more. Exact distances change by less beside thin parts: there is no
    note if the rest of the field agrees with the spacing.
    """
    h = min(steps_of(spacing))
    beside = in_finest(beside, spacing)
    measured = typical_length(*beside)
    named = f"{spacing[0]:.6g}" if is_cubic(spacing) else f"{h:.6g} along the finest axis"
    observed = f"the values change by {measured:.6g} from sample to sample, but spacing is {named}"
    allowed = REFUSED if are_consistent(measured, *beside) else REFUSED_IF_UNSURE
    if measured > allowed * h:
        raise GridError(f"{observed}: {way_out(values, spacing)}")
    if _agree(measured, h):
        return
    if measured < h:
        everywhere = in_finest(straight_gradients(values), spacing)
        if not is_cut:
            _check_axes(values, everywhere, spacing)
        if _agree(_measure(everywhere, beside), h):
            return
    notes.append(f"{observed}: they are not exact distances, or the unit is wrong")


def _agree(measured: float, h: float) -> bool:
    """Return whether the values change by about as much as the spacing."""
    return h / TOLERATED <= measured <= h * TOLERATED


def _join(triple: tuple[float, ...]) -> str:
    return ", ".join(f"{number:g}" for number in triple)
