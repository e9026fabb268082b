"""What a run may use: decided once, where it begins, and handed down to every step."""

from __future__ import annotations

from dataclasses import dataclass

from .memory import memory_bound
from .threads import useful_threads


@dataclass(frozen=True)
class Resources:
    """What a run may use.

    Attributes
    ----------
    threads : int
        How many work at a time.
    memory : int, optional
        Bytes that the process may hold in all; None if nobody can say.
    """

    threads: int = 1
    memory: int | None = None


ALONE = Resources()
"""One thread, and memory without a bound."""


def allot(threads: int = 0, max_memory: int | None = None) -> Resources:
    """Return what a run may use.

    Parameters
    ----------
    threads : int
        As asked for; 0 for one per core, and never more.
    max_memory : int, optional
        Bytes that the process may hold; what it holds and a share of what is free unless given.
    """
    return Resources(useful_threads(threads), memory_bound(max_memory))
