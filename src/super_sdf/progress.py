"""Progress of the work on a grid, and the time that its steps take."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping

Progress = Callable[[int, int], None]
"""Called with (done, total), in thousandths of the work; ``done`` never falls and ends at total.

If it raises an exception, the work stops with that exception.
"""

TOTAL = 1000
# Share of the time that each step takes with a network on a CPU.
STEPS = {"band": 0.03, "network": 0.45, "nodes": 0.15, "isosurface": 0.37}


def part_of(progress: Progress | None, begin: float, end: float) -> Progress | None:
    """Return a callback for a part of the work, between two shares of it; None without one."""
    if progress is None:
        return None
    return lambda done, total: progress(
        round(TOTAL * (begin + (end - begin) * done / total)), TOTAL
    )


def share_of(progress: Progress | None) -> Callable[[float], None] | None:
    """Return a callback for the share of the work that is done; None without one."""
    return None if progress is None else lambda share: progress(round(TOTAL * share), TOTAL)


class Stopwatch:
    """Adds up the seconds spent in each stage, by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.clock = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage."""
        now = time.perf_counter()
        self.take({stage: now - self.clock})

    def take(self, seconds: Mapping[str, float]) -> None:
        """Add times that were measured elsewhere, and restart the clock."""
        for stage, more in seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + more
        self.clock = time.perf_counter()


class StepCounter(Stopwatch):
    """Reports progress and measures time, step by step; ``finish`` ends each step."""

    def __init__(self, progress: Progress | None = None, names: Iterable[str] = STEPS) -> None:
        super().__init__()
        whole = sum(STEPS[name] for name in names)
        self.lengths = {name: TOTAL * STEPS[name] / whole for name in names}
        self.progress, self.done = progress, 0.0

    def show(self, share: float) -> None:
        """Report the share of all that comes after the first step."""
        first = self.lengths.get("band", 0)
        self._show(first + share * (TOTAL - first))

    def finish(self, name: str) -> None:
        """Report that a step is done, and record its time."""
        self.lap(name)
        self.done += self.lengths[name]
        self._show(TOTAL if name == "isosurface" else self.done)

    def within(self, name: str) -> Callable[[float], None] | None:
        """Return a callback for the share of a step that starts now; None without ``progress``."""
        begin, length = self.done, self.lengths[name]
        return (lambda share: self._show(begin + share * length)) if self.progress else None

    def _show(self, done: float) -> None:
        if self.progress:
            self.progress(round(done), TOTAL)
