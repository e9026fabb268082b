"""Rows worked on a chunk at a time, so that what is made on the way stays small and in cache.

Chunks do not depend on each other, so they may run side by side; results come in their order.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

Result = TypeVar("Result")

CHUNK = 1 << 13  # rows

_threads: ContextVar[int] = ContextVar("threads", default=1)


def count_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def working_threads(number: int) -> Iterator[None]:
    """Work on so many chunks at a time within; 0 for one a core."""
    token = _threads.set(number or count_cores())
    try:
        yield
    finally:
        _threads.reset(token)


def in_chunks(count: int, work: Callable[[slice], Result], chunk: int = CHUNK) -> list[Result]:
    """Return what ``work`` makes of ``count`` rows, chunk by chunk."""
    return side_by_side([slice(n, min(n + chunk, count)) for n in range(0, count, chunk)], work)


def side_by_side(pieces: list[slice], work: Callable[[slice], Result]) -> list[Result]:
    """Return what ``work`` makes of each piece."""
    threads = min(_threads.get(), len(pieces))
    if threads < 2:
        return [work(piece) for piece in pieces]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, pieces))
