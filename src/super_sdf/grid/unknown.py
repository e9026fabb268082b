"""Unknown samples, NaN or infinite or a value that stands for them: their side, and distances.

An infinite sample is on the side of its sign; beside the other side it is as unknown as NaN. Others
are on the side of the known samples round the connected region of unknown ones that they lie in.
All get the cut-off of their side: the largest known distance there. A region with both sides beside
it is filled in by what is round it if it is small; else the surface ends there. The whole grid is
held in memory for this.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray
from ..threads import check_fits
from .look import Look, beside_surface, border_share
from .samples import SampleArray

LAYERS = 3  # of unknown samples to which the surface beside them is continued
SMALL = 8  # samples of a region between both sides that is filled in
MOST_KNOWN = 1e-3  # of all samples: more in small regions are a pattern, and stay unknown
BYTES = 24  # of memory per sample


def with_known(
    samples: SampleArray, look: Look, values: Sequence[float], notes: list[str]
) -> tuple[NDArray[Any], BoolArray | None, str]:
    """Return samples without unknown ones, for which some ``values`` stand, too.

    Also returned are which samples lie in large unknown regions with both sides, or none, beside
    them, None if none do, and a sentence on these.
    """
    from scipy import ndimage

    check_fits(BYTES * prod(samples.shape), "the grid with unknown samples", "crop it")
    whole = np.array(samples[:], np.result_type(samples.dtype, np.float32))
    infinite = np.isinf(whole)
    whole[np.isin(whole, values) | (infinite & beside_surface(whole))] = np.nan
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
    is_open = unsure & (size > SMALL)
    if size[unsure & ~is_open].sum() > MOST_KNOWN * whole.size:
        is_open = unsure
    of_side = np.where(unsure, np.nan, np.where(positive, high, low)).astype(whole.dtype)
    whole = np.where(unknown, of_side[regions], whole)
    _continue(whole)
    outside = low if border_share(look, lambda x: x < 0) > 0.5 else high
    whole = np.where(np.isnan(whole), outside, whole).clip(low, high).astype(of_side.dtype)
    if values:
        named, count = " or ".join(f"{value:g}" for value in values), int(size.sum())
        notes.append(
            f"{count:,} samples are exactly {named}, where no distance is: they are taken as "
            "unknown (write NaN where nothing was seen)"
        )
    count, outer = int((unknown | infinite).sum()), int(size[positive & ~unsure].sum())
    notes.append(
        f"{count:,} samples are unknown, of which {outer:,} without a number lie on the positive "
        f"side: they are taken as truncated at {low:.6g} and {high:.6g}"
    )
    if not is_open.any():
        return whole, None, ""
    unseen, count = is_open[regions], int(size[is_open].sum())
    notes.append(
        f"{count:,} of the unknown samples are in regions that touch both sides of the surface: "
        "it is open there"
    )
    why_open = (
        f"{count:,} samples are unknown, values[{', '.join(map(str, np.argwhere(unseen)[0]))}] the "
        "first, in regions that touch samples on both sides of the surface, so whether they are "
        "inside is unknown"
    )
    return whole, unseen, why_open


@np.errstate(invalid="ignore")  # of infinite samples
def _continue(values: NDArray[Any]) -> None:
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
        values[new] = total[new] / count[new]
