"""What the band of a grid says before it is kept: for a grid that is worked on in bricks."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..grid.planes import DerivedPlanes, over_planes, planes_at_once
from ..grid.sdf_grid import SdfGrid, without_samples
from ..neighbourhood import CENTRE
from .band import BLOCK_PLANES, can_hold_surface, is_lipschitz, plane_blocks
from .exact import BandSummary, summarise
from .offsets import Jumps
from .survey import Band, band_of_samples, check_jumps, limit_to_field


class Glance(NamedTuple):
    """What is seen of the band in some planes, without keeping it.

    Attributes
    ----------
    summary : BandSummary
        Of the voxels in these planes.
    decoded : list of int
        The voxels that are decoded in each plane.
    crossings : int
        See ``Band.count_crossings``.
    jumps : list of (Jumps, Jumps)
        With an offset.
    """

    summary: BandSummary
    decoded: list[int]
    crossings: int
    jumps: list[tuple[Jumps, Jumps]]


def look_at_band(grid: SdfGrid, offset: float) -> Glance:
    """Return what the band of a grid says without keeping it, as if ``survey`` had read it.

    The planes are read where the samples are, see ``planes.over_planes``.

    Raises
    ------
    GridError
        As in ``survey``.
    """
    count, samples = grid.shape[0], grid.samples
    least = planes_at_once(samples) if isinstance(samples, DerivedPlanes) else 0
    ranges = [
        (max(first - 1, 0), min(last + 1, count), (first, last))
        for first, last in plane_blocks(grid.shape, least=max(least, BLOCK_PLANES))
    ]
    look = partial(_glance, without_samples(grid), offset)
    found = list(over_planes(samples, look, ranges))
    jumps = [jump for glance in found for jump in glance.jumps]
    if offset:
        check_jumps(jumps, grid, offset)
    summaries = [glance.summary for glance in found]
    summary = BandSummary(
        sum(part.voxels for part in summaries),
        sum(part.noisy for part in summaries),
        min(part.low for part in summaries),
        max(part.high for part in summaries),
        any(part.leaves for part in summaries),
    )
    decoded = [number for glance in found for number in glance.decoded]
    return Glance(summary, decoded, sum(glance.crossings for glance in found), jumps)


def _glance(grid: SdfGrid, offset: float, planes: NDArray[Any], own: tuple[int, int]) -> Glance:
    """Return what is seen in the planes ``own``, given with those beside them."""
    jumps: list[tuple[Jumps, Jumps]] = []
    leaving: list[bool] = []
    first, last = own
    ijk, patches, _ = band_of_samples(grid, offset, planes, first, last, jumps, leaving)
    lipschitz = is_lipschitz(patches)
    band = Band(
        grid.shape, ijk, patches, lipschitz, can_hold_surface(patches, lipschitz), lipschitz
    )
    decoded = limit_to_field(band, grid, offset).decoded
    by_plane = np.bincount(ijk[decoded, 0] - first, minlength=last - first).tolist()
    summary = summarise(patches[:, CENTRE], lipschitz, leaving[0])
    return Glance(summary, by_plane, band.count_crossings(), jumps)
