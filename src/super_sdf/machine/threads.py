"""Rows worked on a chunk at a time, so that what is made on the way stays small and in cache.

Chunks do not depend on each other, so they may run side by side; results come in their order.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from math import ceil
from typing import TypeVar

from .containers import bound_of_cores

Result = TypeVar("Result")

CHUNK = 1 << 19  # numbers

_threads: ContextVar[int] = ContextVar("threads", default=1)


def count_cores() -> int:
    """Return how many cores this process may use: in a container, its share of them, rounded up."""
    return max(ceil(min(cores_of_system(), bound_of_cores())), 1)


def cores_of_system() -> int:
    """Return how many cores the system lets this process run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def useful_threads(requested: int) -> int:
    """Return the number of threads to use for a requested number, 0 meaning one per core.

    More than there are cores would wait for each other.
    """
    cores = count_cores()
    return min(requested or cores, cores)


def threads_at_work() -> int:
    """Return how many chunks are worked on at a time."""
    return _threads.get()


@contextmanager
def working_threads(number: int) -> Iterator[None]:
    """Work on so many chunks at a time within; 0 for one a core."""
    token = _threads.set(useful_threads(number))
    try:
        yield
    finally:
        _threads.reset(token)


def rows_in_chunk(width: int) -> int:
    """Return how many rows go at a time if so many numbers are made of each on the way."""
    return max(CHUNK // width, 1)


def in_chunks(count: int, width: int, work: Callable[[slice], Result]) -> list[Result]:
    """Return what ``work`` makes of ``count`` rows, chunk by chunk; of each it makes ``width``."""
    step = rows_in_chunk(width)
    return side_by_side([slice(n, min(n + step, count)) for n in range(0, count, step)], work)


def side_by_side(
    pieces: list[slice], work: Callable[[slice], Result], at_once: int | None = None
) -> list[Result]:
    """Return ``work(piece)`` for each piece, at most ``at_once`` of them at a time if given."""
    threads = min(at_once or threads_at_work(), threads_at_work(), len(pieces))
    if threads < 2:
        return [work(piece) for piece in pieces]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, pieces))
