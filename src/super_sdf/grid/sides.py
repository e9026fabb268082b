"""Which sign is inside: the border of the grid is taken for outside, whatever the offset."""

from __future__ import annotations

from ..errors import GridError, OptionError, seen
from .planes import Samples
from .samples import Extremes

INSIDE = ("auto", "negative", "positive")


def is_positive_inside(values: Samples, inside: str, extremes: Extremes, notes: list[str]) -> bool:
    """Say whether the values are positive inside, by word or, if that is "auto", by the border."""
    if not isinstance(inside, str) or inside not in INSIDE:
        raise OptionError(f"inside is {seen(inside)}: give one of {', '.join(INSIDE)}")
    if inside != "auto":
        return inside == "positive"
    check_both_sides(extremes)
    below, total = _count_border(values)
    positive = _is_mostly_negative(below, total)
    share = max(below, total - below) / total
    if positive or share < 1:
        sign = "positive" if positive else "negative"
        notes.append(
            f"{sign} values are taken as inside: {share:.0%} of the grid's border has the other "
            "sign (say otherwise with --inside)"
        )
    return positive


def check_negative_inside(values: Samples) -> None:
    """Raise if most of the border is negative: such values seem to be positive inside."""
    below, total = _count_border(values)
    if _is_mostly_negative(below, total):
        raise GridError(
            f"{below / total:.0%} of the grid's border is negative, which is inside: make the grid "
            "with make_grid(values, spacing=..., inside='positive'), or inside='negative' if the "
            "solid does run out of the grid there"
        )


def check_both_sides(extremes: Extremes) -> None:
    """Raise if all values are on one side of the surface."""
    low, high = extremes
    if low >= 0:
        raise GridError(
            f"no value is below 0 (the smallest is {low:.6g}): an unsigned field has no "
            "inside; if the solid is thinner than the spacing, say --inside negative"
        )
    if high <= 0:
        raise GridError(
            f"no value is above 0 (the largest is {high:.6g}): the grid lies within the "
            "solid; if that is outside and the solid thin, say --inside positive"
        )


def _is_mostly_negative(below: int, total: int) -> bool:
    """Say whether most of the border is negative."""
    return 2 * below > total


def _count_border(values: Samples) -> tuple[int, int]:
    """Return how many samples of the grid's six faces are negative, and how many there are.

    A sample on an edge counts for each of its faces.
    """
    below = sum(int((values[end] < 0).sum()) for end in (0, -1))
    for plane in values:
        below += sum(int((edge < 0).sum()) for edge in (plane[0], plane[-1], *plane.T[[0, -1]]))
    nx, ny, nz = values.shape
    return below, 2 * (nx * ny + ny * nz + nz * nx)
