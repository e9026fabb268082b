"""Which sign is inside: the border of the grid counts as outside, whatever the offset."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from ..errors import GridError
from ..options import check_inside
from .one_sided import is_one_sided
from .planes import SampleArray, in_blocks, over_planes
from .samples import Extremes


def is_positive_inside(
    values: SampleArray, inside: str, extremes: Extremes, notes: list[str]
) -> bool:
    """Return whether the values are positive inside: as given, or for "auto" from the border.

    Parameters
    ----------
    values : (nx, ny, nz) array or Planes
        Samples.
    inside : str
        One of ``options.INSIDE``.
    extremes : two floats
        The smallest and the largest sample.
    notes : list of str
        A sentence is added if the sign was inferred and may be wrong.

    Raises
    ------
    OptionError
        If ``inside`` is unknown.
    """
    check_inside(inside)
    if inside != "auto":
        return inside == "positive"
    if is_one_sided(extremes):
        return extremes[0] < 0
    below, total = count_border(values)
    positive = is_mostly_negative(below, total)
    share = max(below, total - below) / total
    if positive or share < 1:
        sign = "positive" if positive else "negative"
        notes.append(
            f"{sign} values are taken as inside: {share:.0%} of the grid's border has the other "
            "sign (if that is wrong, use --inside)"
        )
    return positive


def check_negative_inside(values: SampleArray) -> None:
    """Raise GridError if most of the border is negative: the sign seems to be reversed."""
    below, total = count_border(values)
    if is_mostly_negative(below, total):
        raise GridError(
            f"{below / total:.0%} of the grid's border is negative, which is inside: make the grid "
            "with make_grid(values, spacing=..., inside='positive'), or inside='negative' if the "
            "solid does run out of the grid there"
        )


def is_mostly_negative(below: int, total: int) -> bool:
    """Return whether most samples of the border are negative."""
    return 2 * below > total


def count_border(values: SampleArray) -> tuple[int, int]:
    """Return the number of negative samples on the six faces of the grid, and of all there.

    A sample on an edge counts for each of its faces.
    """
    nx, ny, nz = values.shape
    below = sum(over_planes(values, _count_below, [(0, 1), (nx - 1, nx)]))
    below += sum(over_planes(values, _count_below_on_edges, in_blocks(values)))
    return below, 2 * (nx * ny + ny * nz + nz * nx)


def _count_below(planes: NDArray[Any]) -> int:
    """Return the number of negative samples."""
    return int((planes < 0).sum())


def _count_below_on_edges(planes: NDArray[Any]) -> int:
    """Return the number of negative samples on the four edges of each plane."""
    return _count_below(planes[:, [0, -1]]) + _count_below(planes[:, :, [0, -1]])
