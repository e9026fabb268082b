"""The threads and memory of a run: decided once at the start, and passed down to every step."""

from __future__ import annotations

from dataclasses import dataclass

from .memory import memory_bound
from .threads import useful_threads


@dataclass(frozen=True)
class Resources:
    """The threads that a run may use, and the bytes that its process may hold; None: no bound."""

    threads: int = 1
    memory: int | None = None


ONE_THREAD = Resources()
"""One thread, and no memory bound."""


def allot(threads: int = 0, max_memory: int | None = None) -> Resources:
    """Return what a run may use: the threads asked for, 0 for one per core, which is also the most.

    Without ``max_memory``, the bytes are what the process holds and a share of the free memory.
    """
    return Resources(useful_threads(threads), memory_bound(max_memory))
