"""Unknown samples, NaN or infinite or a value that stands for them: their side, and distances.

An infinite sample is on the side of its sign. Others are on the side of the known samples round the
connected region of unknown ones that they lie in. All get the cut-off of their side: the largest
known distance there. A region with both sides beside it is filled in by what is round it if it is
small; else the surface ends there. The whole grid is held in memory for this.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray
from ..errors import GridError
from ..threads import check_fits
from .look import Extremes, Look, beside_surface, border_share
from .samples import SampleArray

LAYERS = 3  # of unknown samples to which the surface beside them is continued
SMALL = 8  # samples of a region between both sides that is filled in
MOST_KNOWN = 1e-3  # of all samples: more in small regions are a pattern, and stay unknown
BYTES = 24  # of memory per sample


def with_known(
    samples: SampleArray, look: Look, values: Sequence[float], notes: list[str]
) -> tuple[NDArray[Any], BoolArray | None, str]:
    """Return samples without unknown ones, for which some ``values`` stand, too.

    Where both sides are near, they are continued linearly over ``LAYERS`` unknown samples; farther
    away these are outside. Also returned are which samples lie in large unknown regions with both
    sides, or none, beside them, None if none do, and a sentence on these.
    """
    from scipy import ndimage

    check_fits(BYTES * prod(samples.shape), "the grid with unknown samples", "crop it")
    whole, named = np.array(samples[:]), " or ".join(f"{value:g}" for value in values)
    if values:
        whole[np.isin(whole, values)] = np.nan
    finite = whole[np.isfinite(whole)]
    low, high = float(finite.min()), float(finite.max())
    regions, number = ndimage.label(unknown := np.isnan(whole))
    size = np.bincount(regions.ravel())
    size[0] = 0
    positive, negative = (
        np.isin(np.arange(number + 1), regions[ndimage.binary_dilation(side)])
        for side in (whole > 0, whole <= 0)
    )
    unsure = (positive == negative) & (size > 0)
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
    of_side = np.where(unsure, np.nan, np.where(positive, high, low)).astype(whole.dtype)
    whole[unknown] = of_side[regions[unknown]]
    whole = np.clip(whole, low, high)
    _continue(whole, (low, high))
    below = border_share(look, lambda x: (x < 0) & ~np.isin(x, values))
    whole[np.isnan(whole)] = low if below > 0.5 else high
    if not is_open.any():
        return whole, None, ""
    unseen, count = is_open[regions], int(size[is_open].sum())
    notes.append(
        f"{count:,} of the unknown samples are in regions that touch both sides of the surface: "
        "it is open there"
    )
    which = f" (those that are exactly {named} are taken as such)" if values else ""
    first = ", ".join(map(str, np.argwhere(unseen)[0]))
    why_open = (
        f"{count:,} samples are unknown{which}, values[{first}] the first, in regions that touch "
        "samples on both sides of the surface, so whether they are inside is unknown"
    )
    return whole, unseen, why_open


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
    bad = np.argwhere(np.isinf(values) & beside_surface(values))
    if len(bad):
        i, j, k = bad[0].tolist()
        raise GridError(
            f"values[{i}, {j}, {k}] is {values[i, j, k]!s}, and a sample beside it has the other "
            f"sign, as at {len(bad):,} infinite samples: where the surface passes between them is "
            "unknown; replace each by a distance of the right sign (the cut-off value of its "
            "side), or by NaN where nothing was seen"
        )
