"""Whether the distances go far enough round an offset.

A field may be cut off at some distance, or hold a fill value from there on. A surface too near to
that distance would come out in loose pieces, or in the wrong place.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..arrays import BoolArray, FloatArray
from ..errors import GridError
from ..neighbourhood import CENTRE
from .band import HALF_BAND, PATCH_LIMIT

# Neighbouring samples of noisy distances differ by up to twice the spacing (4 half voxels), from a
# fill value they differ by more. A small share of such jumps is tolerated: wrong samples.
JUMP, MOST_JUMPS = 4.2, 0.05
# How far distances must go beyond the offset, in half voxels, before they are cut off at one value;
# and before fill values begin, which would be taken for noise.
CUT_OFF_ROOM, FILL_ROOM = HALF_BAND, 5.0
# Tolerances in half voxels, so that the offset that the message names works: for rounding, and
# because no sample lies exactly where fill values begin.
ROUNDING, UNSAMPLED = 1e-3, 0.1


class Jumps(NamedTuple):
    """Samples near an offset next to which the field jumps away, and how many are near in all.

    ``end`` is the farthest from which it jumps, in half voxels from the offset.
    """

    edges: int
    near: int
    end: float


def check_not_cut_off(patches: FloatArray, offset: float, voxel_size: float) -> None:
    """Raise if the distances are cut off within 1.5 voxels of an offset.

    Parameters
    ----------
    patches : (V, 27) float32
        The samples round some voxels of the band at the offset, in half voxels from it.
    offset, voxel_size : float
        In world units.

    Raises
    ------
    GridError
        The text says which offset works.
    """
    centre = patches[:, CENTRE]
    cut_off = is_flat(patches) & (np.abs(centre) < CUT_OFF_ROOM - ROUNDING)
    if cut_off.any():
        end = offset + float(centre[cut_off][0]) * voxel_size / 2
        raise too_near(offset, voxel_size, end, CUT_OFF_ROOM, outwards=end > 0)


def is_flat(patches: FloatArray) -> BoolArray:
    """Say which samples, (V,), equal all their neighbours: no distance does."""
    flat = np.ones(len(patches), bool)
    for column in range(27):
        flat &= patches[:, column] == patches[:, CENTRE]
    return flat


def find_jumps(rescaled: FloatArray) -> tuple[Jumps, Jumps]:
    """Return the jumps upwards and downwards in some planes, in half voxels from the offset."""
    return _jumps_up(rescaled), _jumps_up(-rescaled)


def _jumps_up(rescaled: FloatArray) -> Jumps:
    """Return the jumps upwards."""
    jumps = np.zeros(rescaled.shape, bool)
    for axis in range(3):
        values, found = np.moveaxis(rescaled, axis, 0), np.moveaxis(jumps, axis, 0)
        step = values[1:] - values[:-1]
        found[:-1] |= step > JUMP
        found[1:] |= step < -JUMP
    near = np.abs(rescaled) < PATCH_LIMIT
    jumps &= near
    return Jumps(int(jumps.sum()), int(near.sum()), float(rescaled[jumps].max(initial=-np.inf)))


def check_not_filled(found: list[tuple[Jumps, Jumps]], offset: float, voxel_size: float) -> None:
    """Raise if there are fill values within 2.5 voxels of an offset, of all planes' jumps."""
    for side, parts in zip((1, -1), zip(*found)):
        count, near = sum(part.edges for part in parts), sum(part.near for part in parts)
        reach = max(part.end for part in parts)
        if count > MOST_JUMPS * near and reach < FILL_ROOM - UNSAMPLED:
            end = offset + side * reach * voxel_size / 2
            raise too_near(offset, voxel_size, end, FILL_ROOM, outwards=side > 0)


def too_near(
    offset: float, voxel_size: float, end: float, needed: float, *, outwards: bool
) -> GridError:
    """Return the error for an offset that is too near to where the distances end."""
    room = needed / 2 * voxel_size
    limit, which = (end - room, "largest") if outwards else (end + room, "smallest")
    works = f"the {which} that works is {limit:.6g}" if limit * end > 0 else "only 0 works"
    return GridError(
        f"offset {offset:g} needs distances {needed / 2:g} spacings ({room:.6g}) to either side "
        f"of it, but they end at {end:.6g}: {works}"
    )
