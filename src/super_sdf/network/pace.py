"""How far a run of the network is: onnxruntime does not say, so the clock is asked.

The time of a run is nearly proportional to its voxels and values; how long one takes is known from
the run before, or from a small part of this one, run first.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from ..progress import Tell

VALUES_PER_VOXEL = 300  # values to decode that take as long as a voxel to encode
LONG = 20_000  # voxels, or values in their terms: a few tenths of a second on a core
TRUSTED = 0.8  # beyond this share of a run it creeps: the run may well take longer than the last


def work_of(voxels: int, decoded: int, offsets: int) -> float:
    """Return how much there is to do in a run, in voxels."""
    return voxels + decoded * offsets / VALUES_PER_VOXEL


class Pace:
    """The time that a network takes for a voxel, from its last long run."""

    def __init__(self) -> None:
        self.seconds: float | None = None

    def learn(self, work: float, seconds: float) -> None:
        """Keep what a run took."""
        self.seconds = seconds / work

    def watch(self, work: float, tell: Tell) -> Callable[[], None]:
        """Return what tells, whenever it is called, how far the run is that begins now."""
        began = time.perf_counter()
        expected = work * (self.seconds or math.inf)
        return lambda: tell(share_of_time(time.perf_counter() - began, expected))


def share_of_time(seconds: float, expected: float) -> float:
    """Return the share of a run that is probably done: never 1, however long it takes."""
    share = seconds / expected
    if share <= TRUSTED:
        return share
    left = 1 - TRUSTED
    return 1 - left / (1 + (share - TRUSTED) / left)
