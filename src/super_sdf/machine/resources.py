"""The threads and memory of a run: decided once at the start, and passed down to every step."""

from __future__ import annotations

from dataclasses import dataclass

from .memory import memory_bound
from .threads import useful_threads


@dataclass(frozen=True)
class Resources:
    """The threads and memory that a run may use.

    Attributes
    ----------
    threads : int
        Number of threads.
    memory : int, optional
        Bytes that the process may hold in all; None for no bound.
    """

    threads: int = 1
    memory: int | None = None


ONE_THREAD = Resources()
"""One thread, and no memory bound."""


def allot(threads: int = 0, max_memory: int | None = None) -> Resources:
    """Return the threads and memory that a run may use.

    Parameters
    ----------
    threads : int
        Requested number; 0 for one per core, which is also the maximum.
    max_memory : int, optional
        Bytes that the process may hold in all. By default what it holds already and a share of the
        free memory.
    """
    return Resources(useful_threads(threads), memory_bound(max_memory))
