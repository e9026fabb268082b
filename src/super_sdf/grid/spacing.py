"""The spacing of the samples, and the sign inside: as given, or as the values show them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import Triple
from ..errors import GridError
from .advice import way_out
from .census import Census
from .placement import LEAST_SPACING, MOST_SPACING, check_spacing, is_cubic, steps_of
from .slopes import ENOUGH, Gradients

SNAP = 0.02  # an estimate this close to a usual spacing is replaced by it
CLEARLY_UNEQUAL = 1.1  # ratio of estimated spacings, from which on they are taken as different
TOLERATED = 1.1  # ratio of measured to given spacing, or its inverse, above which there is a note
# Distances cannot change by more than the samples are apart. Larger ratios are refused: the first
# limit applies to gradients that agree with each other, the second to noisy or bent fields. They
# do change by less at thin parts and where they are truncated, so that is never refused.
REFUSED, REFUSED_IF_UNSURE = 1.25, 2.0


def is_positive_inside(census: Census, inside: str, notes: list[str]) -> bool:
    """Return whether the values are positive inside: as given, or for "auto" from the border.

    It counts as outside. A sentence is added to the notes if the sign was inferred and may be
    wrong.
    """
    if inside != "auto":
        return inside == "positive"
    if census.is_one_sided:
        return census.numbers.low < 0
    below, total = int(census.numbers.border[0]), census.border_size
    positive = 2 * below > total
    share = max(below, total - below) / total
    if positive or share < 1:
        sign = "positive" if positive else "negative"
        notes.append(
            f"{sign} values are taken as inside: {share:.0%} of the grid's border has the other "
            "sign (if that is wrong, use --inside)"
        )
    return positive


def check_negative_inside(census: Census) -> None:
    """Raise GridError if most of the border is negative: the sign seems to be reversed."""
    below, total = int(census.numbers.border[0]), census.border_size
    if 2 * below > total:
        raise GridError(
            f"{below / total:.0%} of the grid's border is negative, which is inside: make the grid "
            "with make_grid(values, spacing=..., inside='positive'), or inside='negative' if the "
            "solid does run out of the grid there"
        )


def choose_spacing(
    census: Census, spacing: ArrayLike | None, notes: list[str], *, is_cut: bool = False
) -> Triple:
    """Return the given spacing, or else the one that is measured on the values.

    ``notes`` gets a sentence if the spacing was inferred or is doubtful. Values that are cut off
    (``is_cut``) may change by less along an axis with a large spacing.

    Raises
    ------
    GridError
        If the values change by more than the given spacing allows, or show none.
    """
    beside = census.beside
    if spacing is not None:
        given = check_spacing(spacing)
        if len(beside.bend):
            if not is_cut:
                _check_axes(census, beside.in_finest(given), given)
            _check_unit(census, given, notes, is_cut)
        return given
    everywhere = census.everywhere
    unequal = beside.of_axes or everywhere.of_axes
    if unequal or not _show_one_spacing(everywhere):
        each = everywhere.spacing
        if each is not None and each.max() > CLEARLY_UNEQUAL * each.min():
            return _infer_axes(each, notes)
    if unequal:
        steps = ", ".join(f"{step:.4g} along {name}" for name, step in unequal.items())
        raise GridError(
            f"spacing not given: the values change by {steps} from sample to sample, and do not "
            f"show it for all axes; {way_out(census)}"
        )
    return _infer_spacing(_measure(everywhere, beside), census.shape, notes)


def _show_one_spacing(gradients: Gradients) -> bool:
    """Return whether gradients agree on a spacing, whatever their direction."""
    return len(gradients.bend) < ENOUGH or gradients.agree_with(gradients.typical_length)


def _check_axes(census: Census, gradients: Gradients, spacing: Triple) -> None:
    """Raise GridError if gradients, scaled to one spacing, show different ones along the axes."""
    unequal, h = gradients.of_axes, dict(zip("xyz", spacing))
    if unequal:
        steps = ", ".join(
            f"{step * h[name] / min(spacing):.4g} along {name}" for name, step in unequal.items()
        )
        each = ", ".join(f"{x:g}" for x in (spacing[:1] if is_cubic(spacing) else spacing))
        raise GridError(
            f"the values change by {steps} from sample to sample, but spacing is {each}: "
            f"{way_out(census, spacing)}"
        )


def _infer_axes(each: NDArray[np.float64], notes: list[str]) -> Triple:
    """Return the estimated spacings of the axes, those that are nearly equal as one."""
    each = each.copy()
    for near in each.copy():  # axes that are equal but for the error of the estimate
        alike = np.abs(each / near - 1) <= SNAP
        each[alike] = each[alike].mean()
    spacing = check_spacing(each)
    notes.append(
        f"spacing not given: estimated as {', '.join(f'{h:.6g}' for h in spacing)} along x, y, z "
        "from the values, so the size of the mesh is approximate (give --spacing)"
    )
    return spacing


def measure_spacing(census: Census) -> float:
    """Return the change of values from sample to sample where they are smooth; NaN if nowhere."""
    if not (len(census.everywhere.bend) or len(census.beside.bend)):
        return float("nan")
    return _measure(census.everywhere, census.beside)


def _measure(everywhere: Gradients, beside: Gradients) -> float:
    """Return the change of the values from sample to sample where the field is smooth.

    It is that of the whole field, unless only the samples beside the surface agree with each other:
    then the field is no distance, and what it is at the surface matters.
    """
    if len(everywhere.bend) < ENOUGH and len(beside.bend):
        return beside.typical_length
    measured = everywhere.typical_length
    if len(beside.bend) and not everywhere.agree_with(measured):
        near = beside.typical_length
        return near if beside.agree_with(near) else measured
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


def _check_unit(census: Census, spacing: Triple, notes: list[str], is_cut: bool) -> None:
    """Raise GridError, or add a note, if the values contradict the given spacing.

    They do if they change by more. Exact distances change by less beside thin parts: there is no
    note if the rest of the field agrees with the spacing.
    """
    h, beside = min(steps_of(spacing)), census.beside.in_finest(spacing)
    measured = beside.typical_length
    named = f"{spacing[0]:.6g}" if is_cubic(spacing) else f"{h:.6g} along the finest axis"
    observed = f"the values change by {measured:.6g} from sample to sample, but spacing is {named}"
    allowed = REFUSED if beside.agree_with(measured) else REFUSED_IF_UNSURE
    if measured > allowed * h:
        raise GridError(f"{observed}: {way_out(census, spacing)}")
    if _agree(measured, h):
        return
    if measured < h:
        everywhere = census.everywhere.in_finest(spacing)
        if not is_cut:
            _check_axes(census, everywhere, spacing)
        if _agree(_measure(everywhere, beside), h):
            return
    notes.append(f"{observed}: they are not exact distances, or the unit is wrong")


def _agree(measured: float, h: float) -> bool:
    """Return whether the values change by about as much as the spacing."""
    return h / TOLERATED <= measured <= h * TOLERATED
