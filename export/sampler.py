"""Which window a run shows next: the more was lost on it last time, the more often it is drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


class Sampler:
    """Draws windows with a chance in proportion to the loss on them when they were last shown.

    New windows are shown first, each once and in random order. Losses are not kept when a run ends:
    one that resumes shows every window once again.
    """

    def __init__(self) -> None:
        self.losses = np.empty(0)  # NaN: not shown yet
        self._order: list[int] = []

    def add(self, count: int) -> None:
        """Take in windows that were not shown yet."""
        self.losses = np.append(self.losses, np.full(count, np.nan))

    def restart(self) -> None:
        """Forget what was shown."""
        self.losses[:] = np.nan
        self._order.clear()

    def draw(self, rng: np.random.Generator, spread: float) -> int:
        """Return the index of the next window; for ``spread`` see ``chances``."""
        if not self._order:
            self._order = self._draw_order(rng, spread).tolist()
        return self._order.pop()

    def record(self, drawn: Sequence[int], losses: Sequence[float]) -> None:
        """Note what was lost on windows that were shown."""
        self.losses[list(drawn)] = losses

    def _draw_order(self, rng: np.random.Generator, spread: float) -> NDArray[np.intp]:
        """Return the indices of the next windows: all new ones, else as many as there are."""
        new = np.flatnonzero(np.isnan(self.losses))
        if len(new):
            return rng.permutation(new)
        if spread == 1:
            return rng.permutation(len(self.losses))
        return rng.choice(len(self.losses), len(self.losses), p=chances(self.losses, spread))


def chances(losses: NDArray[np.float64], spread: float) -> NDArray[np.float64]:
    """Return the chance of each window, (N,), from its loss.

    In proportion to the loss, but ``spread`` times the chance of a window of mean loss at most, and
    that over ``spread`` at least: this limits what a window without a learnable answer, or one that
    was shown with noise, takes from the others.
    """
    bounded = np.clip(losses / losses.mean(), 1 / spread, spread)
    return bounded / bounded.sum()
