"""Checks that the distances reach far enough to both sides of an offset.

A field may be truncated at some distance, or hold a fill value beyond it. A surface too near that
distance would come out in loose pieces, or in the wrong place.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..arrays import BoolArray, FloatArray
from ..errors import GridError
from ..neighbourhood import CENTRE
from .band import HALF_BAND, PATCH_LIMIT

# Neighbouring samples of noisy distances differ by up to twice the spacing (4 half voxels); a
# distance and a fill value differ by more, a jump. A small share of jumps is tolerated as outliers.
MIN_JUMP, MAX_JUMP_SHARE = 4.2, 0.05
# How far distances must reach beyond the offset, in half voxels, where they are truncated; and
# where fill values begin, which would be taken for noise.
CUT_OFF_MARGIN, FILL_MARGIN = HALF_BAND, 5.0
# Tolerances in half voxels, so that the offset that the message suggests works: for rounding, and
# because no sample lies exactly where fill values begin.
ROUNDING, UNSAMPLED = 1e-3, 0.1


class Jumps(NamedTuple):
    """Counts of the samples near an offset, and of those with a jump to a neighbour."""

    edges: int  # samples near the offset with a jump to a neighbour
    near: int  # samples near the offset
    end: float  # the farthest with a jump, in half voxels from the offset; -inf if there is none


def check_not_cut_off(patches: FloatArray, offset: float, voxel_size: float) -> None:
    """Raise GridError if the distances are truncated within 1.5 voxels of an offset.

    ``patches`` (V, 27) are the samples round voxels of the band there, in half voxels from it.
    """
    centre = patches[:, CENTRE]
    cut_off = is_flat(patches) & (np.abs(centre) < CUT_OFF_MARGIN - ROUNDING)
    if cut_off.any():
        end = offset + float(centre[cut_off][0]) * voxel_size / 2
        raise too_near(offset, voxel_size, end, CUT_OFF_MARGIN, outwards=end > 0)


def is_flat(patches: FloatArray) -> BoolArray:
    """Return which samples equal all their neighbours, (V,) bool: a distance never does."""
    flat = np.ones(len(patches), bool)
    for column in range(27):
        flat &= patches[:, column] == patches[:, CENTRE]
    return flat


def find_jumps(rescaled: FloatArray, own: tuple[slice, ...]) -> tuple[Jumps, Jumps]:
    """Return the jumps upwards and downwards in planes (n, ny, nz), in half voxels.

    Samples are counted in ``own``; those beside them only show whether there is a jump.
    """
    return _jumps_up(rescaled, own), _jumps_up(-rescaled, own)


def _jumps_up(rescaled: FloatArray, own: tuple[slice, ...]) -> Jumps:
    """Return the jumps upwards."""
    jumps = np.zeros(rescaled.shape, bool)
    for axis in range(3):
        values, found = np.moveaxis(rescaled, axis, 0), np.moveaxis(jumps, axis, 0)
        step = values[1:] - values[:-1]
        found[:-1] |= step > MIN_JUMP
        found[1:] |= step < -MIN_JUMP
    rescaled, jumps = rescaled[own], jumps[own]
    near = np.abs(rescaled) < PATCH_LIMIT
    jumps &= near
    return Jumps(int(jumps.sum()), int(near.sum()), float(rescaled[jumps].max(initial=-np.inf)))


def check_not_filled(found: list[tuple[Jumps, Jumps]], offset: float, voxel_size: float) -> None:
    """Raise GridError if fill values begin within 2.5 voxels of an offset, by all planes' jumps."""
    for side, parts in zip((1, -1), zip(*found)):
        count, near = sum(part.edges for part in parts), sum(part.near for part in parts)
        reach = max(part.end for part in parts)
        if count > MAX_JUMP_SHARE * near and reach < FILL_MARGIN - UNSAMPLED:
            end = offset + side * reach * voxel_size / 2
            raise too_near(offset, voxel_size, end, FILL_MARGIN, outwards=side > 0)


def too_near(
    offset: float, voxel_size: float, end: float, needed: float, *, outwards: bool
) -> GridError:
    """Return the error for an offset too near ``end``, where the distances end (world units).

    ``needed`` is how far they must reach, in half voxels.
    """
    room = needed / 2 * voxel_size
    limit, which = (end - room, "largest") if outwards else (end + room, "smallest")
    works = f"the {which} that works is {limit:.6g}" if limit * end > 0 else "only 0 works"
    return GridError(
        f"offset {offset:g} needs distances {needed / 2:g} spacings ({room:.6g}) to either side "
        f"of it, but they end at {end:.6g}: {works}"
    )
