"""How far the work on a grid is, and how long its steps take."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping

Progress = Callable[[int, int], None]
"""Called with (done, total), in thousandths of the work; ``done`` never falls and ends at total.

While the network runs it is called several times a second, with an estimate by the clock. If it
raises, the work ends there with that error.
"""

Tell = Callable[[float], None]
"""Called with the share of a step that is done, from 0 to 1."""

TOTAL = 1000
# The parts of the time that the steps take, with a network on a CPU: the first once, the others for
# each slab.
STEPS = {"band": 0.02, "network": 0.78, "nodes": 0.1, "isosurface": 0.1}


class Stopwatch:
    """The time between laps, by the name of the lap."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.start()

    def start(self) -> None:
        """Begin a lap now."""
        self.clock = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Book the time since the last lap under a stage."""
        now = time.perf_counter()
        self.take({stage: now - self.clock})
        self.clock = now

    def take(self, seconds: Mapping[str, float]) -> None:
        """Book what was timed elsewhere; the next lap begins now."""
        for stage, spent in seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + spent
        self.start()


class Steps:
    """Tells how far the work is.

    ``finish`` is called at the end of each step.
    """

    def __init__(self, progress: Progress | None = None, names: Iterable[str] = STEPS) -> None:
        whole = sum(STEPS[name] for name in names)
        self.lengths = {name: TOTAL * STEPS[name] / whole for name in names}
        self.progress = progress
        self.done = 0.0
        self.watch = Stopwatch()

    def divide(self, slabs: int) -> None:
        """Expect all steps but the first once for each slab."""
        for name in self.lengths.keys() - {"band"}:
            self.lengths[name] /= slabs

    def finish(self, name: str) -> None:
        """Tell that a step is done, and book its time."""
        self.watch.lap(name)
        self.done += self.lengths[name]
        self._show(self.done)

    def take_seconds(self) -> dict[str, float]:
        """Return what the steps took since this was called last."""
        seconds, self.watch.seconds = self.watch.seconds, {}
        return seconds

    def within(self, name: str) -> Tell | None:
        """Return what a step that begins now is to call with its share; None if nobody listens."""
        begin, length = self.done, self.lengths[name]
        return (lambda share: self._show(begin + share * length)) if self.progress else None

    def _show(self, done: float) -> None:
        if self.progress:
            self.progress(round(done), TOTAL)
