"""What the band of a grid says before it is kept: for a grid that is worked on in bricks."""

from __future__ import annotations

from functools import partial
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..grid.cubic import Resampled
from ..grid.planes import over_planes, planes_at_once
from ..grid.sdf_grid import SdfGrid, without_samples
from ..neighbourhood import CENTRE
from .band import BLOCK_PLANES, BandSummary, can_hold_surface, is_lipschitz, plane_blocks, summarise
from .offsets import Jumps
from .survey import Band, band_of_samples, check_jumps, limit_to_field


class Glance(NamedTuple):
    """What is seen of the band in some planes, without keeping it.

    Of each plane the voxels, and those that are decoded; the samples beyond the band that can be
    exact; see ``Band.count_crossings``; and, with an offset, the jumps.
    """

    summary: BandSummary
    voxels: list[int]
    decoded: list[int]
    beyond: int
    crossings: int
    jumps: list[tuple[Jumps, Jumps]]


def look_at_band(grid: SdfGrid, offset: float, planes: int = 0) -> Glance:
    """Return what the band of a grid says without keeping it, as if ``survey`` had read it.

    The planes are read where the samples are, see ``planes.over_planes``; by default at least as
    many at a time as are best.
    """
    count, samples = grid.shape[0], grid.samples
    planes = planes or max(planes_at_once(samples), BLOCK_PLANES)
    ranges = [
        (max(first - 1, 0), min(last + 1, count), (first, last))
        for first, last in plane_blocks(grid.shape, least=planes)
    ]
    # resampled ones are made here, and say so
    known = grid if isinstance(samples, Resampled) else without_samples(grid)
    look = partial(_glance, known, offset)
    parts = zip(*over_planes(samples, look, ranges))
    summaries, voxels, decoded, beyond, crossings, jumps = map(list, parts)
    all_jumps = list(chain(*jumps))
    if offset:
        check_jumps(all_jumps, grid, offset)
    counts = list(chain(*voxels)), list(chain(*decoded)), sum(beyond), sum(crossings)
    return Glance(_of_all(summaries), *counts, all_jumps)


def _of_all(summaries: list[BandSummary]) -> BandSummary:
    return BandSummary(
        sum(part.voxels for part in summaries),
        sum(part.noisy for part in summaries),
        min(part.low for part in summaries),
        max(part.high for part in summaries),
        any(part.leaves for part in summaries),
    )


def _glance(grid: SdfGrid, offset: float, planes: NDArray[Any], inner: tuple[int, int]) -> Glance:
    """Return what is seen in the planes ``inner``, given with those beside them."""
    jumps: list[tuple[Jumps, Jumps]] = []
    leaving: list[bool] = []
    first, last = inner
    voxels, decoded = np.zeros((2, last - first), np.int64)
    beyond = crossings = 0
    summaries: list[BandSummary] = []
    for ijk, patches, _, value in band_of_samples(grid, offset, planes, inner, jumps, leaving):
        lipschitz = is_lipschitz(patches)
        held = can_hold_surface(patches, lipschitz)
        band = limit_to_field(
            Band(grid.shape, ijk, patches, lipschitz, held, lipschitz), grid, offset
        )
        plane = ijk[:, 0] - first
        voxels += np.bincount(plane, minlength=last - first)
        decoded += np.bincount(plane[band.decoded], minlength=last - first)
        beyond, crossings = beyond + len(value), crossings + band.count_crossings()
        summaries.append(summarise(patches[:, CENTRE], lipschitz, leaving[0]))
    summary = _of_all(summaries)
    return Glance(summary, voxels.tolist(), decoded.tolist(), beyond, crossings, jumps)
