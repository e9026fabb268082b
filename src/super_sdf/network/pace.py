"""Progress of a run of the network, estimated from the elapsed time.

onnxruntime does not report progress. The time of a run is nearly proportional to its number of
voxels and values; the factor is measured in the run before, or in a small part of this one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from ..progress import ShareCallback

VALUES_PER_VOXEL = 300  # decoding this many values takes as long as encoding a voxel
LONG_RUN = 20_000  # in the unit of ``work_of``: a few tenths of a second on one core
LINEAR_UP_TO = 0.8  # above this share progress slows down: a run may take longer than expected


def work_of(voxels: int, decoded: int, offsets: int) -> float:
    """Return the work of a run, in voxels to encode; values to decode are converted."""
    return voxels + decoded * offsets / VALUES_PER_VOXEL


class Pace:
    """The seconds that a network takes per voxel of work, from its last long run."""

    def __init__(self) -> None:
        self.seconds: float | None = None

    def learn(self, work: float, seconds: float) -> None:
        """Record the seconds that a run took for its work."""
        self.seconds = seconds / work

    def watch(self, work: float, progress: ShareCallback) -> Callable[[], None]:
        """Return a function that reports the progress of a run that starts now, when called."""
        began = time.perf_counter()
        expected = work * (self.seconds or math.inf)
        return lambda: progress(share_of_time(time.perf_counter() - began, expected))


def share_of_time(seconds: float, expected: float) -> float:
    """Return the estimated finished share of a run; it stays below 1, however long it takes."""
    share = seconds / expected
    if share <= LINEAR_UP_TO:
        return share
    left = 1 - LINEAR_UP_TO
    return 1 - left / (1 + (share - LINEAR_UP_TO) / left)
