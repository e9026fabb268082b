"""Unknown samples, NaN or infinite or a value that stands for them: their side, and distances.

An infinite sample is on the side of its sign. Others are on the side of the known samples round the
connected region of unknown ones that they lie in. All get the cut-off of their side: the largest
known distance there. A region with both sides beside it is filled in by what is round it if it is
small; else the surface ends there. The whole grid is held in memory for this.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray
from ..errors import GridError
from ..threads import check_fits
from .look import Extremes, Look, border_share
from .samples import SampleArray

LAYERS = 3  # of unknown samples to which the surface beside them is continued
SMALL = 8  # samples of a region between both sides that is filled in
MOST_KNOWN = 1e-3  # of all samples: more in small regions are a pattern, and stay unknown
BYTES = 24  # of memory per sample


class Known(NamedTuple):
    """Samples whose unknown ones are replaced, and their extremes.

    Where both sides are near, they are continued linearly over ``LAYERS`` unknown ones; farther
    away they are outside. ``unseen`` is which of them are unknown and in large regions with both
    sides, or none, beside them; None if none are.
    """

    samples: NDArray[Any]
    extremes: Extremes
    unseen: BoolArray | None
    why_open: str


def with_known(
    samples: SampleArray, look: Look, values: Sequence[float], notes: list[str]
) -> Known:
    """Return samples without unknown ones; some ``values`` stand for these, too."""
    from scipy import ndimage

    check_fits(BYTES * prod(samples.shape), "the grid with unknown samples", "crop it")
    whole, named = np.array(samples[:]), " or ".join(f"{value:g}" for value in values)
    if values:
        whole[np.isin(whole, values)] = np.nan
    finite = whole[np.isfinite(whole)]
    low, high = float(finite.min()), float(finite.max())
    regions, _ = ndimage.label(unknown := np.isnan(whole))
    size = np.bincount(regions.ravel())
    positive, negative = _sides_beside(regions, whole, len(size))
    unsure = positive == negative
    size[0], unsure[0] = 0, False
    count, outer = int(size.sum()), int(size[positive & ~unsure].sum())
    if values:
        notes.append(
            f"{count:,} samples are exactly {named}, where no distance is: they are taken as "
            "unknown (write NaN where nothing was seen)"
        )
    notes.append(
        f"{count + look.infinite:,} samples are unknown ({count:,} NaN, of which {outer:,} lie "
        f"on the positive side, and {look.infinite:,} infinite): they are taken as cut off at "
        f"{low:.6g} and {high:.6g}"
    )
    is_open = unsure & (size > SMALL)
    if size[unsure & ~is_open].sum() > MOST_KNOWN * whole.size:
        is_open = unsure
    of_side = np.where(positive, high, low).astype(whole.dtype)
    of_side[unsure] = np.nan
    whole[unknown] = of_side[regions[unknown]]
    whole = np.clip(whole, low, high)
    _continue(whole, (low, high))
    below = border_share(look, lambda x: (x < 0) & ~np.isin(x, values))
    whole[np.isnan(whole)] = low if below > 0.5 else high
    if not is_open.any():
        return Known(whole, (low, high), None, "")
    unseen, count = is_open[regions], int(size[is_open].sum())
    notes.append(
        f"{count:,} of the unknown samples are in regions that touch both sides of the surface: "
        "it is open there"
    )
    which = f" (those that are exactly {named} are taken as such)" if values else ""
    return Known(whole, (low, high), unseen, _why_open(unseen, count, which))


def _why_open(unseen: BoolArray, count: int, which: str) -> str:
    first = ", ".join(map(str, np.unravel_index(int(unseen.argmax()), unseen.shape)))
    return (
        f"{count:,} samples are unknown{which}, values[{first}] the first, in regions that touch "
        "samples on both sides of the surface, so whether they are inside is unknown"
    )


def _sides_beside(regions: NDArray[np.int32], values: NDArray[Any], count: int) -> BoolArray:
    """Return which regions have positive samples beside them, and which have others, (2, n)."""
    has = np.zeros((2, count), bool)
    for axis in range(3):
        r, v = np.moveaxis(regions, axis, 0), np.moveaxis(values, axis, 0)
        for region, beside in ((r[1:], v[:-1]), (r[:-1], v[1:])):
            at = np.nonzero((region > 0) & ~np.isnan(beside))
            has[(beside[at] <= 0).astype(int), region[at]] = True
    return has


def _continue(values: NDArray[Any], limits: Extremes) -> None:
    """Fill in unknown values beside others by straight lines through these."""
    for _ in range(LAYERS if np.isnan(values).any() else 0):
        total, count = np.zeros(values.shape), np.zeros(values.shape, np.int8)
        for axis in range(3):
            for flipped in (slice(None), slice(None, None, -1)):
                lines = np.moveaxis(values, axis, 0)[flipped]
                line = 2 * lines[1:-1] - lines[:-2]  # at the sample after these two
                known = np.isfinite(line)
                np.moveaxis(total, axis, 0)[flipped][2:] += np.where(known, line, 0)
                np.moveaxis(count, axis, 0)[flipped][2:] += known
        new = np.isnan(values) & (count > 0)
        values[new] = np.clip(total[new] / count[new], *limits)


def check_infinite(samples: SampleArray) -> None:
    """Raise GridError if infinite samples are beside the surface."""
    values = np.asarray(samples[:])
    bad, is_infinite = np.zeros(values.shape, bool), np.isinf(values)
    for axis in range(3):
        v, marked, b = (np.moveaxis(x, axis, 0) for x in (values, is_infinite, bad))
        crossed = (np.sign(v[1:]) * np.sign(v[:-1])) <= 0  # not where one is NaN
        b[1:] |= crossed & marked[1:]
        b[:-1] |= crossed & marked[:-1]
    if bad.any():
        i, j, k = np.argwhere(bad)[0].tolist()
        raise GridError(
            f"values[{i}, {j}, {k}] is {values[i, j, k]!s}, and a sample beside it has the other "
            f"sign, as at {np.count_nonzero(bad):,} infinite samples: where the surface passes "
            "between them is unknown; replace each by a distance of the right sign (the cut-off "
            "value of its side), or by NaN where nothing was seen"
        )
