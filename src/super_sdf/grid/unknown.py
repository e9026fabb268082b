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
from .look import beside_surface
from .samples import SampleArray

SMALL = 8  # samples of a region between both sides that is filled in
MOST_KNOWN = 1e-3  # of all samples: more in small regions are a pattern, and stay unknown
BYTES = 24  # of memory per sample


def with_known(
    samples: SampleArray, values: Sequence[float], notes: list[str]
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
    continued = _continued(whole)
    whole = np.where(unknown, np.where(positive, high, low)[regions], whole)
    whole = np.where(unsure[regions], continued, whole).clip(low, high).astype(finite.dtype)
    if values:
        named, count = " or ".join(f"{value:g}" for value in values), int(size.sum())
        notes.append(
            f"{count:,} samples are exactly {named}, where no distance is: they are taken as "
            "unknown (write NaN where nothing was seen)"
        )
    count, outer = int((unknown | infinite).sum()), int(size[positive & ~unsure].sum())
    notes.append(
        f"{count:,} samples are unknown, of which {outer:,} without a number lie on the positive "
        f"side: they are taken as cut off at {low:.6g} and {high:.6g}"
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


def _continued(values: NDArray[Any]) -> NDArray[Any]:
    """Return values with each NaN replaced by what a straight line through known samples gives.

    That goes through the nearest known sample, and on to as far behind it.
    """
    from scipy import ndimage

    nearest = ndimage.distance_transform_edt(
        np.isnan(values), return_distances=False, return_indices=True
    )
    behind = 2 * nearest - np.indices(values.shape)
    within = np.reshape(values.shape, (3, 1, 1, 1)) - 1
    near, far = values[tuple(nearest)], values[tuple(behind.clip(0, within))]
    return np.asarray(np.where(np.isfinite(far), 2 * near - far, near))
